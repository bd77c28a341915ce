"""A page behind a slow line stays usable while many envs play."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect

from tests.drive.far_line import line_to
from tests.drive.page import TASK, open_workbench, page_at

pytestmark = [pytest.mark.browser, pytest.mark.slow]
BITS_PER_SECOND, DELAY_SECONDS = 2e6, 0.04


def test_play_and_pause_answer_and_nothing_queues_for_seconds(tmp_path: Path, browser: Browser) -> None:
    file = shutil.copy(TASK, tmp_path)
    with (
        open_workbench(str(file), "--num-envs", "64", "--no-spare", cwd=tmp_path) as opened,
        line_to(opened.url, BITS_PER_SECOND, DELAY_SECONDS) as line,
        page_at(browser, line.address(opened.url)) as (page, errors),
    ):
        # The slow line first has to transfer the page and all meshes.
        expect(page.locator(".wb-status").get_by_text("paused", exact=True)).to_be_visible(timeout=240_000)
        most, before = 0, line.down
        for _ in range(3):
            page.get_by_role("button", name="Play", exact=True).click()
            for _ in range(100):
                page.wait_for_timeout(10)  # sample the line
                most = max(most, line.waiting)
            expect(page.get_by_role("button", name="Pause", exact=True)).to_be_visible()
            page.get_by_role("button", name="Pause", exact=True).click()
            expect(page.get_by_role("button", name="Play", exact=True)).to_be_visible()
        assert line.down - before > 20_000, "the envs played"
        # One message may be large; without a limit the socket would take megabytes.
        assert most < 2 * BITS_PER_SECOND / 8, (
            f"{8 * most / BITS_PER_SECOND:.1f} s of the line's capacity were queued"
        )
        assert not errors
