"""A camera placed with the real mouse in a real Chromium, and written into the author's file."""

from __future__ import annotations

import re
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import Page, expect

from tests.browser.opened import page_on, until

pytestmark = pytest.mark.browser
WIDTH, HEIGHT = 1080, 640
VIEW = {"x": 40, "y": 0, "width": WIDTH - 390, "height": HEIGHT - 200}
"""The 3-D view, less what lies over it."""
EYE = re.compile(
    r'look_at\(eye=\[([-\d., ]+)\], target=\[([-\d., ]+)\]\)\n +return \[CameraConfig\("base_camera"'
)


@pytest.fixture(scope="module")
def opened(task_file: Path, chromium_path: str) -> Iterator[Page]:
    with page_on(
        task_file, "--num-envs", "2", "--no-spare", chromium=chromium_path, width=WIDTH, height=HEIGHT
    ) as (page, errors, _):
        page.get_by_role("tab", name="Studio").click()
        yield page
        assert not errors


@pytest.fixture
def page(opened: Page) -> Page:
    """base_camera is chosen, and placed as the file says."""
    choose(opened, "base_camera · sensor")
    expect(opened.get_by_role("button", name="Show the change")).to_be_visible()
    if "wb-off" not in tool(opened, "Back to the file")["classes"]:
        press(opened, "Back to the file")
    expect(opened.get_by_text(re.compile("^As push_cube.py has it"))).to_be_visible()
    return opened


def choose(page: Page, name: str) -> None:
    page.locator("input[aria-haspopup=listbox]:visible").first.click()
    page.get_by_role("option", name=name, exact=True).click()


def tool(page: Page, name: str) -> dict:
    """A pill, found and looked at in one go: the row is replaced when its state changes."""
    found: list[dict] = []

    def find() -> bool:
        found[:] = page.evaluate(
            """n => [...document.querySelectorAll('.wb-tools .wb-pill')].filter(e => e.textContent === n).map(e => {
                e.scrollIntoView({block: 'nearest'});
                const r = e.getBoundingClientRect();
                return {classes: e.className, at: [r.x + r.width / 2, r.y + r.height / 2]};
            })""",
            name,
        )
        return bool(found)

    until(find, name)
    return found[0]


def press(page: Page, name: str) -> None:
    page.mouse.click(*tool(page, name)["at"])


def numbers(page: Page, label: str) -> list[float]:
    return page.evaluate(
        """l => {
            let e = [...document.querySelectorAll('label')].find(e => e.textContent === l);
            while (!e.querySelector('input')) e = e.parentElement;
            return [...e.querySelectorAll('input')].map(i => Number(i.value));
        }""",
        label,
    )


def view(page: Page) -> NDArray[np.int64]:
    shot = Image.open(BytesIO(page.screenshot(clip=VIEW))).convert("RGB")  # type: ignore[arg-type]
    return np.asarray(shot).astype(np.int64)


def end_of_the_left_arrow(page: Page) -> tuple[float, float] | None:
    """The world's y axis goes to the right in the page: the rightmost of what is as green as the gizmo's arrow."""
    r, g, b = np.moveaxis(view(page), -1, 0)
    ys, xs = np.nonzero((g > 180) & (g - r > 50) & (g - b > 30))
    if not len(xs):
        return None
    tip = xs.argmax()
    return float(xs[tip] - 6 + VIEW["x"]), float(ys[tip] + VIEW["y"])


def picture(page: Page) -> str:
    """What the picture shows, as text that can be compared."""
    return page.evaluate(
        """() => {
            const image = [...document.querySelectorAll("img[src^='blob:']")].find(i => i.offsetParent);
            if (!image?.naturalWidth) return '';
            const canvas = document.createElement('canvas');
            [canvas.width, canvas.height] = [image.naturalWidth, image.naturalHeight];
            canvas.getContext('2d').drawImage(image, 0, 0);
            return canvas.toDataURL();
        }"""
    )


def base_camera(file: Path) -> tuple[list[float], list[float]]:
    found = EYE.search(file.read_text())
    assert found is not None, file.read_text()
    eye, target = ([float(n) for n in group.split(",")] for group in found.groups())
    return eye, target


def test_a_press_on_its_frustum_chooses_a_camera(opened: Page) -> None:
    expect(opened.get_by_text("Choose a camera here, or press its frustum")).to_be_visible()

    def orange() -> tuple[NDArray[np.intp], ...]:
        r, g, b = np.moveaxis(view(opened), -1, 0)
        return np.nonzero((r > 225) & (abs(g - 160) < 25) & (b < 60))

    until(lambda: len(orange()[0]) > 30, "the sensor's frustum")
    ys, xs = orange()
    x, y = (xs.min() + xs.max()) / 2 + VIEW["x"], (ys.min() + ys.max()) / 2
    opened.mouse.click(x, y)
    expect(opened.get_by_text(re.compile("^As push_cube.py has it, line"))).to_be_visible()
    assert numbers(opened, "Position") == [0.45, 0, 0.6] and numbers(opened, "Looks at") == [0.08, 0, 0]


