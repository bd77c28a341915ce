"""Bodies, joints, an arm and a spawn range dragged, and episodes driven by keys and a gamepad, in a real Chromium."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from playwright.sync_api import Browser, expect

from tests.drive.desk import Desk
from tests.drive.page import page_on
from tests.drive.studio import HEIGHT, VIEW, WIDTH, end_of_green, numbers, press, view
from tests.drive.waiting import until

pytestmark = [pytest.mark.browser, pytest.mark.slow]
TCP = "panda/panda_hand_tcp"
SEED = 283
"""With this seed the cube is in front of the hand, 9 cm ahead of it along x."""
RECORDINGS = "kept"
DRAG_ERROR = "Unable to preventDefault inside passive event listener"
"""viser calls it at each press on a body that can be dragged; it has no effect."""


@pytest.fixture(scope="module")
def opened(task_file: Path, browser: Browser) -> Iterator[Desk]:
    env = ("--env", "control_mode=pd_ee_delta_pos", "--env", "robot_init_qpos_noise=0")
    arguments = ("--num-envs", "2", "--seed", str(SEED), *env, "--recordings", RECORDINGS)
    with page_on(task_file, *arguments, browser=browser, width=WIDTH, height=HEIGHT) as (
        page,
        errors,
        command,
    ):
        desk = Desk(page, errors, task_file, command)
        desk.tab("Run")
        desk.choose("choose_actions", "hold still")
        desk.choose("choose_episode_end", "keep running")
        yield desk
        assert [error for error in errors if DRAG_ERROR not in error] == []


@pytest.fixture
def desk(opened: Desk) -> Desk:
    """The desk, paused at the first step of an episode, with the view from the front."""
    opened.pause()
    opened.leave_inputs()
    opened.press("f", "Shift+R")
    opened.timeline_says("step 0 /")
    return opened


def middle_of(desk: Desk, colour: str) -> tuple[float, float]:
    """Middle in the page of the blue cube or of the red target, in pixels."""

    def pixels() -> NDArray[np.intp]:
        r, g, b = np.moveaxis(view(desk.page), -1, 0)
        blue, red = (b > 120) & (b - r > 70) & (g < 150), (r > 150) & (g < 100) & (abs(b - g) < 30)
        return np.argwhere(blue if colour == "blue" else red)

    until(lambda: len(pixels()) > 50, f"{colour} in the view")
    # The median: a camera's frustum also shows a picture of it.
    y, x = np.median(pixels(), axis=0)
    return float(x + VIEW["x"]), float(y + VIEW["y"])


def succeeds(desk: Desk) -> bool:
    """Whether the selected env succeeds, as the Reward tab shows it."""
    return desk.row("success")[1] == "yes"


def handles(desk: Desk, side: int) -> tuple[float, float]:
    """The end of the handles' green arrow, as `end_of_green`, once they rest where they belong."""
    return until(
        lambda: end if (end := end_of_green(desk.page, side)) == end_of_green(desk.page, side) else None,
        "the handles",
    )


def test_a_cube_that_is_dragged_to_the_target_while_the_envs_play_succeeds(desk: Desk) -> None:
    page = desk.page
    desk.select_body("cube")
    desk.tab("Reward")
    assert not succeeds(desk)
    # From higher up: a body is pulled in the plane that faces the eye, from low down thus into the table.
    page.mouse.move(500, 350)
    page.mouse.down()
    page.mouse.move(500, 387, steps=5)
    page.mouse.up()
    (x, y), (goal_x, goal_y) = middle_of(desk, "blue"), middle_of(desk, "red")
    desk.press("Space")
    page.mouse.move(x, y)
    page.mouse.down()
    # Friction holds the cube back: the pointer may have to go beyond the target.
    for share in np.arange(0.25, 2, 0.25):
        page.mouse.move(x + share * (goal_x - x), y + share * (goal_y - y))
        since = desk.elapsed()
        until(lambda since=since: desk.elapsed() >= since + 4, "the spring's pull")
        if succeeds(desk):
            break
    page.mouse.up()
    desk.button("Pause").click()
    assert succeeds(desk)


