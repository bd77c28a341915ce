"""A running recording and a moved camera are visible on every tab; plain letters change neither."""

from __future__ import annotations

import re
from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, Locator, expect

from tests.browser.conftest import RECORDINGS, At
from tests.drive.desk import Desk
from tests.drive.studio import HEIGHT, WIDTH, end_of_the_left_arrow, numbers
from tests.drive.waiting import until
from tests.episodes.verify_rrd import verify_rrd

pytestmark = [pytest.mark.browser, pytest.mark.slow]
TABS = ("Cameras", "Reward", "Inspect", "Try", "Checks", "Episodes", "Log", "Run")


@pytest.fixture(scope="module")
def desk(example: At, browser: Browser) -> Iterator[Desk]:
    with example(browser, WIDTH, HEIGHT) as desk:
        desk.tab("Run")
        yield desk
        assert not desk.errors


def expect_on_every_tab(desk: Desk, mark: Locator) -> None:
    """Expect the mark on every tab, also with the panel scrolled to its end."""
    desk.tab("Run")  # before the Cameras tab was opened for the first time
    desk.page.mouse.move(WIDTH - 150, HEIGHT - 100)
    desk.page.mouse.wheel(0, 3000)
    expect(desk.page.locator("[data-fold=View]")).to_be_in_viewport()
    expect(mark).to_be_in_viewport(ratio=1)
    desk.page.mouse.wheel(0, -3000)
    for tab in TABS:
        desk.tab(tab)
        expect(mark).to_be_visible()


def test_recording_is_shown_on_every_tab_and_in_the_title_and_its_file_is_named(desk: Desk) -> None:
    mark, folder = desk.page.locator(".wb-sight-rec"), desk.file.parent / RECORDINGS
    before = set(folder.glob("*.rrd"))
    desk.tab("Reward")
    desk.press("Shift+C")
    expect(mark).to_have_text(re.compile(r"REC\s+env 0 · 0 episodes · since \d\d:\d\d · stop"))
    expect(desk.page).to_have_title(re.compile("REC"))
    desk.press("n")
    expect(desk.page.get_by_role("columnheader", name="env 1")).to_be_visible()
    expect(mark).to_have_attribute("title", re.compile("The selected env 1 is not recorded"))
    expect_on_every_tab(desk, mark)
    desk.press("p", "s", "s", "Shift+R")
    expect(mark).to_contain_text("1 episode ")
    mark.get_by_text("stop").click()
    expect(mark).to_have_count(0)
    expect(desk.page).not_to_have_title(re.compile("REC"))
    desk.tab("Episodes")
    (written,) = until(lambda: set(folder.glob("*.rrd")) - before, "the file")
    assert verify_rrd(written) is None
    expect(desk.page.get_by_text(written.name).first).to_be_visible()


def test_a_moved_camera_is_shown_until_it_is_reset(desk: Desk) -> None:
    mark = desk.page.locator(".wb-sight-moved")
    desk.tab("Cameras")
    until(lambda: end_of_the_left_arrow(desk.page) is not None, "the handles")
    x, y = end_of_the_left_arrow(desk.page) or (0.0, 0.0)
    expect(mark).to_have_count(0)
    # On another tab there is no handle: a drag there moves the view.
    desk.tab("Run")
    until(lambda: end_of_the_left_arrow(desk.page) is None, "a view without handles")
    desk.page.mouse.move(x, y)
    desk.page.mouse.down()
    desk.page.mouse.move(x + 40, y, steps=4)
    desk.page.mouse.up()
    desk.press("Alt+ArrowUp")
    desk.tab("Cameras")
    until(lambda: numbers(desk.page, "Position") == [0.45, 0, 0.6], "where the file has it")
    desk.leave_inputs()
    desk.press("Alt+ArrowUp")
    expect(mark).to_contain_text("camera moved: base_camera")
    expect_on_every_tab(desk, mark)
    # Nor after the review: both switches rebuild the whole page.
    desk.switch_to("review")
    expect(desk.page.get_by_text("Library", exact=True).first).to_be_visible()
    desk.switch_to("live")
    expect(mark).to_be_visible()
    assert end_of_the_left_arrow(desk.page) is None
    text = desk.file.read_text()
    mark.get_by_text("save").click()
    expect(desk.page.locator(".wb-diff-add")).to_be_visible()
    assert desk.file.read_text() == text
    desk.button("Discard the change").click()
    mark.get_by_text("undo").click()
    expect(mark).to_have_count(0)
    until(lambda: numbers(desk.page, "Position") == [0.45, 0, 0.6], "where the file has it")
