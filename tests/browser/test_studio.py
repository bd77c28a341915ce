"""A camera placed with the real mouse in a real Chromium, and written into the author's file."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from playwright.sync_api import Browser, Locator, Page, expect

from tests.drive.page import page_on
from tests.drive.studio import (
    HEIGHT,
    VIEW,
    WIDTH,
    back_to_the_file,
    choose,
    end_of_the_left_arrow,
    numbers,
    picture,
    press,
    tool,
    view,
)
from tests.drive.waiting import until
from workbench.cameras.studio_panel import NO_CAMERA

pytestmark = [pytest.mark.browser, pytest.mark.slow]
FILE = "push_cube.py"
EYE = re.compile(
    r'look_at\(eye=\[([-\d., ]+)\], target=\[([-\d., ]+)\]\)\n +return \[CameraConfig\("base_camera"'
)


@pytest.fixture(scope="module")
def opened(task_file: Path, browser: Browser) -> Iterator[Page]:
    with page_on(task_file, "--num-envs", "2", browser=browser, width=WIDTH, height=HEIGHT) as (
        page,
        errors,
        _,
    ):
        page.get_by_role("tab", name="Cameras").click()
        # The tab opens with the first sensor camera chosen.
        expect(page.get_by_label("Camera", exact=True).locator("option:checked")).to_have_text(
            "base_camera · sensor"
        )
        page.get_by_text("Handles and preview", exact=True).click()
        yield page
        assert not errors


@pytest.fixture
def page(opened: Page) -> Page:
    """The page with base_camera chosen, at the pose in the file."""
    choose(opened, "base_camera · sensor")
    expect(opened.get_by_text("Show the change", exact=True)).to_be_visible()
    back_to_the_file(opened)
    unfold(opened, "Rotation", opened.get_by_label("Written as"))
    return opened


def base_camera(file: Path) -> tuple[list[float], list[float]]:
    found = EYE.search(file.read_text())
    assert found is not None, file.read_text()
    eye, target = ([float(n) for n in group.split(",")] for group in found.groups())
    return eye, target


def button(page: Page, name: str) -> None:
    page.get_by_role("button", name=name, exact=True).click()


def unfold(page: Page, folder: str, inside: Locator) -> None:
    if not inside.is_visible():
        page.locator(f"[data-fold='{folder}']").click()
    expect(inside).to_be_visible()


def bottom_of(part: Locator) -> float:
    box = part.bounding_box()
    return HEIGHT if box is None else box["y"] + box["height"]


def arc_about_x(page: Page) -> tuple[float, float] | None:
    """A point on the rotation handle about the world's x: the rightmost pink pixel on its upper part."""
    r, g, b = np.moveaxis(view(page), -1, 0)
    ys, xs = np.nonzero((r > 225) & (g < 90) & (b > 60) & (b < 150))
    if len(xs) < 50:
        return None
    row = int(ys.min() + 0.2 * (ys.max() - ys.min()))
    return float(xs[ys == row].max() - 1 + VIEW["x"]), float(row + VIEW["y"])


def test_a_press_on_a_frustum_chooses_its_camera(page: Page, opened: Page) -> None:
    choose(opened, NO_CAMERA)
    expect(opened.get_by_text("Choose a camera here, or click its frustum")).to_be_visible()
    opened.keyboard.press("o")
    expect(opened.get_by_role("button", name="All envs")).to_have_attribute("aria-pressed", "true")
    opened.wait_for_timeout(1500)  # until the view is framed

    def orange() -> tuple[NDArray[np.intp], ...]:
        r, g, b = np.moveaxis(view(opened), -1, 0)
        return np.nonzero((r > 225) & (abs(g - 160) < 25) & (b < 60))

    until(lambda: len(orange()[0]) > 30, "the sensor's frustum")
    ys, xs = orange()
    x, y = float(np.median(xs)) + VIEW["x"], float(np.median(ys)) + VIEW["y"]
    opened.mouse.click(x, y)
    expect(opened.get_by_text(re.compile("^As in push_cube.py, line"))).to_be_visible()
    assert numbers(opened, "Position") == [0.45, 0, 0.6] and numbers(opened, "Looks at") == [0.08, 0, 0]
    opened.keyboard.press("o")