def test_handles_move_a_body_in_the_selected_env_only_and_undo_brings_it_back(desk: Desk) -> None:
    page = desk.page
    desk.select_body("cube")
    first = desk.body_position()
    desk.press("n")
    other = until(lambda: now if (now := desk.body_position()) != first else None, "the cube of env 1")
    desk.press("p", "m")
    before = until(lambda: now if (now := desk.body_position()) != other else None, "the cube of env 0")
    x, y = handles(desk, 1)
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 32, y, steps=4)
    page.mouse.up()
    until(lambda: desk.body_position()[1] > before[1] + 0.03, "the cube to move", seen=desk.body_position)
    assert desk.body_position()[::2] == before[::2], "only along the arrow"
    desk.press("n")
    until(lambda: desk.body_position() == other, "the cube of env 1 in its place", seen=desk.body_position)
    desk.press("p", "Shift+U")
    until(lambda: desk.body_position() == before, "the cube of env 0 back", seen=desk.body_position)
    desk.press("m")


def test_the_arm_follows_its_handles_while_the_envs_play(desk: Desk) -> None:
    page = desk.page

    def joint() -> float:
        cells = page.locator("tr", has=page.get_by_text("panda_joint1", exact=True)).filter(visible=True)
        return float(cells.locator("td").nth(1).inner_text())

    desk.select_body(TCP)
    before = desk.body_position()
    desk.press("i")
    # The hand points down: its y axis points left.
    x, y = handles(desk, -1)
    desk.press("Space")
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x - 32, y, steps=4)
    # While the mouse button is still down.
    until(lambda: desk.body_position()[1] < before[1] - 0.05, "the hand to follow", seen=desk.body_position)
    page.mouse.up()
    desk.choose("choose_inspected", "joints")
    until(lambda: joint() < -0.05, "the first joint to turn", seen=joint)
    desk.leave_inputs()
    desk.press("i", "k")
    expect(page.locator(".wb-drives")).to_be_hidden()
    desk.button("Pause").click()


def test_a_side_of_the_spawn_range_follows_the_pointer(desk: Desk) -> None:
    page = desk.page
    desk.select_body("cube")
    press(page, "Spawn range")
    expect(page.get_by_text("y from, to", exact=True)).to_be_visible(timeout=120_000)
    until(lambda: numbers(page, "y from, to") == [-0.1, 0.1], "the range in the file")
    x, y = handles(desk, 1)
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 32, y, steps=4)
    # While the mouse button is still down.
    until(lambda: numbers(page, "y from, to")[1] > 0.12, "the number")
    page.mouse.up()
    assert numbers(page, "x from, to") == [-0.1, 0.1] and numbers(page, "y from, to")[0] == -0.1
    desk.leave_inputs()
    press(page, "Spawn range")
    expect(page.get_by_text("y from, to", exact=True)).to_be_hidden()


def test_a_dragged_slider_sets_its_joint_once_and_undo_takes_it_back(desk: Desk) -> None:
    desk.tab("Run")
    page = desk.page
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
    page.mouse.move(box["x"] + 0.8 * box["width"], y, steps=3)
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


def test_an_episode_that_is_driven_by_keys_to_success_is_kept_as_a_file(desk: Desk) -> None:
    page, folder = desk.page, desk.file.parent / RECORDINGS
    page.locator("select[name*='set_speed']").first.select_option(label="0.25 ×")
    desk.select_body(TCP)
    desk.press("k")
    sign = page.locator(".wb-drives")
    expect(sign).to_be_visible()
    desk.press("g")
    page.keyboard.down("q")
    until(lambda: desk.body_position()[2] < 0.03, "the hand behind the cube", seen=desk.body_position)
    page.keyboard.up("q")
    page.wait_for_timeout(700)
    height = desk.body_position()[2]
    page.wait_for_timeout(700)
    assert desk.body_position()[2] == pytest.approx(height, abs=0.005), "a released key holds still"
    desk.tab("Reward")
    desk.leave_inputs()
    # The view is from the front, on the right: towards the person and to the left is along x.
    page.keyboard.down("s")
    page.keyboard.down("a")
    until(lambda: succeeds(desk), "the cube in the target", seen=lambda: desk.row("cube_to_goal"))
    page.keyboard.up("s")
    page.keyboard.up("a")
    desk.press("c")
    (file,) = until(lambda: list(folder.glob("*.json")), "the file")
    (episode,) = json.loads(file.read_text())["episodes"]
    assert episode["episode_seed"] == SEED and episode["success"]
    sign.get_by_role("button", name="stop").click()
    expect(sign).to_be_hidden()