def test_dragged_with_the_mouse_written_checked_and_taken_back(page: Page, task_file: Path) -> None:
    text = task_file.read_text()
    until(lambda: end_of_the_left_arrow(page) is not None, "the gizmo")
    until(lambda: picture(page) != "", "the picture")
    before = picture(page)
    x, y = end_of_the_left_arrow(page) or (0, 0)
    page.mouse.move(x, y)
    page.mouse.down()
    for i in range(1, 5):
        page.mouse.move(x + 10 * i, y)
    # While the button is still down.
    until(lambda: numbers(page, "Position")[1] > 0.05, "the number")
    until(lambda: picture(page) not in ("", before), "another picture")
    page.mouse.up()
    assert numbers(page, "Position")[::2] == [0.45, 0.6] and numbers(page, "Degrees")[:2] == [0, 58.34]
    # All of it is one step of undo, which brings back what it looked at too.
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
    page.get_by_role("button", name="Write it to push_cube.py").click()
    expect(page.get_by_text("the new env has it")).to_be_visible()
    assert base_camera(task_file) == ([0.45, moved, 0.6], [0.08, moved, 0])
    expect(page.get_by_text(re.compile("^As push_cube.py has it, line"))).to_be_visible()
    page.get_by_role("button", name="Take it back out of the file").click()
    expect(page.get_by_text("push_cube.py is as it was before.")).to_be_visible()
    assert task_file.read_text() == text
    page.get_by_role("button", name="Close", exact=True).click()


def test_typed_and_nudged_and_undone(page: Page) -> None:
    page.get_by_text("Lens and picture", exact=True).click()
    page.get_by_label("Degrees high").fill("90")
    page.keyboard.press("Enter")
    until(lambda: numbers(page, "Radians") == [1.5708], "radians")
    page.evaluate("document.activeElement.blur()")
    page.keyboard.press("Alt+ArrowLeft")
    # Its left is towards -y: it looks along -x.
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
    page.get_by_text("Lens and picture", exact=True).click()


def test_an_eye_is_typed_and_the_target_stays_pressed_by_keys_alone(page: Page) -> None:
    at = "[document.activeElement.textContent, document.activeElement.ariaPressed]"
    tool(page, "move, turn")
    page.evaluate(
        "[...document.querySelectorAll('.wb-tools .wb-pill')].find(e => e.textContent === 'move, turn').focus()"
    )
    page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    # The row is replaced, and what was walked to has the focus in the new one.
    until(lambda: page.evaluate(at) == ["eye and target", "true"], "the other way to place")
    expect(page.get_by_text("the camera goes on looking at its target")).to_be_visible()
    page.locator("//label[text()='Eye']/ancestor::*[.//input][1]//input").first.fill("0.6")
    page.keyboard.press("Enter")
    until(lambda: numbers(page, "Eye") == [0.6, 0, 0.6], "the eye")
    until(lambda: numbers(page, "Degrees")[1] == 49.09, "the angle")
    assert numbers(page, "Target") == [0.08, 0, 0]
    page.evaluate("document.activeElement.blur()")
    page.keyboard.press("Alt+ArrowLeft")
    until(lambda: numbers(page, "Eye") == [0.6, -0.01, 0.6], "the nudge")
    assert numbers(page, "Target") == [0.08, 0, 0]
    for _ in range(2):
        page.keyboard.press("Control+z")
    until(lambda: numbers(page, "Eye") == [0.45, 0, 0.6], "both undone")
    press(page, "move, turn")
    until(lambda: "wb-on" in tool(page, "move, turn")["classes"], "the pose again")
    page.locator("//label[text()='Position']/ancestor::*[.//input][1]//input").first.fill("0.6")
    page.keyboard.press("Enter")
    until(lambda: numbers(page, "Looks at") == [0.23, 0, 0], "the target, which goes along")


def test_put_where_one_looks_through_it_it_stays(page: Page) -> None:
    press(page, "Look through it")
    tool(page, "Back to my view")
    # Red only in the middle of this camera's picture: the target on the table fills the view.
    until(lambda: bool((view(page)[..., 0] - view(page)[..., 2] > 90).mean() > 0.02), "its view")
    press(page, "Put it where I look")
    assert np.allclose(numbers(page, "Position"), [0.45, 0, 0.6], atol=2e-4)
    assert np.allclose(numbers(page, "Looks at"), [0.08, 0, 0], atol=2e-4)
    press(page, "Back to my view")
    until(lambda: end_of_the_left_arrow(page) is not None, "the gizmo again")


def test_a_copy_is_planned_and_left(page: Page, task_file: Path) -> None:
    text = task_file.read_text()
    page.get_by_text("Add, copy, rename, remove", exact=True).click()
    page.get_by_role("button", name="Rename", exact=True).click()
    expect(page.get_by_text("Type a new name first: letters, digits, - and _.")).to_be_visible()
    # Without a name it is given one.
    page.get_by_role("button", name="Duplicate", exact=True).click()
    expect(page.locator(".wb-diff-add").filter(has_text='"base_camera_2"')).to_be_visible()
    expect(page.get_by_text("Type a new name first")).not_to_be_visible()
    # viser's text fields are not tied to their labels.
    page.locator("//label[text()='New name']/ancestor::*[.//input][1]//input").fill("second_camera")
    page.get_by_role("button", name="Duplicate", exact=True).click()
    expect(page.locator(".wb-diff-add").filter(has_text='"second_camera"')).to_be_visible()
    page.get_by_role("button", name="Leave the file as it is").click()
    expect(page.locator(".wb-diff")).to_have_count(0)
    assert task_file.read_text() == text
