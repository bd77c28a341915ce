"""A page that lost its server says so, with what to do."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect

from tests.drive.page import new_page, open_workbench

pytestmark = [pytest.mark.browser, pytest.mark.slow]


def test_a_server_that_is_gone_is_said_with_its_address(browser: Browser, tmp_path: Path) -> None:
    with open_workbench(str(tmp_path), cwd=tmp_path, what="review") as opened:
        page, _ = new_page(browser, drawn=False)  # it complains of the refused connection
        page.goto(opened.url)
        expect(page.get_by_text("Library", exact=True).first).to_be_visible()
        expect(page.get_by_role("alert").filter(has_text="127.0.0.1")).to_have_count(0)
        opened.process.send_signal(signal.SIGINT)
        gone = page.get_by_role("alert").filter(has_text=opened.url.split("/")[2])
        expect(gone).to_be_in_viewport()
        page.close()
