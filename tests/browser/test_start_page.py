"""The start page and *Open...* in a real Chromium, used as by a user: one server for all tests."""

from __future__ import annotations

import re
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest
from playwright.sync_api import Browser, Locator, Page, expect

from tests.drive.page import TASK, Opened, close_notice, open_workbench, page_at, picture_of_view
from tests.drive.waiting import until
from workbench.machine.maniskill_installed import installed_maniskills
from workbench.start.registered import LIST_FILE
from workbench.task.new_task import TEMPLATES
from workbench.trust.consent_dialog import ONCE

# The first test needs the start page, which is gone once a task is open.
pytestmark = [pytest.mark.browser, pytest.mark.slow, pytest.mark.random_order(disabled=True)]
TIMEOUT_MS = 120_000
NOT_FOUND = "NoSuchTask-v1"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A working folder with two tasks, another folder with one, and a complete thumbnail cache."""
    folder = tmp_path_factory.mktemp("start")
    for name in ("work/push.py", "work/sub/small.py", "elsewhere/other.py"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(TASK.parent / "minimal.py" if "small" in name else TASK, folder / name)
    ((name, version),) = installed_maniskills().items()
    cache = folder / f"cache/workbench/tasks/{name}-{version}"
    cache.mkdir(parents=True)
    ids = ["PickCube-v1", NOT_FOUND]
    tried = {one: {"text": "Not here.", "tries": 9, "last": time.time()} for one in ids}
    (cache / LIST_FILE).write_bytes(msgspec.json.encode({"ids": ids, "not_drawn": tried}))
    state = folder / "state/workbench"
    state.mkdir(parents=True, mode=0o700)
    rows = [{"reference": str(folder / "elsewhere/other.py"), "num_envs": 3}]
    (state / "recent_tasks.json").write_bytes(msgspec.json.encode({"tasks": rows}))
    return folder


@pytest.fixture(scope="module")
def started(folder: Path) -> Iterator[Opened]:
    env = {name: str(folder / what) for name, what in HOMES.items()}
    arguments = ("--num-envs", "2", "--no-spare", "--env", "render_backend=none")
    with open_workbench(*arguments, cwd=folder / "work", what="start", env=env) as opened:
        yield opened


HOMES = {"XDG_CACHE_HOME": "cache", "XDG_STATE_HOME": "state", "XDG_CONFIG_HOME": "config"}


def row(page: Page, name: str) -> Locator:
    return page.locator(".wb-tasks [data-row]").filter(has=page.get_by_text(name, exact=True)).first


def marked(page: Page) -> Locator:
    """The row that Enter opens."""
    return page.locator(".wb-task:focus, .wb-tasks:not(:focus-within) [data-best]")


def runs(page: Page, title: str, envs: str = "2 envs") -> None:
    status = page.locator(".wb-status")
    expect(status).to_have_attribute("data-title", re.compile(title), timeout=TIMEOUT_MS)
    # In this order: "building 2 envs" is shown while the task loads.
    expect(status).to_contain_text(f"{envs} on cpu", timeout=TIMEOUT_MS)
    expect(status).to_contain_text("paused", timeout=TIMEOUT_MS)


def open_list(page: Page) -> None:
    """Open the dialog; while no task is open, the list is already there."""
    expect(page.locator(".wb-status, .wb-start").first).to_be_visible(timeout=TIMEOUT_MS)
    if page.locator(".wb-status").count():
        page.wait_for_selector("[data-keys]", state="attached")
        page.keyboard.press("Control+o")
        expect(page.get_by_role("dialog").locator(".wb-tasks")).to_be_visible()


def test_switching_from_the_start_page_to_a_task_to_another_and_back(
    started: Opened, folder: Path, browser: Browser
) -> None:
    with page_at(browser, started.url) as (page, errors), page_at(browser, started.url) as (other, _):
        # The list is shown, the search has the focus, and the first row is marked.
        expect(row(page, "push.py")).to_be_visible(timeout=TIMEOUT_MS)
        for name in ("sub/small.py", "minimal.py", "PickCube-v1", "recordings/", "other.py"):
            expect(row(page, name)).to_be_attached()
        expect(page.get_by_role("textbox").first).to_be_focused()
        expect(marked(page)).to_have_count(1)
        page.keyboard.press("ArrowDown")
        expect(marked(page)).to_contain_text("push.py")
        page.keyboard.press("ArrowUp")
        expect(marked(page)).to_contain_text("other.py")
        # Words and Enter in quick succession: Enter waits for the list of these words.
        page.keyboard.type("push.py", delay=0)
        page.keyboard.press("Enter")
        runs(page, "WorkbenchPushCube-v1")
        runs(other, "WorkbenchPushCube-v1")
        expect(page.locator(".wb-status")).to_contain_text("panda")
        expect(page.locator(".wb-status")).to_contain_text("8 actions")

        # Another task replaces it, opened from another tab; the other browser follows.
        page.get_by_role("tab", name="Reward").click()
        page.keyboard.press("n")
        expect(page.locator(".wb-timeline")).to_contain_text("env 1")
        open_list(page)
        row(page, "sub/small.py").click()
        runs(page, "WorkbenchMinimal-v1")
        runs(other, "WorkbenchMinimal-v1")
        expect(page.locator(".wb-timeline")).to_contain_text("env 0")
        expect(page.get_by_role("tab", name="Run")).to_have_attribute("aria-selected", "true")

        # And back: the tab and the selected env are unchanged.
        open_list(page)
        page.keyboard.type("push")
        page.keyboard.press("Enter")
        runs(page, "WorkbenchPushCube-v1")
        expect(page.locator(".wb-timeline")).to_contain_text("env 1")
        expect(page.get_by_role("tab", name="Reward")).to_have_attribute("aria-selected", "true")

        # A task that cannot be built: the page reports it, and the same list leads back.
        open_list(page)
        row(page, NOT_FOUND).click()
        banner = page.locator(".wb-banner")
        expect(banner).to_contain_text(NOT_FOUND, timeout=TIMEOUT_MS)
        # A file from elsewhere asks first.
        open_list(page)
        row(page, "other.py").click()
        question = page.get_by_role("dialog", name="Run this code?")
        expect(question).to_contain_text("outside of the folder", timeout=TIMEOUT_MS)
        expect(question).to_contain_text(str(folder / "elsewhere/other.py"))
        question.get_by_role("button", name=ONCE).click()
        runs(page, "WorkbenchPushCube-v1", "3 envs")
        assert errors == []


def test_a_new_task_is_created_with_the_mouse_and_opens(
    started: Opened, folder: Path, browser: Browser
) -> None:
    with page_at(browser, started.url) as (page, errors):
        open_list(page)
        close_notice(page)
        page.get_by_text("New task", exact=True).click()
        name = page.get_by_label("Name", exact=True)
        template = page.get_by_label("Template", exact=True)
        about = [f"{one.name}: {one.about}" for one in TEMPLATES]
        expect(template.locator("option")).to_have_text(about)
        template.select_option(label=next(one for one in about if one.startswith("locomotion")))
        create = page.get_by_role("button", name="Create", exact=True)
        name.click()
        page.keyboard.type("push")
        create.click()
        expect(page.get_by_text("push.py exists already")).to_be_visible()
        name.click()
        page.keyboard.press("Control+a")
        page.keyboard.type("walk_far")
        create.click()
        runs(page, "WalkFar-v1")
        expect(page.locator(".wb-status")).to_contain_text("ant")
        text = (folder / "work/walk_far.py").read_text()
        assert "class WalkFarEnv(BaseEnv)" in text and '@register_env("WalkFar-v1"' in text
        assert errors == []


def colours(page: Page) -> int:
    """Number of colours in the middle of the 3-D view."""
    view = picture_of_view(page, {"x": 300, "y": 350, "width": 400, "height": 130})
    return len(np.unique(view.reshape(-1, 3), axis=0))


def test_a_file_with_a_syntax_error_shows_no_other_task_and_opens_once_fixed(
    started: Opened, folder: Path, browser: Browser
) -> None:
    file = folder / "work/torn.py"
    with page_at(browser, started.url) as (page, errors):
        open_list(page)
        row(page, "sub/small.py").click()
        runs(page, "WorkbenchMinimal-v1")
        until(lambda: colours(page) > 100, "the task is seen")
        file.write_text(
            "from x import y\n\nclass Task(BaseEnv):\n    def evaluate(self)\n        return {}\n"
        )
        open_list(page)
        page.keyboard.type("torn")
        expect(row(page, "torn.py")).to_contain_text("line 4")
        page.keyboard.press("Enter")
        banner = page.locator(".wb-banner")
        expect(banner).to_contain_text("torn.py:4", timeout=TIMEOUT_MS)
        expect(page.get_by_text("torn.py", exact=True)).to_be_visible()
        until(lambda: colours(page) < 100, "an empty view")
        started.wait_for_line(r"torn\.py:4")
        shutil.copy(TASK, file)
        runs(page, "WorkbenchPushCube-v1")
        expect(banner).to_be_hidden()
        assert errors == []
