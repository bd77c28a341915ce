"""Driving with the real keyboard, and with a gamepad that the browser reports, in a real Chromium."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect

from tests.drive.desk import Desk
from tests.drive.page import page_on
from tests.drive.waiting import until

pytestmark = [pytest.mark.browser, pytest.mark.slow]


@pytest.fixture(scope="module")
def desk(task_file: Path, browser: Browser) -> Iterator[Desk]:
    arguments = ("--num-envs", "2", "--env", "render_backend=none")
    with page_on(task_file, *arguments, browser=browser) as (page, errors, opened):
        yield Desk(page, errors, task_file, opened)
        assert not errors


def test_held_keys_drive_the_hand_and_stop_gives_back(desk: Desk) -> None:
    desk.tab("Run")
    desk.choose("use_control_mode", "pd_ee_delta_pose")
    expect(desk.page.locator(".wb-status")).to_contain_text("pd_ee_delta_pose")
    desk.select_body("panda/panda_hand")
    before = desk.body_position()
    desk.press("k")
    sign = desk.page.locator(".wb-drives")
    expect(sign).to_be_visible()
    desk.page.keyboard.down("e")
    until(lambda: desk.body_position()[2] > before[2] + 0.03, "the hand to rise")
    desk.page.keyboard.up("e")
    desk.page.wait_for_timeout(700)
    height = desk.body_position()[2]
    desk.page.wait_for_timeout(700)
    assert desk.body_position()[2] == pytest.approx(height, abs=0.005), "a released key holds still"
    sign.get_by_role("button", name="stop").click()
    expect(sign).to_be_hidden()
    desk.button("Pause").click()


def test_a_dragged_slider_sets_its_joint_once_and_undo_takes_it_back(desk: Desk) -> None:
    desk.tab("Run")
    page = desk.page
    # Until then joints move, also after the press on Pause.
    expect(page.locator(".wb-status")).to_contain_text("paused")
    page.locator("[data-fold='Joints']").click()
    slider = page.locator("input[type=range][name$='panda.0']")
    number = page.locator("input[type=text][name$='panda.0']")
    expect(slider).to_be_visible(timeout=60_000)
    before = number.input_value()
    box = slider.bounding_box()
    assert box is not None
    y = box["y"] + box["height"] / 2
    page.mouse.move(box["x"] + box["width"] / 2, y)
    page.mouse.down()
    for share in (0.6, 0.7, 0.8):
        page.mouse.move(box["x"] + share * box["width"], y)
    page.mouse.up()
    until(lambda: float(number.input_value()) > 80, "the joint to follow")
    expect(page.locator(".wb-status")).to_contain_text("paused")
    desk.press("Shift+U")
    until(lambda: number.input_value() == before, "the joint to return")


PAD = """
window.pad = { connected: true, mapping: "standard", axes: [0, 0, 0, 0], buttons: Array.from({ length: 17 }, () => ({ value: 0 })) };
navigator.getGamepads = () => [null, window.pad];
"""


def test_a_gamepad_moves_the_hand_only_while_a_person_drives(desk: Desk) -> None:
    page = desk.page
    desk.tab("Run")
    desk.choose("choose_actions", "hold still")
    desk.select_body("panda/panda_hand")
    desk.press("Shift+R")  # after other tests the hand may be as high as it can get
    page.wait_for_timeout(1000)
    before = desk.body_position()[2]
    page.evaluate(PAD)
    page.evaluate("pad.axes[3] = -1")
    page.wait_for_timeout(1000)
    assert desk.body_position()[2] == pytest.approx(before, abs=0.005), "nobody drives"
    desk.press("k")
    until(lambda: desk.body_position()[2] > before + 0.03, "the hand to rise")
    page.evaluate("pad.axes[3] = 0")
    page.wait_for_timeout(1000)
    height = desk.body_position()[2]
    page.wait_for_timeout(700)
    assert desk.body_position()[2] == pytest.approx(height, abs=0.005), "a released stick holds still"
    desk.tab("Run")
    expect(page.get_by_text("gamepad connected")).to_be_visible()
    page.evaluate("pad.buttons[2].value = 1")
    expect(page.get_by_text("was discarded")).to_be_visible()
    page.evaluate("navigator.getGamepads = () => []")
    expect(page.get_by_text("gamepad connected")).to_be_hidden()
    desk.press("k")
    expect(page.locator(".wb-drives")).to_be_hidden()
