"""A folder of recordings from elsewhere in a real Chromium: viewing is free, running its code asks first."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect

from tests.drive.page import TASK, open_workbench, page_at
from workbench.record.job import record
from workbench.record.job_worker import RecordOptions
from workbench.task.description import TaskOptions
from workbench.trust.consent_dialog import DO_NOT, ONCE

pytestmark = [pytest.mark.browser, pytest.mark.slow]
TIMEOUT_MS = 120_000


def test_code_of_a_recording_from_elsewhere_runs_only_after_consent(
    tmp_path: Path, browser: Browser, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = Path(shutil.copy(TASK, tmp_path))
    (tmp_path / "marks.py").write_text("open(__file__ + '.ran', 'w').close()\n")
    file.write_text(file.read_text().replace("import torch\n", "import torch\nimport marks\n", 1))
    options = TaskOptions(1, "cpu", 5, {"render_backend": "none"})
    record(RecordOptions(str(file), tmp_path / "r", episodes=1, pictures=False, max_steps=5, options=options))
    mark = tmp_path / "marks.py.ran"
    mark.unlink()
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "another user"))
    with (
        open_workbench("r", cwd=tmp_path, what="review") as opened,
        page_at(browser, opened.url) as (page, errors),
    ):
        page.locator("tr", has_text="WorkbenchPushCube").first.click()
        page.keyboard.press("Enter")
        live = page.get_by_role("button", name="Continue live from here")
        expect(live).to_be_visible(timeout=TIMEOUT_MS)
        page.get_by_role("tab", name="Rescore").click()
        rescore = page.get_by_role("button", name="Rescore the open recordings")
        rescore.click()
        window = page.get_by_role("dialog")
        expect(window).to_contain_text(str(file), timeout=TIMEOUT_MS)
        expect(window.get_by_role("button", name=DO_NOT)).to_be_focused()
        if screenshot := os.environ.get("TRUST_SCREENSHOT"):
            page.screenshot(path=screenshot)
        # Enter presses the focused button, and opens nothing behind the window.
        page.keyboard.press("Enter")
        expect(window).to_be_hidden(timeout=TIMEOUT_MS)
        refusal = page.locator(".wb-bad-text").filter(has_text="was not allowed to run")
        expect(refusal.first).to_be_visible(timeout=TIMEOUT_MS)

        page.get_by_role("tab", name="Review").click()
        live.click()
        expect(window).to_be_visible(timeout=TIMEOUT_MS)
        # A page that opens later or reloads shows the question too.
        page.reload(wait_until="commit")
        expect(window).to_contain_text(str(file), timeout=TIMEOUT_MS)
        text = window.get_by_text("open(__file__")
        expect(text).to_be_hidden()
        expect(window.get_by_role("button", name=DO_NOT)).to_be_focused()
        page.keyboard.press("Shift+Tab")  # file names come after the buttons, as the last elements
        page.keyboard.press("Enter")
        expect(text).to_be_visible()
        page.keyboard.press("Escape")
        expect(window).to_be_hidden(timeout=TIMEOUT_MS)
        assert not mark.exists()

        live.click()
        expect(window).to_contain_text("every save of this file")
        page.get_by_role("button", name=ONCE).click()
        expect(page.get_by_text("every body has its recorded pose")).to_be_visible(timeout=TIMEOUT_MS)
        assert mark.exists()
        assert not [error for error in errors if "non-existent component" not in error]
