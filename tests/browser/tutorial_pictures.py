"""The pictures of the tutorial: the page after each step, with the files from the tutorial page itself."""

from __future__ import annotations

import re
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

from playwright.sync_api import expect

from tests.docs.walk import FILE, STEPS, after, mistake

if TYPE_CHECKING:
    from tests.browser.take_screenshots import Desk

SETTLE_SECONDS = 10.0
"""Time after a save in which even a busy machine has rebuilt the envs."""
CHECK_TIMEOUT_MS = 300_000
"""Timeout for checking all rules on a busy machine."""


def take_steps(desk: Desk) -> None:
    """Take the pictures of steps 1 to 9; the page shows the file after the first step."""
    page = desk.page
    desk.press("Space")
    time.sleep(8)
    desk.press("Space")
    desk.shoot("tutorial_begin", kind="webp")
    do(desk, 2)
    go_wrong(desk, 2)
    expect(page.get_by_text("robot-pose").locator("visible=true").first).to_be_visible(timeout=120_000)
    desk.shoot("tutorial_robot", kind="webp")
    do(desk, 3)
    desk.tab("Run")
    desk.press("Shift+R", "f")
    desk.shoot("tutorial_scene", kind="webp")
    do(desk, 4)
    desk.tab("Run")
    desk.press("Shift+R", "Shift+R", "Shift+R")
    desk.shoot("tutorial_episode", kind="webp")
    do(desk, 5)
    desk.tab("Reward")
    desk.press("Shift+R")
    desk.step(8)
    desk.shoot("tutorial_success", kind="webp")
    do(desk, 6)
    desk.tab("Inspect")
    desk.step(2)
    desk.choose("Show", "observation")
    cube = page.get_by_text("cube_pose").locator("visible=true").first
    expect(cube).to_be_visible()
    cube.scroll_into_view_if_needed()
    desk.shoot("tutorial_observation", kind="webp")
    do(desk, 7)
    desk.tab("Reward")
    desk.press("Shift+R")
    desk.step(30)
    desk.shoot("tutorial_reward", kind="webp")
    do(desk, 8)
    desk.tab("Cameras")
    desk.choose("Camera", "base_camera · sensor")
    expect(page.get_by_text("Show the change", exact=True)).to_be_visible()
    desk.press(*8 * ["Alt+ArrowLeft"], *8 * ["Alt+Shift+ArrowRight"])
    page.get_by_role("button", name="Show the change").click()
    write_it = page.get_by_role("button", name=re.compile("^Save to"))
    write_it.evaluate("e => e.scrollIntoView({block: 'end'})")
    desk.shoot("tutorial_camera", kind="webp")
    go_wrong(desk, 9)
    expect(page.get_by_text("rows-lost").locator("visible=true").first).to_be_visible()
    desk.shoot("tutorial_gpu", kind="webp")


def do(desk: Desk, number: int) -> None:
    """Save the file as it is after a step of the page."""
    save(desk, text_after(number))


def go_wrong(desk: Desk, number: int) -> None:
    """Save the file with the first mistake of a step."""
    first = next(fence for fence in STEPS[number - 1].fences if fence.language == "diff")
    save(desk, mistake(first, text_after(number)))


def save(desk: Desk, text: str) -> None:
    """Save, and return when the version is checked, with the Checks tab open."""
    desk.file.write_text(text)
    desk.tab("Checks")
    time.sleep(SETTLE_SECONDS)
    expect(desk.page.get_by_text("rules checked in")).to_be_visible(timeout=CHECK_TIMEOUT_MS)


def text_after(count: int) -> str:
    """The task's text after `count` steps."""
    with tempfile.TemporaryDirectory() as folder:
        after(count, Path(folder))
        return (Path(folder) / FILE).read_text()
