"""A new user's first steps in a real Chromium: hints, keys, clickable curves, tabs with content."""

from __future__ import annotations

import re
from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, expect

from tests.browser.conftest import At
from tests.drive.desk import Desk

pytestmark = [pytest.mark.browser, pytest.mark.slow]
STEPS = 12


@pytest.fixture(scope="module")
def opened(example_without_pictures: At, browser: Browser) -> Iterator[Desk]:
    with example_without_pictures(browser) as desk:
        yield desk
        assert desk.errors == []


@pytest.fixture
def desk(opened: Desk) -> Desk:
    """The desk on the Run tab, at the first step of an episode."""
    opened.leave_inputs()
    opened.tab("Run")
    opened.press("End", "Shift+R")
    opened.timeline_says("step 0 /")
    return opened


def test_a_question_mark_lists_the_keys_and_disables_them_meanwhile(desk: Desk) -> None:
    listed = desk.page.get_by_role("dialog", name="Keys")
    desk.press("?")
    expect(listed.get_by_text("Play or pause")).to_be_visible()
    desk.press("s", "Escape")
    expect(listed).to_have_count(0)
    desk.press("?", "?")
    expect(listed).to_have_count(0)
    desk.timeline_says("step 0 /")
    desk.press("s")
    desk.timeline_says("step 1 /")


def test_the_tooltip_of_a_button_names_its_key(desk: Desk) -> None:
    for name, key in (("Reset this env", "Shift+S"), ("Step back", "Left arrow")):
        expect(desk.button(name)).to_have_attribute("title", re.compile(re.escape(f"({key})")))
    desk.button("Play").hover()
    expect(desk.button("Play")).to_have_attribute("title", re.compile(re.escape("(Space)")))


def test_keys_work_again_after_leaving_a_field_or_clicking_the_view(desk: Desk) -> None:
    def selected() -> str:
        found = re.search(r"env \d", desk.page.locator(".wb-timeline").inner_text())
        return "" if found is None else found[0]

    view = desk.box("div:has(> canvas[data-engine])")
    seed = desk.page.get_by_label("Seed")
    seed.click()
    desk.press("Enter", "s")
    desk.timeline_says("step 1 /")
    # Find a place where a click selects another env.
    desk.press("o")
    places = [(view["x"] + view["width"] * x / 8, view["y"] + view["height"] * 0.28) for x in range(1, 8)]
    desk.page.keyboard.press("f")
    for place in places:
        desk.page.mouse.click(*place)
        desk.page.wait_for_timeout(300)
        if selected() != "env 0":
            break
    else:
        raise AssertionError("no click selects another env")
    desk.select_the_first_env()
    seed.click()
    desk.page.mouse.click(*place)
    desk.press("s")
    desk.timeline_says("step 2 /")
    desk.select_the_first_env()


def test_a_click_on_a_curve_shows_its_step(desk: Desk) -> None:
    for step in range(1, STEPS + 1):
        desk.press("s")
        desk.timeline_says(f"step {step} /")
    desk.tab("Reward")
    box = desk.page.locator(".wb-chart-area:visible").first.bounding_box()
    assert box is not None
    desk.page.mouse.click(box["x"] + box["width"] * 0.5, box["y"] + box["height"] * 0.5)
    expect(desk.page.get_by_text(re.compile("past, [1-9]")).first).to_be_visible()
    shown = desk.elapsed()
    assert 0 < shown < STEPS
    desk.press("End")
    desk.comes_to(STEPS)
