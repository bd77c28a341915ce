"""The studio's rarer ways, in a real Chromium: turned by hand, a matrix for a lens, cameras added and removed, judged."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from playwright.sync_api import Locator, Page, expect

from tests.browser.opened import page_on, until
from tests.browser.test_studio import HEIGHT, VIEW, WIDTH, choose, numbers, picture, press, view

pytestmark = pytest.mark.browser
expect.set_options(timeout=60_000)
FILE = "push_cube.py"


@pytest.fixture(scope="module")
def page(task_file: Path, chromium_path: str) -> Iterator[Page]:
    arguments = ("--num-envs", "2", "--no-spare")
    with page_on(task_file, *arguments, chromium=chromium_path, width=WIDTH, height=HEIGHT) as (
        page,
        errors,
        _,
    ):
        page.get_by_role("tab", name="Studio").click()
        choose(page, "base_camera · sensor")
        expect(page.get_by_role("button", name="Show the change")).to_be_visible()
        yield page
        assert not errors


def button(page: Page, name: str) -> None:
    page.get_by_role("button", name=name, exact=True).click()


def field(page: Page, label: str, number: int = 1) -> str:
    """XPath: viser's fields are not tied to their labels."""
    return f"(//label[text()='{label}']/ancestor::*[.//input][1]//input)[{number}]"


def bottom_of(part: Locator) -> float:
    box = part.bounding_box()
    return HEIGHT if box is None else box["y"] + box["height"]


def option(page: Page, label: str, name: str) -> None:
    page.locator(field(page, label)).click()
    page.get_by_role("option", name=name, exact=True).click()


def arc_about_x(page: Page) -> tuple[float, float] | None:
    """A place on the handle that turns about the world's x: the rightmost of what is pink, on its upper part."""
    r, g, b = np.moveaxis(view(page), -1, 0)
    ys, xs = np.nonzero((r > 225) & (g < 90) & (b > 60) & (b < 150))
    if len(xs) < 50:
        return None
    row = int(ys.min() + 0.2 * (ys.max() - ys.min()))
    return float(xs[ys == row].max() - 1 + VIEW["x"]), float(row + VIEW["y"])


def test_turned_with_the_mouse(page: Page) -> None:
    until(lambda: arc_about_x(page) is not None and picture(page) != "", "the handles")
    before, start = picture(page), numbers(page, "Degrees")
    x, y = arc_about_x(page) or (0, 0)
    page.mouse.move(x, y)
    page.mouse.down()
    for i in range(1, 6):
        page.mouse.move(x + 3 * i, y + 5 * i)
    until(lambda: numbers(page, "Degrees") != start, "the angles")
    until(lambda: picture(page) not in ("", before), "another picture")
    page.mouse.up()
    assert numbers(page, "Position") == [0.45, 0, 0.6], "it was moved, not turned"
    page.keyboard.press("Control+z")
    until(lambda: numbers(page, "Degrees") == start, "the turn undone")


def test_a_lens_typed_as_a_matrix_is_written_as_one(page: Page, task_file: Path) -> None:
    text = task_file.read_text()
    page.get_by_text("Lens and picture", exact=True).click()
    option(page, "Lens as", "intrinsic matrix")
    expect(page.locator(field(page, "fx, fy"))).to_be_visible()
    page.locator(field(page, "fx, fy")).fill("150")
    page.keyboard.press("Enter")
    until(lambda: numbers(page, "fx, fy")[0] == 150, "the focal length")
    page.locator(field(page, "cx, cy", 2)).fill("70")
    page.evaluate("document.activeElement.blur()")
    page.wait_for_timeout(
        500
    )  # viser's page sends one message in 50 ms, the last: the number, before the press
    button(page, "Show the change")
    expect(page.locator(".wb-diff-add").filter(has_text="intrinsic=")).to_contain_text("[150")
    button(page, f"Write it to {FILE}")
    expect(page.get_by_text("the new env has it")).to_be_visible()
    assert "fov=1.0, near=0.01, far=10)" not in task_file.read_text() and "70" in task_file.read_text()
    button(page, "Take it back out of the file")
    expect(page.get_by_text(f"{FILE} is as it was before.")).to_be_visible()
    assert task_file.read_text() == text
    button(page, "Close")
    press(page, "Back to the file")
    page.get_by_text("Lens and picture", exact=True).click()


