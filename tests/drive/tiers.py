"""Marks tests by their fixtures; `--fast` runs those that need no process, renderer or browser.

In that run a test that starts a process or renders fails with the name of the fixture that it lacks.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.drive import waiting
from workbench.machine.doctor import find_chromium, how_to_get_chromium

MARKER_OF = {"chromium_path": "browser", "child_process": "process", "renderer": "render"}
LEFT_OUT = (*MARKER_OF.values(), "thorough", "slow")
ALL_TESTS_MARKED = re.compile(r"^pytestmark = (\[$[\s\S]*?^\]|.*)", re.MULTILINE)
LEFT_OUT_MARK = re.compile(rf"\bmark\.({'|'.join(LEFT_OUT)})\b|\"({'|'.join(MARKER_OF)})\"")
STARTS_A_PROCESS = {"subprocess.Popen", "os.fork", "os.forkpty", "os.posix_spawn", "os.spawn", "os.system"}


@pytest.fixture(scope="session")
def chromium_path(child_process: None) -> str:
    """Path of Chromium for Playwright's ``executable_path``. Without Chromium the test fails."""
    path = find_chromium()
    if path is None:
        pytest.fail(how_to_get_chromium())
    return path


@pytest.fixture(scope="session")
def child_process() -> None:
    """Required by tests that start a process: a worker, a recording reader, a command, ffmpeg."""


@pytest.fixture(scope="session")
def renderer() -> None:
    """Required by tests that render in the test process. Keeps the device: without one the shaders are lost, 5 s an env."""
    from tests.drive.render_device import RENDER_DEVICE
    from workbench.envs.backends import keep_render_device

    keep_render_device(RENDER_DEVICE)


def pytest_addoption(parser: pytest.Parser) -> None:
    words = "only tests that are quick and need no process, renderer or browser; each is held to it"
    parser.addoption("--fast", action="store_true", help=words)


QUICK = "WORKBENCH_TESTS_ARE_QUICK"


def tries(quick: int, whole: int) -> int:
    """Number of hypothesis examples: `quick` where the slow tests are left out, `whole` elsewhere."""
    return quick if QUICK in os.environ else whole


def pytest_configure(config: pytest.Config) -> None:
    if config.getoption("fast") or config.getoption("markexpr") == "not slow":
        os.environ[QUICK] = "yes"
    if config.getoption("fast"):
        guard = Guard()
        config.pluginmanager.register(guard)
        waiting.interrupts.append(guard.check)


def pytest_itemcollected(item: pytest.Item) -> None:
    for fixture in MARKER_OF.keys() & set(getattr(item, "fixturenames", ())):
        item.add_marker(MARKER_OF[fixture])


def pytest_collection_finish(session: pytest.Session) -> None:
    """Make the renderer first: SAPIEN refuses it while a material from a test without one is alive."""
    if not session.config.getoption("fast") and any(
        item.get_closest_marker("render") for item in session.items
    ):
        from tests.drive.render_device import RENDER_DEVICE
        from workbench.envs.backends import find_renderer, keep_render_device

        if find_renderer() is not None:  # without one each test that renders fails with the reason
            keep_render_device(RENDER_DEVICE)


class Guard:
    """Deselects tests that are not fast, and fails those that start a process or renderer without the fixture."""

    def __init__(self) -> None:
        self.running = False
        self.refused: list[str] = []
        sys.addaudithook(self.audit)

    def audit(self, event: str, args: tuple[Any, ...]) -> None:
        if event in STARTS_A_PROCESS:
            self.refuse(f"it starts a process ({event} {args[:2]!r:.200})", "child_process")

    def refuse(self, what: str, fixture: str) -> None:
        if self.running:
            self.refused.append(
                f"{what}: let it, or the fixture that does, ask for the fixture `{fixture}`, which marks it "
                f"`{MARKER_OF[fixture]}`"
            )
            pytest.fail(self.refused[-1])

    def check(self) -> None:
        """Fail now if a thread was refused: what the test waits for will not come."""
        if self.refused:
            pytest.fail(self.refused[0])

    def pytest_ignore_collect(self, collection_path: Path) -> bool | None:
        """Do not import a file of which all tests are left out: a third of them, and they import the most."""
        if collection_path.suffix != ".py":
            return None
        mark = ALL_TESTS_MARKED.search(collection_path.read_text())
        return True if mark and LEFT_OUT_MARK.search(mark[0]) else None

    def pytest_collection_modifyitems(self, config: pytest.Config, items: list[pytest.Item]) -> None:
        fast, others = [], []
        for item in items:
            (others if any(map(item.get_closest_marker, LEFT_OUT)) else fast).append(item)
        config.hook.pytest_deselected(items=others)
        items[:] = fast

    def pytest_collection_finish(self) -> None:
        render: Any = sys.modules.get("sapien.render")
        if render is None:
            return
        make = render.RenderSystem.__init__

        def refuse(system: Any, *args: Any, **kwargs: Any) -> None:
            self.refuse("it renders", "renderer")
            make(system, *args, **kwargs)

        render.RenderSystem.__init__ = refuse

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self) -> Iterator[None]:
        self.running = True
        self.refused.clear()
        try:
            return (yield)
        finally:
            self.running = False

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self) -> Iterator[None]:
        """Fail the test, with the reason, if a refusal was raised in a thread or swallowed by an except."""
        try:
            return (yield)
        finally:
            if self.refused:
                pytest.fail(self.refused[0])