def test_a_camera_is_dragged_written_to_the_file_checked_and_undone(page: Page, task_file: Path) -> None:
    text = task_file.read_text()
    until(lambda: end_of_the_left_arrow(page) is not None, "the gizmo")
    until(lambda: picture(page) != "", "the picture")
    before = picture(page)
    x, y = end_of_the_left_arrow(page) or (0, 0)
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 40, y, steps=4)
    # While the mouse button is still down.
    until(lambda: numbers(page, "Position")[1] > 0.05, "the number")
    until(lambda: picture(page) not in ("", before), "another picture")
    page.mouse.up()
    assert numbers(page, "Position")[::2] == [0.45, 0.6] and numbers(page, "Degrees")[:2] == [0, 58.34]
    # The whole drag is one undo step, which also restores the look-at point.
    page.keyboard.press("Control+z")
    until(lambda: numbers(page, "Position") == [0.45, 0, 0.6], "the drag undone")
    assert numbers(page, "Looks at") == [0.08, 0, 0]
    page.keyboard.press("Control+Shift+z")
    until(lambda: numbers(page, "Position")[1] > 0.05, "the drag again")
    assert task_file.read_text() == text
    page.get_by_role("button", name="Show the change").click()
    expect(page.locator(".wb-diff-add")).to_contain_text("look_at(eye=[0.45,")
    assert task_file.read_text() == text
    until(lambda: numbers(page, "Position")[1] == numbers(page, "Looks at")[1], "both numbers")
    moved = numbers(page, "Position")[1]
    page.get_by_role("button", name="Save to push_cube.py").click()
    expect(page.get_by_text("saved to push_cube.py and verified")).to_be_visible()
    assert base_camera(task_file) == ([0.45, moved, 0.6], [0.08, moved, 0])
    expect(page.get_by_text(re.compile("^As in push_cube.py, line"))).to_be_visible()
    page.get_by_role("button", name="Revert in the file").click()
    expect(page.get_by_text("Edit reverted in push_cube.py.")).to_be_visible()
    assert task_file.read_text() == text
    page.get_by_role("button", name="Close", exact=True).click()


def test_a_camera_is_moved_by_typing_and_keys_and_undone(page: Page) -> None:
    unfold(page, "Lens and image", page.get_by_label("Vertical fov"))
    page.get_by_label("Vertical fov").fill("90")
    page.keyboard.press("Enter")
    until(lambda: numbers(page, "Radians") == [1.5708], "radians")
    page.evaluate("document.activeElement.blur()")
    page.keyboard.press("Alt+ArrowLeft")
    # Left is -y: the camera looks along -x.
    until(lambda: numbers(page, "Position") == [0.45, -0.01, 0.6], "the nudge")
    page.keyboard.press("Alt+Shift+ArrowUp")
    until(lambda: numbers(page, "Degrees")[1] == 57.34, "the turn")
    for undone in (58.34, 58.34, 58.34):
        page.keyboard.press("Control+z")
        until(lambda undone=undone: numbers(page, "Degrees")[1] == undone, "the turn undone")
    until(lambda: numbers(page, "Radians") == [1], "all undone")
    until(lambda: numbers(page, "Position") == [0.45, 0, 0.6], "where it was")
    page.keyboard.press("Control+Shift+z")
    until(lambda: numbers(page, "Radians") == [1.5708], "the lens again")
    page.locator("[data-fold='Lens and image']").click()


def test_a_camera_placed_at_the_viewpoint_stays_there_while_looking_through_it(page: Page) -> None:
    press(page, "Look through")
    tool(page, "Back to my view")
    # Only in the middle of this camera's picture is it red: the target on the table fills the view.
    until(lambda: bool((view(page)[..., 0] - view(page)[..., 2] > 90).mean() > 0.02), "its view")
    press(page, "Move to my view")
    assert np.allclose(numbers(page, "Position"), [0.45, 0, 0.6], atol=2e-4)
    assert np.allclose(numbers(page, "Looks at"), [0.08, 0, 0], atol=2e-4)
    press(page, "Back to my view")
    until(lambda: end_of_the_left_arrow(page) is not None, "the gizmo again")


