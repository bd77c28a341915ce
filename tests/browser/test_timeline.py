"""The timeline in a real Chromium: slider, keys, going back, undo."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, Locator, expect

from tests.browser.conftest import At
from tests.drive.desk import Desk
from tests.drive.waiting import until
from workbench.live.panels.timeline_panel import RANGE_PERIOD_SECONDS

pytestmark = pytest.mark.browser
STEPS = 8
SLIDER = "[name='slider.seek_back.steps'][type=range]"


@pytest.fixture(scope="module")
def opened(example: At, browser: Browser) -> Iterator[Desk]:
    with example(browser) as desk:
        desk.tab("Reward")
        expect(desk.page.get_by_text("elapsed steps")).to_be_visible()
        yield desk


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
    wait_for_the_range()
    return opened


def wait_for_the_range() -> None:
    """Wait until the slider's range is updated: a later update would override a drag."""
    time.sleep(RANGE_PERIOD_SECONDS)


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
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


def empty(field: Locator) -> None:
    def emptied() -> bool:
        # The server's update of the last number may arrive in between and remove the selection.
        field.press("Control+a")
        field.press("Delete")
        return field.input_value() == ""

    until(emptied, "an empty field")


@pytest.mark.slow
def test_a_number_is_committed_when_complete_and_an_invalid_one_is_reverted(desk: Desk) -> None:
    page = desk.page
    rejection, past = (
        page.locator(".wb-not-taken").last,
        page.get_by_label("step of the past"),
    )
    page.get_by_role("tab", name="Run").click()
    seed = page.get_by_label("Seed", exact=True)
    for typed, says in (
        ("9223372036854775807", "Seed: it must be from 0 to 2147483647. It stays 0."),
        ("-99999999999999999999999", "Seed: it must be from 0 to 2147483647. It stays 0."),
        ("3.7", "Seed: 3.7 is not a whole number. It stays 0."),
        ("1e400", "Seed: it must be from 0 to 2147483647. It stays 0."),
        ("abc", "Seed: \u201cabc\u201d is not a number. It stays 0."),
        ("", "Seed: it was left empty. It stays 0."),
    ):
        seed.press("Control+a")
        page.keyboard.press("Delete")
        # In one go: the field resets its caret some time after a key, so on a busy machine digits
        # typed right after the first would land behind it.
        page.keyboard.insert_text(typed)
        expect(seed).to_have_value(typed)
        page.keyboard.press("Tab" if typed == "abc" else "Enter")
        expect(rejection).to_have_text(says)
        expect(seed).to_have_value("0")
    seed.press("Control+a")
    page.keyboard.insert_text("12")
    time.sleep(1.0)  # longer than a seed's debounce: every env would have been reset
    expect(seed).to_have_value("12")
    desk.timeline_says(f"step {STEPS} /")
    page.keyboard.press("Escape")
    expect(seed).to_have_value("0")
    seed.press("ArrowUp")
    desk.timeline_says("step 0 /")
    expect(seed).to_have_value("1")
    empty(seed)
    page.keyboard.insert_text("1e2")
    page.keyboard.press("ArrowUp")
    expect(seed).to_have_value("101")
    empty(seed)
    page.keyboard.type("0")
    page.get_by_role("tab", name="Reward").click()
    desk.leave_inputs()
    time.sleep(1.0)  # longer than a seed's debounce
    wait_for_the_range()
    page.get_by_role("tab", name="Run").click()
    expect(seed).to_have_value("0")

    past.filter(visible=True).last.fill("7")
    page.keyboard.press("Enter")
    expect(rejection).to_have_text(
        re.compile(r"^step of the past: it must be from -\d+ to 0\. It stays 0\.$")
    )
    past.filter(visible=True).last.fill("-2")
    page.keyboard.press("Enter")
    desk.timeline_says("2 steps ago")
    page.get_by_role("tab", name="Reward").click()


def test_the_console_has_no_errors(opened: Desk) -> None:
    assert opened.errors == []
