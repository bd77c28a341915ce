"""A page that lost its server shows a notice with what to do."""

from __future__ import annotations

import shutil
import signal
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect

from tests.drive.far_line import line_to
from tests.drive.page import TASK, new_page, open_tab, open_workbench
from tests.drive.waiting import until

pytestmark = [pytest.mark.browser, pytest.mark.slow]
NAME = "document.querySelector('[data-page]')?.dataset.page"
"""The name with which the server addresses the page; a page that reconnects gets another one."""


def test_a_lost_server_is_reported_with_its_address(browser: Browser, tmp_path: Path) -> None:
    with open_workbench(str(tmp_path), cwd=tmp_path, what="review") as opened:
        page, _ = new_page(browser, drawn=False)  # the console has errors about the refused connection
        page.goto(opened.url)
        expect(page.get_by_text("Library", exact=True).first).to_be_visible()
        expect(page.get_by_role("alert").filter(has_text="127.0.0.1")).to_have_count(0)
        opened.process.send_signal(signal.SIGINT)
        gone = page.get_by_role("alert").filter(has_text=opened.url.split("/")[2])
        expect(gone).to_be_in_viewport()
        page.close()


def test_a_reconnected_page_shows_no_notice_and_its_tab_and_env_and_its_commands_work(
    browser: Browser, tmp_path: Path
) -> None:
    task = shutil.copy(TASK, tmp_path)
    arguments = (str(task), "--num-envs", "2", "--env", "render_backend=none", "--no-spare")
    with open_workbench(*arguments, cwd=tmp_path) as opened:
        page, _ = new_page(browser, drawn=False)

        def expect_unchanged() -> None:
            expect(page.get_by_role("tab", name="Inspect")).to_have_attribute("aria-selected", "true")
            expect(page.get_by_text("live env 1").first).to_be_visible()

        with line_to(opened.url) as line:
            page.goto(line.address(opened.url))
            expect(page.locator(".wb-status").get_by_text("paused", exact=True)).to_be_visible(
                timeout=120_000
            )
            page.keyboard.press("n")
            open_tab(page, "Inspect")
            expect_unchanged()
        gone = page.get_by_role("alert").filter(has_text=str(line.port))
        expect(gone).to_be_in_viewport()
        page.wait_for_timeout(3000)  # time for retries
        expect(gone).to_have_count(1)
        name = page.evaluate(NAME)
        with line_to(opened.url, port=line.port):
            until(lambda: page.evaluate(NAME) not in (None, name), "the page's new name")
            expect(gone).to_have_count(0)
            expect_unchanged()
            page.keyboard.press("Space")
            expect(page.locator(".wb-status").get_by_text("running", exact=True).first).to_be_visible()
            page.keyboard.press("Space")
            expect(page.locator(".wb-status").get_by_text("paused", exact=True)).to_be_visible()
            expect_unchanged()
            expect(gone).to_have_count(0)
            page.close()