def test_a_camera_is_rotated_with_the_mouse(page: Page) -> None:
    until(lambda: arc_about_x(page) is not None and picture(page) != "", "the handles")
    before, start = picture(page), numbers(page, "Degrees")
    x, y = arc_about_x(page) or (0, 0)
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 15, y + 25, steps=5)
    until(lambda: numbers(page, "Degrees") != start, "the angles")
    until(lambda: picture(page) not in ("", before), "another picture")
    page.mouse.up()
    assert numbers(page, "Position") == [0.45, 0, 0.6], "the camera was moved, not rotated"
    # The drag and the keys come to the server on two connections: the end of the drag may come last.
    shown: list[float] = []
    while shown != (shown := numbers(page, "Degrees")):
        page.wait_for_timeout(500)
    page.keyboard.press("Control+z")
    until(lambda: numbers(page, "Degrees") == start, "the turn undone")


def test_a_camera_is_added_at_the_viewpoint_renamed_and_removed(page: Page, task_file: Path) -> None:
    before = task_file.read_text()
    unfold(page, "Add, copy, rename, remove", page.get_by_role("button", name="Rename", exact=True))
    page.get_by_label("New name").fill("third")
    button(page, "Add sensor")
    expect(page.get_by_text(re.compile("It looks at cube, goal from where you look, 0"))).to_be_visible()
    sight = page.get_by_alt_text("what it would see")
    until(lambda: sight.evaluate("e => e.naturalWidth") == 128, "its picture, before it is written")
    assert task_file.read_text() == before
    leave = page.get_by_role("button", name="Discard the change")
    until(lambda: bottom_of(leave) < HEIGHT, "the last control in view")
    leave.click()
    expect(page.locator(".wb-diff:visible")).to_have_count(0)
    button(page, "Add human view")
    expect(page.locator(".wb-diff-add").filter(has_text='"third"').first).to_be_visible()
    button(page, f"Save to {FILE}")
    expect(page.get_by_text(f"third: added to {FILE} and verified.")).to_be_visible()
    expect(page.get_by_label("Camera", exact=True).locator("option:checked")).to_have_text(
        "third · human view"
    )
    page.get_by_label("New name").fill("fourth")
    button(page, "Rename")
    button(page, f"Save to {FILE}")
    expect(page.get_by_text(f"third: renamed to fourth in {FILE} and verified.")).to_be_visible()
    assert '"fourth"' in task_file.read_text() and '"third"' not in task_file.read_text()
    button(page, "Remove")
    button(page, f"Save to {FILE}")
    expect(page.get_by_text(f"fourth: removed from {FILE} and verified.")).to_be_visible()
    assert '"fourth"' not in task_file.read_text()
    assert task_file.read_text().count("CameraConfig(") == before.count("CameraConfig(")
    page.get_by_text("Add, copy, rename, remove", exact=True).click()


def test_the_picture_stays_visible_and_can_be_shown_in_another_size(page: Page) -> None:
    choose(page, "base_camera · sensor")
    until(lambda: picture(page) != "", "the picture")
    press(page, "¼")
    expect(page.get_by_text("The preview is 32 × 32")).to_be_visible()
    image = page.locator("img[src^='blob:']:visible").first
    until(lambda: image.evaluate("e => e.naturalWidth") == 32, "the small picture")
    by_matrix = page.get_by_role("button", name="Apply to the camera")
    unfold(page, "Matrices and files", by_matrix)
    by_matrix.scroll_into_view_if_needed()
    box = image.bounding_box()
    assert box is not None and 0 < box["y"] < 120
    # And nothing covers it.
    on_top = "([x, y]) => document.elementFromPoint(x, y).closest('.wb-pane') !== null"
    assert page.evaluate(on_top, [box["x"] + box["width"] / 2, box["y"] + 60])
    press(page, "full")
    until(lambda: image.evaluate("e => e.naturalWidth") == 128, "its own size")
    expect(page.locator(".wb-took")).to_have_text(re.compile(r"^(fast|exact), \d+ ms$"))
    page.get_by_text("Matrices and files", exact=True).click()
    expect(by_matrix).to_be_hidden()
