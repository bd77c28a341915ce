"""The page in a real Chromium, driven as a person drives it, on the example task."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, expect

from tests.browser.conftest import RECORDINGS, At
from tests.drive.desk import Desk
from tests.drive.page import TASK
from tests.drive.studio import picture
from tests.drive.waiting import until
from tests.episodes.verify_rrd import verify_rrd
from workbench.machine.files import replace_file

pytestmark = pytest.mark.browser


DRAWN = "        self.drawn = torch.rand((self.num_envs, 2))\n"


@pytest.fixture(scope="module")
def desk(example: At, browser: Browser) -> Iterator[Desk]:
    with example(browser) as desk:
        yield desk


@pytest.fixture
def calm(desk: Desk) -> Desk:
    """The desk with the good file, paused at the start of an episode, on the Run tab."""
    good = TASK.read_text()
    if desk.file.read_text() != good:
        desk.file.write_text(good)
    expect(
        desk.page.get_by_text("paused", exact=True).or_(desk.page.get_by_text("running", exact=True))
    ).to_be_visible()
    desk.tab("Run")
    if desk.button("Pause").count():
        desk.button("Pause").click()
    expect(desk.button("Play")).to_be_visible()
    desk.button("Reset all").click()
    return desk


def test_the_page_opens_with_the_task_and_without_an_error(desk: Desk) -> None:
    expect(desk.page.get_by_text("WorkbenchPushCube-v1")).to_be_visible()
    expect(desk.page.get_by_text("2 envs on cpu (batched)")).to_be_visible()
    assert desk.page.title() == "WorkbenchPushCube-v1 · Workbench"
    assert "token" not in desk.page.url
    assert desk.page.locator("canvas").count() >= 1
    assert desk.errors == []


def test_play_runs_and_pause_stops(calm: Desk) -> None:
    calm.button("Play").click()
    expect(calm.page.get_by_text("running", exact=True)).to_be_visible()
    calm.tab("Reward")
    until(lambda: calm.elapsed() >= 3, "three steps")
    calm.tab("Run")
    calm.button("Pause").click()
    expect(calm.page.get_by_text("paused", exact=True)).to_be_visible()
    calm.tab("Reward")
    stopped = calm.elapsed()
    time.sleep(1.0)  # in which it would have gone on
    assert calm.elapsed() == stopped


def test_the_sensor_and_human_pictures_arrive(calm: Desk) -> None:
    calm.tab("Cameras")
    expect(calm.page.get_by_text("base_camera")).to_be_visible()
    expect(calm.page.get_by_text(re.compile(r"rendered in \d+ ms")).first).to_be_visible()
    until(lambda: calm.page.locator("img").count() >= 2, "two pictures")


def test_a_moment_of_the_past_that_one_stands_still_at_is_drawn(calm: Desk) -> None:
    calm.tab("Reward")
    calm.press("s", "s", "s")
    calm.comes_to(3)
    calm.tab("Cameras")
    until(lambda: picture(calm.page), "a picture", 90)
    time.sleep(1.0)  # the one of the last step is the last to come
    live = picture(calm.page)
    calm.leave_inputs()
    calm.press("Shift+ArrowLeft")
    until(lambda: picture(calm.page) not in ("", live), "another picture")
    calm.press("End")
    until(lambda: picture(calm.page) == live, "the picture of now")


@pytest.mark.slow
def test_a_patch_keeps_the_step_and_says_so_and_a_rebuild_can_be_asked_for(calm: Desk) -> None:
    calm.button("Step").click()
    calm.tab("Reward")
    until(lambda: calm.elapsed() == 1, "the step")
    before = float(calm.row("reward")[1])
    good = calm.file.read_text()
    # At once: Python writes a text of 10 kB in two parts, which a busy machine may take for two saves.
    replace_file(calm.file, good.replace("return reward\n", "return reward + 3\n", 1).encode())
    until(lambda: abs(float(calm.row("reward")[1]) - before - 1) < 0.01, "the reward of the same step")
    assert calm.elapsed() == 1
    calm.tab("Run")
    expect(
        calm.page.get_by_text("only compute_dense_reward changed").locator("visible=true").first
    ).to_be_visible()
    calm.button("Rebuild the scene").click()
    expect(calm.page.get_by_text("rebuilt was requested").locator("visible=true").first).to_be_visible()
    calm.tab("Reward")
    assert calm.elapsed() == 1
    calm.file.write_text(good)
    until(lambda: abs(float(calm.row("reward")[1]) - before) < 0.01, "the good version")


def test_a_broken_edit_shows_a_banner_and_the_last_good_version_stays_usable(calm: Desk) -> None:
    lines = TASK.read_text().splitlines()
    place = next(i for i, line in enumerate(lines) if '"cube_to_goal"' in line)
    lines[place] = lines[place].replace('"cube_to_goal"', '"cube_to_goal_" + 1')
    calm.file.write_text("\n".join(lines))
    banner = calm.page.locator(".wb-banner").get_by_text(re.compile(rf"push_cube\.py:{place + 1}\b"))
    expect(banner.first).to_be_visible()
    expect(calm.page.get_by_text("TypeError").first).to_be_visible()
    expect(calm.page.get_by_text("last good version").first).to_be_visible()
    assert f"push_cube.py:{place + 1}" in calm.opened.wait_for_line("TypeError")
    calm.tab("Reward")
    before = calm.elapsed()
    calm.tab("Run")
    calm.button("Step").click()
    calm.tab("Reward")
    until(lambda: calm.elapsed() == before + 1, "a step of the last good version")
    calm.file.write_text(TASK.read_text())
    expect(banner).to_have_count(0)


LIES_BESIDE = """() => {
    const view = document.querySelector("canvas[data-engine]").parentElement.getBoundingClientRect();
    const floating = [...document.querySelectorAll(".mantine-Paper-root")]
        .filter((panel) => panel.querySelector(".wb-banner, .wb-timeline"))
        .map((panel) => panel.getBoundingClientRect()).filter((box) => box.width);
    return [floating.length, floating.every((box) => box.left >= view.left - 1 && box.right <= view.right + 1)];
}"""


@pytest.mark.slow
def test_banner_and_timeline_are_as_narrow_as_the_view_and_cover_no_control(calm: Desk) -> None:
    page = calm.page
    calm.file.write_text("raise ValueError('not now')\n")
    expect(page.get_by_text("not now").first).to_be_visible()
    before = page.viewport_size
    assert before is not None
    for width in (1280, 760, 1000):
        page.set_viewport_size({"width": width, "height": before["height"]})
        until(lambda: page.evaluate(LIES_BESIDE) == [2, True], f"both beside the controls at {width} pixels")
    page.set_viewport_size(before)


@pytest.mark.slow
def test_the_mark_of_a_rule_that_only_warns_stands_until_the_file_is_mended(calm: Desk) -> None:
    text = TASK.read_text()
    hook = text.index("def _initialize_episode")
    body = text.index("        with torch.device(self.device):\n", hook)
    broken = text[:body] + DRAWN + text[body:]
    line = broken[: broken.index(DRAWN)].count("\n") + 1
    calm.tab("Reward")
    calm.file.write_text(broken)
    mark, row = calm.page.locator(".wb-rules-mark"), calm.page.locator(".wb-check")
    expect(mark).to_contain_text("1 finding")
    told = rf"warning .*push_cube\.py:{line}: self\.drawn is changed in env 1"
    calm.opened.wait_for_line(told)
    mark.click()
    expect(calm.page.get_by_role("tab", name="Checks 1")).to_have_attribute("aria-selected", "true")
    expect(row).to_contain_text(f"push_cube.py:{line}")
    expect(row).to_contain_text("self.drawn = torch.rand((self.num_envs, 2))")
    calm.file.write_text(text)
    expect(mark).to_be_hidden()
    expect(calm.page.get_by_text("paused", exact=True)).to_be_visible()
    assert sum(bool(re.search(told, printed)) for printed in calm.opened.lines) == 1


@pytest.mark.slow
def test_record_keeps_an_episode(calm: Desk) -> None:
    recordings = calm.file.parent / RECORDINGS
    before = set(recordings.glob("*.rrd"))  # by tests of another file that shares the server
    calm.tab("Episodes")
    calm.button("Record").click()
    stop = calm.page.get_by_role("button", name=re.compile("Stop"))
    expect(stop).to_be_visible()
    calm.press("s", "s", "s")
    expect(calm.page.get_by_text("env 0: step 3").first).to_be_visible()
    stop.click()
    until(lambda: set(recordings.glob("*.rrd")) - before, "the file")
    (written,) = set(recordings.glob("*.rrd")) - before
    assert verify_rrd(written) is None
    expect(calm.page.get_by_text(written.name).first).to_be_visible()


def test_nothing_went_wrong_in_the_console(desk: Desk) -> None:
    assert desk.errors == []
