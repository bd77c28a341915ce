"""From a recording into the live env, and rescoring of recordings, in a real Chromium."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect

from tests.drive.page import TASK, open_workbench, page_at
from workbench.record.job import record
from workbench.record.job_worker import RecordOptions
from workbench.task.description import TaskOptions

pytestmark = pytest.mark.browser
TIMEOUT_MS = 120_000


@pytest.fixture(scope="module")
def author(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A task file with a recorded episode, and an edit of its reward since."""
    folder = tmp_path_factory.mktemp("author")
    file = Path(shutil.copy(TASK, folder))
    options = TaskOptions(1, "cpu", 5, {"render_backend": "none"})
    record(
        RecordOptions(
            str(file), folder / "recordings", episodes=1, pictures=False, max_steps=15, options=options
        )
    )
    text = file.read_text()
    assert "action, info) / 3" in text
    file.write_text(text.replace("action, info) / 3", "action, info) / 2"))
    return folder


@pytest.fixture(scope="module")
def address(author: Path) -> Iterator[str]:
    """The address of ``workbench review``; it must exit on SIGINT and leave no folder of recorded code."""
    with open_workbench("recordings", cwd=author, what="review", env={"TMPDIR": str(author)}) as opened:
        yield opened.url
    assert opened.process.returncode == 0, "\n".join(opened.lines)
    assert not list(author.glob("workbench-recorded-*"))


COUNT_BODIES = """() => {
    window.fewest = Infinity;
    const bodies = () => Object.keys(window.__viserSceneTree.getState()).filter((name) => name.startsWith("/envs/"));
    setInterval(() => (window.fewest = Math.min(window.fewest, bodies().length)), 5);
}"""


@pytest.mark.slow
def test_a_recording_is_rescored_and_entered_with_todays_and_with_its_own_code(
    address: str, author: Path, browser: Browser
) -> None:
    with page_at(browser, address) as (page, errors):
        live = page.get_by_role("button", name="Continue live from here")
        expect(live).to_be_visible(timeout=TIMEOUT_MS)  # the newest recording opens automatically

        page.get_by_role("tab", name="Rescore").click()
        expect(page.get_by_text(f"With {author / 'push_cube.py'} as it is now.")).to_be_visible()
        page.get_by_role("button", name="Rescore the open recordings").click()
        expect(page.get_by_text("1 of 1 episode differs")).to_be_visible(timeout=TIMEOUT_MS)
        page.get_by_text("reward changed by up to").click()
        expect(page.get_by_text("step 1 / 15").first).to_be_visible()

        page.get_by_role("tab", name="Review").click()
        page.keyboard.press("ArrowRight")
        expect(page.get_by_text("step 2 / 15").first).to_be_visible()
        page.evaluate(COUNT_BODIES)
        live.click()
        expect(page.get_by_text("loading WorkbenchPushCube-v1 at step 2")).to_be_visible()
        expect(page.get_by_role("button", name="Stay here")).to_be_visible()
        changed = "changed since: compute_normalized_dense_reward"
        status = page.get_by_text(
            f"WorkbenchPushCube-v1, seed 5, step 2 ({changed}): its actions were replayed"
        )
        expect(status).to_be_visible(timeout=TIMEOUT_MS)
        assert page.evaluate("window.fewest") > 5, "the view was empty for a while"
        expect(status).to_contain_text("to the last bit")
        expect(page.get_by_role("button", name="undo going live")).to_be_visible()

        page.get_by_role("tab", name="Episodes").click()
        page.get_by_role("button", name="Review recordings").click()
        page.get_by_text("Continue live", exact=True).click()
        page.get_by_label("Code", exact=True).locator("visible=true").select_option(label="as recorded")
        live.click()
        status = page.get_by_text("seed 5 as it was recorded, step 2: its actions were replayed")
        expect(status).to_be_visible(timeout=TIMEOUT_MS)
        assert list(author.glob("workbench-recorded-*/push_cube.py"))
        assert not [error for error in errors if "non-existent component" not in error]
