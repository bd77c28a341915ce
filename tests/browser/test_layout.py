"""Every tab in common sizes and themes: nothing is cut off, covered or too close, and the view keeps its space."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser, Page, expect

from tests.browser.conftest import At
from tests.browser.layout import FAULTS, FIELD_FONTS, TAB_ROWS
from tests.browser.tab_pictures import GOLDEN, LIVE_TABS, REVIEW_TABS
from tests.drive.desk import Desk
from tests.drive.page import close_notice, open_workbench, page_at, picture_of_view
from tests.drive.studio import press
from tests.drive.waiting import until

pytestmark = [pytest.mark.browser, pytest.mark.slow]
SIZES = [(1280, 720), (1440, 900), (1920, 1080)]
DEFECTS = {
    "buttons touch": ".wb-pills { gap: 0 !important }",
    "cut": "label { display: block; width: 12px; overflow: hidden; white-space: nowrap }",
    "a scroll bar lies over": ".wb-numbers { width: calc(100% + 12px) !important }",
    "panels on each other": "[data-floating-window]:has(.wb-transport) { margin-right: -60px !important }",
    "text over a button's edge": ".wb-button { max-width: 30px; min-width: 0 !important }",
    "on each other": ".wb-status > .wb-news { margin-left: -30px }",
}
VIEW = "canvas[data-engine]"


@pytest.fixture(scope="module")
def opened(example: At, browser: Browser) -> Iterator[Desk]:
    with example(browser) as desk:
        close_notice(desk.page)
        desk.press("Shift+R")
        desk.tab("Reward")
        desk.comes_to(0)
        desk.press("s", "s")
        desk.comes_to(2)
        yield desk
        assert not desk.errors
        # Restore the initial state for the next file.
        desk.tab("Reward")
        desk.press("Shift+R")
        desk.comes_to(0)


@pytest.fixture
def desk(opened: Desk) -> Desk:
    opened.page.set_viewport_size({"width": 1280, "height": 720})
    return opened


def faults(page: Page) -> list[str]:
    """Layout defects that remain after some seconds: panels take some frames to open and fold."""
    for _ in range(15):
        if not (found := page.evaluate(FAULTS)):
            break
        page.wait_for_timeout(300)
    return found


def faults_of_all_tabs(page: Page, tabs: tuple[str, ...], table: str) -> dict[str, list[str]]:
    found = {}
    for tab in tabs:
        page.get_by_role("tab", name=tab, exact=True).click()
        if tab == "Cameras" and table == "Envs":
            expect(page.get_by_role("button", name=re.compile("Look through"))).to_be_visible()
        found[tab] = faults(page)
    page.keyboard.press("b")
    found[table] = faults(page)
    page.keyboard.press("b")
    return {tab: said for tab, said in found.items() if said}


def choose_camera(desk: Desk) -> None:
    desk.tab("Cameras")
    desk.page.get_by_label("Camera", exact=True).select_option(label="base_camera · sensor")


@pytest.mark.parametrize("size", SIZES)
def test_every_tab_of_the_live_page_in_both_themes(desk: Desk, size: tuple[int, int]) -> None:
    choose_camera(desk)
    desk.page.set_viewport_size({"width": size[0], "height": size[1]})
    found = faults_of_all_tabs(desk.page, LIVE_TABS, "Envs")
    desk.press("d")
    expect(desk.page.locator("html")).to_have_attribute("data-mantine-color-scheme", "light")
    in_light = faults_of_all_tabs(desk.page, LIVE_TABS, "Envs")
    desk.press("d")
    # A tab that is redrawn between mouse down and up gets no click.
    expect(desk.page.locator("html")).to_have_attribute("data-mantine-color-scheme", "dark")
    assert (found, in_light) == ({}, {})


def test_each_layout_defect_is_found(desk: Desk) -> None:
    desk.tab("Reward")
    for kind, css in DEFECTS.items():
        sheet = desk.page.evaluate_handle(
            "css => document.head.appendChild(Object.assign(document.createElement('style'), {textContent: css}))",
            css,
        )
        until(lambda kind=kind: any(fault.startswith(kind) for fault in desk.page.evaluate(FAULTS)), kind)
        sheet.evaluate("sheet => sheet.remove()")
    assert faults(desk.page) == []


def test_all_tabs_are_in_one_row_and_inputs_use_the_font_of_their_labels(desk: Desk) -> None:
    for name in LIVE_TABS:
        desk.tab(name)
        assert desk.page.evaluate(TAB_ROWS) == 1
    desk.tab("Run")
    fonts = desk.page.evaluate(FIELD_FONTS)
    assert len(fonts) > 6 and len(set(fonts)) == 1, set(fonts)


def test_nothing_covers_the_view_through_a_camera(desk: Desk) -> None:
    choose_camera(desk)
    press(desk.page, "Look through")
    view = desk.page.evaluate("s => document.querySelector(s).getBoundingClientRect().toJSON()", VIEW)

    def orange_rows() -> list[int]:
        x, y = view["x"] + 20, view["y"]
        picture = picture_of_view(
            desk.page, {"x": x, "y": y, "width": view["width"] - 40, "height": view["height"]}
        )
        like = (np.abs(picture.astype(int) - (245, 159, 0)).max(axis=2) < 60).mean(axis=1)
        return np.flatnonzero(like > 0.3).tolist()

    until(lambda: len(orange_rows()) > 1, "the border of the picture", seen=orange_rows)
    covered = desk.page.evaluate(
        """s => [...document.querySelectorAll("[data-floating-window]:not(:has(.wb-view-icons))")].map(e => e.getBoundingClientRect())
        .some(a => { const b = document.querySelector(s).parentElement.getBoundingClientRect(); return a.left < b.right - 1 && b.left < a.right - 1 && a.top < b.bottom - 1 && b.top < a.bottom - 1 })""",
        VIEW,
    )
    assert not covered
    press(desk.page, "Back to my view")


def test_every_tab_of_the_review_in_all_sizes_and_both_themes(tmp_path: Path, browser: Browser) -> None:
    shutil.copytree(GOLDEN / "v1", tmp_path / "v1")
    with (
        open_workbench("v1", cwd=tmp_path, what="review") as opened,
        page_at(browser, opened.url) as (page, errors),
    ):
        rows = page.locator(".wb-library").get_by_text(re.compile("/Golden"))
        # The newest recording opens, and folds the library if the width of the page is known by then.
        expect(page.get_by_text(re.compile("step 0 /")).first).to_be_visible(timeout=120_000)
        close_notice(page)
        page.wait_for_timeout(3000)
        if not rows.first.is_visible():
            page.keyboard.press("b")
        expect(rows).to_have_count(7)
        found = {"Library": faults(page)}
        rows.last.click()
        page.keyboard.press("Enter")
        expect(rows).to_have_count(0)
        for width, height in SIZES:
            page.set_viewport_size({"width": width, "height": height})
            for theme in ("dark", "light"):
                seen = faults_of_all_tabs(page, REVIEW_TABS, "Library folded or not")
                found |= {f"{width}, {theme}, {tab}": said for tab, said in seen.items()}
                page.keyboard.press("d")
        assert ({tab: said for tab, said in found.items() if said}, errors) == ({}, [])


def test_a_browser_without_webgl_shows_what_is_missing_and_what_to_do(
    example: At, browser: Browser, chromium_path: str
) -> None:
    without = browser.browser_type.launch(
        executable_path=chromium_path, args=["--no-sandbox", "--disable-3d-apis"]
    )
    with example(browser) as desk:
        page = without.new_page()
        page.goto(desk.opened.url)
        alert = page.get_by_role("alert").filter(has_text="This browser has no WebGL 2")
        expect(alert).to_be_visible()
        expect(alert).to_contain_text("Use graphics acceleration when available")
        assert page.evaluate(
            "() => { const r = document.querySelector('.wb-needs-webgl').getBoundingClientRect(); return r.width >= innerWidth && r.height >= innerHeight }"
        )
        expect(desk.page.get_by_text("This browser has no WebGL 2")).to_have_count(0)
    without.close()
