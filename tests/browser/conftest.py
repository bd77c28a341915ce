"""The example task, opened once for several files: server, worker and first picture take a core for twenty seconds."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect

from tests.drive.desk import Desk
from tests.drive.page import TASK, Opened, open_workbench, page_at

RECORDINGS = "kept"
At = Callable[..., AbstractContextManager[Desk]]


def _opened(tmp_path_factory: pytest.TempPathFactory, *arguments: str) -> Iterator[At]:
    folder = tmp_path_factory.mktemp("author")
    file = shutil.copy(TASK, folder)
    arguments = (str(file), *arguments, "--recordings", RECORDINGS, "--no-spare")
    with open_workbench(*arguments, cwd=folder) as opened:
        yield lambda browser, width=1280, height=720: _desk(
            opened, folder / TASK.name, browser, width, height
        )


@contextmanager
def _desk(opened: Opened, file: Path, browser: Browser, width: int, height: int) -> Iterator[Desk]:
    with page_at(browser, opened.url, width, height) as (page, errors):
        expect(page.locator(".wb-status").get_by_text("paused", exact=True)).to_be_visible(timeout=120_000)
        desk = Desk(page, errors, file, opened)
        desk.select_the_first_env()
        yield desk
    # Restore the initial state for the next file.
    file.write_text(TASK.read_text())


@pytest.fixture(scope="session")
def example(tmp_path_factory: pytest.TempPathFactory) -> Iterator[At]:
    """A function that opens a page, for a browser and a size, on the shared server of a task with two envs."""
    yield from _opened(tmp_path_factory, "--num-envs", "2")


@pytest.fixture(scope="session")
def example_without_pictures(tmp_path_factory: pytest.TempPathFactory) -> Iterator[At]:
    """As `example`, with three envs and without a renderer."""
    yield from _opened(tmp_path_factory, "--num-envs", "3", "--env", "render_backend=none")
