"""The author's code hangs and dies under an open page, in a real Chromium."""

from __future__ import annotations

import re
from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, expect

from tests.drive.desk import Desk
from tests.drive.page import page_on
from tests.drive.waiting import until
from tests.live.hazards import calm, provoke, write_task

pytestmark = [pytest.mark.browser, pytest.mark.slow]
ARGUMENTS = "--num-envs 2 --env render_backend=none".split()
"""Without pictures there are no shaders to compile."""


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory, browser: Browser) -> Iterator[Desk]:
    file = write_task(tmp_path_factory.mktemp("author"))
    with page_on(file, *ARGUMENTS, browser=browser) as (page, errors, opened):
        yield Desk(page, errors, file, opened)


def test_a_loop_shows_a_banner_that_can_interrupt_it_with_its_traceback(desk: Desk) -> None:
    desk.tab("Run")
    provoke(desk.file, "evaluate", "loop")
    desk.button("Step").click()
    expect(desk.page.get_by_text("busy", exact=True)).to_be_visible()
    expect(
        desk.page.get_by_text(re.compile(r"has been in evaluate for \d+ s — risky\.py:\d+"))
    ).to_be_visible()
    # The page's own controls keep working.
    desk.button("Next env").click()
    until(lambda: "env 1: step" in desk.page.inner_text("body"), "the next env")
    desk.button("Interrupt").click()
    expect(desk.page.get_by_text(re.compile("was interrupted in evaluate"))).to_be_visible()
    expect(desk.button("Interrupt")).to_be_hidden()
    desk.page.get_by_text("The whole traceback").click()
    expect(desk.page.get_by_text(re.compile(r'hazard\("evaluate"\)')).first).to_be_visible()
    calm(desk.file)
    desk.button("Step").click()
    expect(desk.page.get_by_text(re.compile("was interrupted in evaluate"))).to_have_count(0)


def test_restart_ends_uninterruptible_work(desk: Desk) -> None:
    desk.tab("Run")
    at = re.search(r"step \d+ / \d+", desk.page.locator(".wb-timeline").inner_text())
    assert at is not None
    where = at[0]
    provoke(desk.file, "evaluate", "native")
    desk.button("Step").click()
    desk.button("Interrupt").click()
    expect(desk.page.get_by_text(re.compile("did not stop when it was interrupted"))).to_be_visible()
    expect(desk.button("Interrupt")).to_be_hidden()
    calm(desk.file)
    desk.button("Restart").click()
    expect(desk.page.locator(".wb-status").get_by_text("paused", exact=True)).to_be_visible()
    desk.timeline_says(where)
    assert desk.opened.wait_for_line("worker failed.*stopped by the user in evaluate")
