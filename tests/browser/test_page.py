"""The page in a real Chromium, used as by a user, on the example task."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, expect

from tests.browser.conftest import At
from tests.drive.desk import Desk
from tests.drive.page import TASK
from tests.drive.studio import picture
from tests.drive.waiting import until
from workbench.machine.files import replace_file

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def desk(example: At, browser: Browser) -> Iterator[Desk]:
    with example(browser) as desk:
        yield desk
        assert desk.errors == []


@pytest.fixture
def at_start(desk: Desk) -> Desk:
    """The desk with the correct file, paused at the start of an episode, on the Run tab."""
    good = TASK.read_text()
    if desk.file.read_text() != good:
        desk.file.write_text(good)
    expect(
        desk.page.locator(".wb-status")
        .get_by_text("paused", exact=True)
        .or_(desk.page.locator(".wb-status").get_by_text("running", exact=True))
    ).to_be_visible()
    desk.tab("Run")
    desk.pause()
    desk.button("Reset all").click()
    return desk


def test_the_page_opens_with_the_task(desk: Desk) -> None:
    expect(desk.page.get_by_text("WorkbenchPushCube-v1")).to_be_visible()
    expect(desk.page.get_by_text("2 envs on cpu (batched)")).to_be_visible()
    assert desk.page.title() == "WorkbenchPushCube-v1 · Workbench"
    assert "token" not in desk.page.url
    assert desk.page.locator("canvas").count() >= 1


def test_play_runs_and_pause_stops(at_start: Desk) -> None:
    at_start.button("Play").click()
    expect(at_start.page.locator(".wb-status").get_by_text("running", exact=True)).to_be_visible()
    at_start.tab("Reward")
    until(lambda: at_start.elapsed() >= 3, "three steps")
    at_start.tab("Run")
    at_start.button("Pause").click()
    expect(at_start.page.locator(".wb-status").get_by_text("paused", exact=True)).to_be_visible()
    at_start.tab("Reward")
    stopped = at_start.elapsed()
    time.sleep(1.0)  # time in which it would have continued
    assert at_start.elapsed() == stopped


def test_the_sensor_and_human_pictures_arrive(at_start: Desk) -> None:
    at_start.tab("Cameras")
    at_start.page.get_by_text("All pictures", exact=True).click()
    expect(at_start.page.get_by_text("base_camera · sensor").last).to_be_visible()
    expect(at_start.page.get_by_text(re.compile(r"rendered in \d+ ms")).first).to_be_visible()
    until(lambda: at_start.page.locator("img").count() >= 2, "two pictures")


def test_a_past_moment_is_drawn_when_the_slider_rests_on_it(at_start: Desk) -> None:
    at_start.tab("Reward")
    at_start.press("s", "s", "s")
    at_start.comes_to(3)
    at_start.tab("Cameras")
    until(lambda: picture(at_start.page), "a picture", 90)
    time.sleep(1.0)  # the picture of the last step is the last to arrive
    live = picture(at_start.page)
    at_start.leave_inputs()
    at_start.press("Shift+ArrowLeft")
    until(lambda: picture(at_start.page) not in ("", live), "another picture")
    at_start.press("End")
    until(lambda: picture(at_start.page) == live, "the picture of now")


@pytest.mark.slow
def test_a_patch_keeps_the_step_and_is_reported_and_a_rebuild_can_be_requested(at_start: Desk) -> None:
    at_start.button("Step").click()
    at_start.tab("Reward")
    until(lambda: at_start.elapsed() == 1, "the step")
    before = float(at_start.row("reward")[1])
    good = at_start.file.read_text()
    # In one write: Python writes 10 kB of text in two parts, which a busy machine may see as two saves.
    replace_file(at_start.file, good.replace("return reward\n", "return reward + 3\n", 1).encode())
    until(lambda: abs(float(at_start.row("reward")[1]) - before - 1) < 0.01, "the reward of the same step")
    assert at_start.elapsed() == 1
    at_start.tab("Run")
    expect(
        at_start.page.get_by_text("only compute_dense_reward changed").locator("visible=true").first
    ).to_be_visible()
    at_start.page.get_by_text("Reload by hand", exact=True).click()
    at_start.button("Rebuild the scene").click()
    expect(at_start.page.get_by_text("rebuilt was requested").locator("visible=true").first).to_be_visible()
    at_start.tab("Reward")
    assert at_start.elapsed() == 1
    at_start.file.write_text(good)
    until(lambda: abs(float(at_start.row("reward")[1]) - before) < 0.01, "the good version")


def test_a_broken_edit_shows_a_banner_and_the_last_good_version_stays_usable(at_start: Desk) -> None:
    lines = TASK.read_text().splitlines()
    place = next(i for i, line in enumerate(lines) if '"cube_to_goal"' in line)
    lines[place] = lines[place].replace('"cube_to_goal"', '"cube_to_goal_" + 1')
    at_start.file.write_text("\n".join(lines))
    banner = at_start.page.locator(".wb-banner").get_by_text(re.compile(rf"push_cube\.py:{place + 1}\b"))
    expect(banner.first).to_be_visible()
    expect(at_start.page.get_by_text("TypeError").first).to_be_visible()
    expect(at_start.page.get_by_text("last good version").first).to_be_visible()
    assert f"push_cube.py:{place + 1}" in at_start.opened.wait_for_line("TypeError")
    at_start.tab("Reward")
    before = at_start.elapsed()
    at_start.tab("Run")
    at_start.button("Step").click()
    at_start.tab("Reward")
    until(lambda: at_start.elapsed() == before + 1, "a step of the last good version")
    at_start.file.write_text(TASK.read_text())
    expect(banner).to_have_count(0)


LAYOUT_OK_JS = """() => {
    const boxes = (found) => found.map((part) => part.getBoundingClientRect()).filter((box) => box.width);
    const docks = boxes([...document.querySelectorAll("[data-dock-region]")]);
    const floating = boxes([...document.querySelectorAll(".mantine-Paper-root")]
        .filter((panel) => panel.querySelector(".wb-banner, .wb-timeline")));
    const apart = (a, b) => a.right <= b.left + 1 || b.right <= a.left + 1 || a.bottom <= b.top + 1 || b.bottom <= a.top + 1;
    return [floating.length, floating.every((box) => docks.every((dock) => apart(box, dock)))];
}"""


@pytest.mark.slow
def test_banner_and_timeline_cover_no_dock(at_start: Desk) -> None:
    page = at_start.page
    at_start.file.write_text("raise ValueError('not now')\n")
    expect(page.get_by_text("not now").first).to_be_visible()
    before = page.viewport_size
    assert before is not None
    for width in (1280, 760, 1000):
        page.set_viewport_size({"width": width, "height": before["height"]})
        until(lambda: page.evaluate(LAYOUT_OK_JS) == [2, True], f"both beside the docks at {width} pixels")
    page.set_viewport_size(before)