def test_a_camera_is_added_where_one_looks_renamed_and_removed(page: Page, task_file: Path) -> None:
    before = task_file.read_text()
    page.get_by_text("Add, copy, rename, remove", exact=True).click()
    page.locator(field(page, "New name")).fill("third")
    button(page, "Add a sensor")
    expect(page.get_by_text(re.compile("It looks from your side at cube, goal from 0"))).to_be_visible()
    sight = page.get_by_alt_text("what it would see")
    until(lambda: sight.evaluate("e => e.naturalWidth") == 128, "its picture, before it is written")
    assert task_file.read_text() == before
    leave = page.get_by_role("button", name="Leave the file as it is")
    until(lambda: bottom_of(leave) < HEIGHT, "the last of it in sight")
    leave.click()
    expect(page.locator(".wb-diff:visible")).to_have_count(0)
    button(page, "Add one for people")
    expect(page.locator(".wb-diff-add").filter(has_text='"third"').first).to_be_visible()
    button(page, f"Write it to {FILE}")
    expect(page.get_by_text(f"third is in {FILE}, and the env has it.")).to_be_visible()
    expect(page.locator("input[aria-haspopup=listbox]:visible").first).to_have_value("third · for people")
    page.locator(field(page, "New name")).fill("fourth")
    button(page, "Rename")
    button(page, f"Write it to {FILE}")
    expect(page.get_by_text(f"third is fourth in {FILE} now.")).to_be_visible()
    assert '"fourth"' in task_file.read_text() and '"third"' not in task_file.read_text()
    button(page, "Remove")
    button(page, f"Write it to {FILE}")
    expect(page.get_by_text(f"fourth is no longer in {FILE}.")).to_be_visible()
    assert '"fourth"' not in task_file.read_text()
    assert task_file.read_text().count("CameraConfig(") == before.count("CameraConfig(")
    page.get_by_text("Add, copy, rename, remove", exact=True).click()


def test_the_picture_stays_in_sight_and_is_looked_at_in_another_size(page: Page) -> None:
    choose(page, "base_camera · sensor")
    until(lambda: picture(page) != "", "the picture")
    press(page, "¼")
    expect(page.get_by_text("The picture is 32 × 32 for a quick look")).to_be_visible()
    image = page.locator("img[src^='blob:']:visible").first
    until(lambda: image.evaluate("e => e.naturalWidth") == 32, "the small picture")
    page.get_by_text("Matrices and files", exact=True).click()
    page.get_by_role("button", name="Place the camera by it").scroll_into_view_if_needed()
    box = image.bounding_box()
    assert box is not None and 0 < box["y"] < 120
    # And nothing lies over it.
    on_top = "([x, y]) => document.elementFromPoint(x, y).closest('.wb-pane') !== null"
    assert page.evaluate(on_top, [box["x"] + box["width"] / 2, box["y"] + 60])
    press(page, "own size")
    until(lambda: image.evaluate("e => e.naturalWidth") == 128, "its own size")


def test_files_for_opencv_and_ros_say_what_the_page_says(page: Page) -> None:
    for name, suffix in (("OpenCV YAML", "opencv"), ("ROS CameraInfo", "ros")):
        option(page, "File", name)
        with page.expect_download() as event:
            button(page, "Download")
        assert event.value.suggested_filename == f"base_camera_{suffix}.yaml"
        text = Path(event.value.path()).read_text()
        if suffix == "ros":
            said = yaml.safe_load(text)
            matrix = np.array(said["camera_matrix"]["data"]).reshape(3, 3)
            assert (said["image_width"], said["image_height"]) == (128, 128)
        else:
            store = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
            matrix = store.getNode("sensor_base_camera").getNode("camera_matrix").mat()
        assert matrix[0, 0] == pytest.approx(64 / np.tan(0.5)) and matrix[0, 2] == 64


def test_judged_over_steps_a_press_shows_the_step_and_over_fresh_resets_it_can_be_stopped(page: Page) -> None:
    page.get_by_text("Matrices and files", exact=True).click()
    page.evaluate("document.activeElement.blur()")
    for step in range(1, 4):
        page.keyboard.press("s")
        expect(page.get_by_text(f"env 0: step {step}").first).to_be_visible()
    page.get_by_text("Judge", exact=True).click()
    option(page, "Over", "this env's steps so far")
    button(page, "Judge this camera")
    expect(page.get_by_text("4 moments of env 0's episode, step 0 to step 3")).to_be_visible()
    strip = page.locator(".wb-steps").first.locator("i")
    expect(strip).to_have_count(4)
    strip.nth(1).click()
    expect(page.get_by_text("2 steps ago", exact=True)).to_be_visible()
    page.evaluate("document.activeElement.blur()")
    page.keyboard.press("End")
    option(page, "Over", "fresh resets")
    page.get_by_role("textbox", name="Resets").first.fill("900")
    page.keyboard.press("Enter")
    button(page, "Judge this camera")
    expect(page.get_by_text(re.compile("judging base_camera over 900 seeds"))).to_be_visible(timeout=120_000)
    page.get_by_role("button", name="Stop", exact=True).first.click()
    expect(page.get_by_role("button", name="Stop", exact=True)).to_have_count(0)
    page.get_by_role("textbox", name="Resets").first.fill("2")
    page.keyboard.press("Enter")
    button(page, "Judge this camera")
    expect(page.get_by_text("2 fresh resets")).to_be_visible(timeout=120_000)
