"""Takes the gallery's pictures, one per example: .venv/bin/python tests/browser/gallery_pictures.py [NAME ...]

Not a test. It opens each example on the real page and writes ``web_assets/screenshots/dark/gallery_NAME.webp`` and
``light/``. Names select from `VIEWS`; without any, all are taken, in about fifteen minutes.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from PIL import Image
from playwright.sync_api import Browser, Page, expect

sys.path.insert(0, str(Path(__file__).parents[2]))
from tests.browser.take_screenshots import POLICY, Desk, picture_of
from tests.drive.page import browser_at, close_notice, new_page, open_workbench, with_empty_settings
from workbench.machine.doctor import find_chromium, how_to_get_chromium

ROOT = Path(__file__).parents[2]
SOLVERS = ROOT / "tests" / "tasks" / "solvers.py"
SIZE = (1120, 780)
"""Size of the page in pixels; its timeline is cut off. Help pages show the picture a little smaller."""
MIDDLE = (390, 250)
"""Middle of the view above the timeline, in pixels."""
QUALITY = 70
HAND = ("--env", "control_mode=pd_ee_delta_pos")


@dataclass(frozen=True)
class View:
    """What is on the page when the picture is taken."""

    tab: str
    envs: int = 16
    steps: int = 20
    policy: str = ""
    """A function in `SOLVERS` or `POLICY`, as the page lists it; empty for random actions."""
    arguments: tuple[str, ...] = ()
    keys: tuple[str, ...] = ()
    """Keys to press at the end."""
    turned: tuple[int, int] = (0, 0)
    """Pixels by which the view is dragged, to rotate it."""
    nearer: int = 0
    """Notches of the mouse wheel."""
    show: str = ""
    """The Inspect tab's choice."""
    all_cameras: bool = False
    """Draw every camera, on the Cameras tab and in the view."""


ONE = ("o", "f")
"""Keys that show one env and frame it."""
VIEWS: dict[str, View] = {
    "minimal": View("Run"),
    "push_cube": View("Reward", 4, 13, "pusher.py:act", HAND, ONE, (-220, 0), 3),
    "articulated": View("Reward", 4, 24, "solvers.py:open_drawer", HAND, ONE, (-300, 0), 3),
    "two_robots": View("Reward", 4, 24, "solvers.py:lift_bar", HAND, ONE, (-220, 0), 2),
    "locomotion": View("Reward", 9, 40),
    "cameras": View("Cameras", 4, 4, keys=ONE, turned=(-220, 0), nearer=1, all_cameras=True),
    "custom_scene": View("Inspect", 4, 12, keys=ONE, turned=(-250, 0), nearer=3, show="bodies"),
    "different_objects": View("Reward", 9, nearer=1),
    "fail_conditions": View("Reward", 9, 40, nearer=1),
    "obs_history": View("Inspect", 4, 20, keys=ONE, turned=(-250, 0), nearer=2, show="observation"),
    "own_robot": View("Run", 4, 12, nearer=1),
    "reward_terms": View("Reward", 4, 22, "solvers.py:lift_cube", HAND, ONE, (-220, 0), 2),
    "swing_up": View("Reward", 9, 30),
    "task_state": View("Reward", 9, 12),
}


def take(browser: Browser, name: str, view: View) -> None:
    task = ROOT / "tasks" / f"{name}.py"
    with (
        folder_of_policies() as folder,
        open_workbench(
            str(task), "--num-envs", str(view.envs), "--no-spare", *view.arguments, cwd=folder
        ) as opened,
    ):
        page, _ = new_page(browser, *SIZE)
        page.goto(opened.url)
        expect(page.locator(".wb-status").get_by_text("paused", exact=True)).to_be_visible(timeout=180_000)
        close_notice(page)
        hints = page.get_by_text("close for good", exact=True)
        if hints.is_visible():
            hints.click()
        desk = Desk(page, task)
        if view.policy:
            desk.choose("Source", "policy")
            desk.choose("Known", view.policy)
            time.sleep(3)
        desk.step(view.steps)
        desk.tab(view.tab)
        if view.show:
            desk.choose("Show", view.show)
        if view.all_cameras:
            page.get_by_text("All pictures", exact=True).click()
            for tick in page.get_by_role("checkbox", name="rgb").all():
                tick.check(force=True)
            page.get_by_text("All pictures", exact=True).scroll_into_view_if_needed()
        desk.press(*view.keys)
        time.sleep(4)
        turn(page, view)
        desk.shoot(f"gallery_{name}", above_the_timeline, "webp", QUALITY)
        page.close()


def turn(page: Page, view: View) -> None:
    """Rotate the view by a drag and zoom it with the wheel."""
    x, y = MIDDLE
    page.mouse.move(x, y)
    if view.turned != (0, 0):
        page.mouse.down()
        page.mouse.move(x + view.turned[0], y + view.turned[1], steps=8)
        page.mouse.up()
        time.sleep(1)
    for _ in range(view.nearer):
        page.mouse.wheel(0, -100)
        time.sleep(0.3)


@contextmanager
def folder_of_policies() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as folder:
        for file in (SOLVERS, POLICY):
            shutil.copy(file, folder)
        yield Path(folder)


def above_the_timeline(page: Page) -> Image.Image:
    whole = picture_of(page)
    timeline = page.locator("[data-floating-window]:has(.wb-transport)").bounding_box()
    assert timeline is not None
    return whole.crop((0, 36, whole.width, int(timeline["y"])))


def main(names: list[str]) -> None:
    chromium = find_chromium()
    if chromium is None:
        sys.exit(how_to_get_chromium())
    unknown = set(names) - VIEWS.keys()
    if unknown:
        sys.exit(f"no such picture: {', '.join(sorted(unknown))}; there are {', '.join(VIEWS)}")
    with_empty_settings()
    for name, view in VIEWS.items():
        if not names or name in names:
            with browser_at(chromium) as browser:
                take(browser, name, view)


if __name__ == "__main__":
    main(sys.argv[1:])
