"""A camera looked through, searched and exported in a real Chromium, over real envs."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser, Locator, Page, expect

from tests.browser.conftest import At
from tests.drive.studio import back_to_the_file
from tests.drive.waiting import until

pytestmark = [pytest.mark.browser, pytest.mark.slow]
CAMERA = "base_camera"
PICTURE = "img[src^='blob:']:visible"
FOLDERS = {"Suggest a placement": "Search", "Matrices and files": "Download"}
"""Folders, and a button in each."""

PLACES_OF_A_PILL = """
window.places = [];
const look = () => {
    const pill = document.querySelector(".wb-offer [data-do]");
    if (pill) places.push(Math.round(pill.getBoundingClientRect().top));
    if (places.length < 40) requestAnimationFrame(look);
};
look();
"""
"""Records the button's place in every frame, from its first appearance."""


@pytest.fixture(scope="module")
def opened(example: At, browser: Browser) -> Iterator[Page]:
    """The Studio tab on base_camera, with every report folder open."""
    with example(browser, height=900) as desk:
        page = desk.page
        desk.tab("Cameras")
        page.get_by_label("Camera", exact=True).select_option(label=f"{CAMERA} · sensor")
        # The first picture moves the folders down, and a click in progress would miss its folder.
        expect(page.locator(PICTURE).first).to_be_visible(timeout=180_000)
        for folder, inside in FOLDERS.items():
            page.get_by_text(folder, exact=True).click()
            expect(page.get_by_role("button", name=inside, exact=True)).to_be_visible()
        yield page
        back_to_the_file(page)
        assert not desk.errors


@pytest.fixture
def page(opened: Page) -> Page:
    back_to_the_file(opened)
    return opened


def press(page: Page, name: str) -> None:
    page.get_by_role("button", name=name, exact=True).click()


def lies_over(one: Locator, other: Locator) -> bool:
    a, b = one.bounding_box(), other.bounding_box()
    return a is not None and b is not None and abs(a["y"] - b["y"]) < 1 and abs(a["height"] - b["height"]) < 1


def shown_matrix(page: Page) -> np.ndarray:
    return np.array(
        json.loads(page.locator(".wb-copy-head [data-copy]").first.get_attribute("data-copy") or "")
    )


def test_a_press_on_the_picture_shows_body_depth_and_point(page: Page) -> None:
    pane = page.locator(".wb-pane")
    until(lambda: lies_over(pane, page.locator(PICTURE).first), "a pane as large as the picture")
    box = pane.bounding_box()
    assert box is not None
    pane.click(position={"x": 4, "y": box["height"] - 4})
    expect(page.locator(".wb-found b")).to_have_text("table-workspace")
    text = page.locator(".wb-found").inner_text()
    point = np.array(re.findall(r"-?\d\.\d{4}", text), float)[1:]
    depth = float(re.findall(r"\d\.\d{4}", text)[0])
    # The table top is at the env's z = 0, and this corner is at the lower left of the picture.
    assert abs(point[2]) < 0.005
    x, y, z, one = shown_matrix(page) @ [*point, 1]
    assert one == 1 and abs(z - depth) < 1e-3 and x < 0 and y > 0
    assert abs(x + y) < 0.02  # a square picture: equally far left and down


def test_a_downloaded_calibration_places_the_camera_again(page: Page) -> None:
    with page.expect_download() as event:
        press(page, "Download")
    assert event.value.suggested_filename == f"{CAMERA}.json"
    text = Path(event.value.path()).read_text()
    assert CAMERA in text
    json.loads(text)
    before = shown_matrix(page)
    moved = before.copy()
    moved[2, 3] += 0.1  # world to camera, OpenCV: the scene moves 0.1 m away
    field = page.get_by_label("Calibration")
    field.fill("\n".join(" ".join(map(str, row)) for row in moved))
    press(page, "Apply to the camera")
    until(lambda: bool(np.allclose(shown_matrix(page), moved, atol=1e-6)), "the pasted pose")
    mirrored = moved.copy()
    mirrored[0] *= -1
    field.fill(json.dumps(mirrored.tolist()))
    press(page, "Apply to the camera")
    expect(page.get_by_text("mirror image")).to_be_visible()
    field.fill(text)
    press(page, "Apply to the camera")
    until(lambda: bool(np.allclose(shown_matrix(page), before, atol=1e-5)), "our own file's pose")


def test_placements_are_suggested_with_pictures_and_can_be_used(page: Page) -> None:
    before = shown_matrix(page)
    page.get_by_role("textbox", name="Resets").fill("1")
    page.keyboard.press("Enter")
    page.evaluate(PLACES_OF_A_PILL)
    press(page, "Search")
    take = page.locator(".wb-offer [data-do]")
    expect(take.first).to_be_visible(timeout=180_000)
    page.wait_for_function("() => places.length >= 40")
    places = page.evaluate("places.slice(3)")
    assert len(set(places)) == 1, "the button does not move, so a press in progress does not miss it"
    assert page.locator(".wb-offer img").count() == page.locator(".wb-offer").count() <= 5
    expect(page.locator(".wb-offer").first).to_contain_text(re.compile(r"cube: in (\d) of \1 envs"))
    take.first.click()
    expect(page.locator(".wb-offer").first).to_contain_text("in use")
    until(
        lambda: not np.allclose(shown_matrix(page), before, atol=1e-3),
        "the camera at the suggested placement",
    )
