"""Operates the Studio, on the Cameras tab, with mouse and keys."""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray
from playwright.sync_api import FloatRect, Page

from tests.drive.page import picture_of_view
from tests.drive.waiting import until

WIDTH, HEIGHT = 1080, 640
VIEW: FloatRect = {"x": 40, "y": 84, "width": WIDTH - 430, "height": HEIGHT - 84 - 224}
"""The part of the 3-D view below the icons, with the drawer open."""


def choose(page: Page, name: str) -> None:
    """Choose a camera."""
    page.get_by_label("Camera", exact=True).select_option(label=name)


def tool(page: Page, name: str) -> dict:
    """CSS classes and centre of a tool button, read in one script: the row is replaced when its state changes."""
    found: list[dict] = []

    def find() -> bool:
        found[:] = page.evaluate(
            """n => [...document.querySelectorAll('.wb-tools [role=button], .wb-tools [aria-disabled]')].filter(e => e.textContent === n).map(e => {
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


def back_to_the_file(page: Page) -> None:
    """Put the chosen camera of push_cube.py where the file has it."""
    status = page.get_by_text(re.compile("^As in push_cube.py"))

    def back() -> bool:
        # A new part is scrolled into view, and a press in progress would miss its button.
        if "wb-off" not in tool(page, "Reset to file")["classes"]:
            press(page, "Reset to file")
        return status.is_visible()

    until(back, "the camera at the file's pose")


def numbers(page: Page, label: str) -> list[float]:
    return page.evaluate(
        """l => {
            const e = [...document.querySelectorAll('label')].find(e => e.textContent.trim() === l && e.offsetParent);
            return [...e.querySelectorAll('input')].map(i => Number(i.value));
        }""",
        label,
    )


def view(page: Page) -> NDArray[np.int64]:
    return picture_of_view(page, VIEW).astype(np.int64)


def end_of_the_left_arrow(page: Page) -> tuple[float, float] | None:
    """The world's y axis points right in the view: the rightmost pixel with the green of the gizmo's arrow."""
    return end_of_green(page, 1)


def end_of_green(page: Page, side: int) -> tuple[float, float] | None:
    """The end of a gizmo's arrow along its y axis, which points right (`side` 1) or left (-1) in the view."""
    r, g, b = np.moveaxis(view(page), -1, 0)
    ys, xs = np.nonzero((g > 180) & (g - r > 50) & (g - b > 30))
    if not len(xs):
        return None
    tip = (side * xs).argmax()
    return float(xs[tip] - 6 * side + VIEW["x"]), float(ys[tip] + VIEW["y"])


def picture(page: Page) -> str:
    """The camera picture as a data URL, to compare."""
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
