"""The timeline in a real Chromium: slider, keys, going back, undo."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, expect

from tests.browser.conftest import At
from tests.drive.desk import Desk
from tests.drive.waiting import until
from workbench.live.panels.timeline_panel import RANGE_PERIOD_SECONDS

pytestmark = [pytest.mark.browser, pytest.mark.slow]
STEPS = 8
SLIDER = "[name='slider.seek_back.steps'][type=range]"


@pytest.fixture(scope="module")
def opened(example: At, browser: Browser) -> Iterator[Desk]:
    with example(browser) as desk:
        desk.tab("Reward")
        expect(desk.page.get_by_text("elapsed steps")).to_be_visible()
        yield desk
        assert desk.errors == []


@pytest.fixture
def desk(opened: Desk) -> Desk:
    """The desk, live, eight steps into an episode of seed 0, without a focused input."""
    opened.leave_inputs()
    opened.press("End", "Shift+R")
    opened.comes_to(0)
    for step in range(1, STEPS + 1):
        opened.press("s")
        opened.comes_to(step)
    opened.timeline_says("live")
    time.sleep(RANGE_PERIOD_SECONDS)  # a later update of the slider's range would override a drag
    return opened


def test_arrow_keys_move_through_the_past_and_end_is_live(desk: Desk) -> None:
    desk.press("ArrowLeft", "ArrowLeft", "ArrowLeft")
    desk.comes_to(STEPS - 3)
    desk.timeline_says("3 steps ago")
    expect(desk.page.get_by_text("past, 3 steps ago")).to_be_visible()
    desk.press("ArrowRight")
    desk.comes_to(STEPS - 2)
    desk.press("Shift+ArrowLeft")
    desk.comes_to(0)
    desk.press("End")
    desk.comes_to(STEPS)
    desk.timeline_says("live")
    desk.press("Shift+R")
    desk.comes_to(0)
    desk.press("Shift+U")
    desk.comes_to(STEPS)
    desk.press("Home")
    until(lambda: "past" in desk.page.locator(".wb-timeline").inner_text(), "the first moment")


def test_the_timeline_folds_to_a_transport_of_one_row_whose_strip_still_goes_to_the_past(desk: Desk) -> None:
    page = desk.page
    slider, play = page.get_by_label("step of the past").last, desk.button("Play")
    expect(slider).to_be_visible()
    opened = play.bounding_box()
    desk.press("t")
    expect(slider).to_be_hidden()
    strip, folded = desk.box(".wb-strip"), desk.box("[data-floating-window]:has(.wb-transport)")
    closed = play.bounding_box()
    assert folded["height"] <= 61 and strip["height"] > 40
    assert closed is not None and opened is not None and closed["x"] == opened["x"]
    page.mouse.click(strip["x"] + 1, strip["y"] + 20)
    until(lambda: "past" in page.locator(".wb-timeline").inner_text(), "the first moment")
    desk.press("End", "t")
    expect(slider).to_be_visible()


def test_the_slider_moves_to_a_click_and_an_arrow_counts_once(desk: Desk) -> None:
    desk.page.get_by_role("button", name="this episode").click()
    expect(desk.page.locator(SLIDER)).to_have_attribute("min", str(-STEPS))
    # Playwright's click waits until the panel, whose height has changed, is stable.
    desk.page.locator(SLIDER).last.click()
    desk.comes_to(STEPS // 2)
    time.sleep(1.5)  # right after a touch the slider counts as the receiver of the key
    desk.page.keyboard.press("ArrowLeft")
    desk.comes_to(STEPS // 2 - 1)
    time.sleep(1.5)  # a second step, by a slider that also takes the key, would have arrived by now
    assert desk.elapsed() == STEPS // 2 - 1
    desk.page.get_by_role("button", name="all episodes").click()


def test_keys_work_after_a_click_on_a_tab_or_a_dropdown_but_not_in_a_field(desk: Desk) -> None:
    page = desk.page
    page.get_by_role("tab", name="Inspect").click()
    page.keyboard.press("Space")
    page.get_by_role("tab", name="Run").click()
    expect(page.get_by_role("button", name="Pause", exact=True)).to_be_visible()
    page.keyboard.press("Space")
    expect(page.get_by_role("button", name="Play", exact=True)).to_be_visible()
    reward = page.get_by_role("tab", name="Reward")
    reward.click()
    page.keyboard.press("Shift+R")
    desk.comes_to(0)
    page.keyboard.press("s")
    desk.comes_to(1)
    desk.press("ArrowLeft")
    desk.comes_to(0)
    desk.press("ArrowRight")
    desk.comes_to(1)
    expect(reward).to_have_attribute("aria-selected", "true")
    page.get_by_role("tab", name="Inspect").click()
    shown = page.get_by_label("Show", exact=True).locator("visible=true").last
    shown.select_option(label="contacts")
    shown.click()
    page.keyboard.press("Escape")  # a list that is closed again takes no letters
    page.keyboard.press("Shift+R")
    expect(page.get_by_text("known after the next step")).to_be_visible()
    field = page.get_by_label("step of the past").last
    field.click()
    page.keyboard.press("s")
    desk.leave_inputs()
    page.keyboard.press("s")
    expect(page.get_by_text("env 0 at step 1 of its episode")).to_be_visible()
    reward.click()
