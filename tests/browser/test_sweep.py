"""The Sweep tab in a real Chromium: points and episodes chosen with the mouse."""

from __future__ import annotations

from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect

from tests.drive.page import page_at
from tests.drive.served import redrawn, served
from tests.drive.waiting import until
from tests.episodes.sweep_files import sweep_folder
from workbench.library.folder import Library
from workbench.review.view import ReviewView
from workbench.sweep.panel import SweepPanel

pytestmark = [pytest.mark.browser, pytest.mark.slow]


def test_a_line_a_row_and_an_episode_can_be_pressed_with_the_mouse(tmp_path: Path, browser: Browser) -> None:
    sweep_folder(tmp_path)
    library, opened = Library(tmp_path), list[tuple[str, ...]]()
    library.refresh()
    with served() as (gated_server, visitors):
        window = gated_server.server.gui.add_panel()
        with window.add_tab("Sweep"):
            panel = SweepPanel(gated_server.server, library, opened.append)
        visitors.do = panel.do
        window.dock_left()
        window.set_width(520)

        def draw() -> None:
            panel.key(ReviewView())
            panel.draw(ReviewView())

        with redrawn(draw, 0.1), page_at(browser, gated_server.url) as (page, errors):
            page.wait_for_selector(".wb-parallel")
            point = page.locator(".wb-sweep-point")
            expect(point).to_have_text("reach_weight = 2, robot_uids = panda")
            # Where no other line is: between the axes of the weight and of the robot, next to the latter.
            line = page.locator("polyline.wb-to-press").filter(
                has_text="reach_weight = 0.5, robot_uids = panda"
            )
            (x1, y1), (x2, y2) = (
                map(float, pair.split(",")) for pair in str(line.get_attribute("points")).split()[:2]
            )
            box = page.locator(".wb-parallel").bounding_box()
            assert box is not None
            scale = box["width"] / 500
            at = box["x"] + scale * (0.7 * x1 + 0.3 * x2), box["y"] + scale * (0.7 * y1 + 0.3 * y2)
            page.mouse.click(*at)
            expect(point).to_have_text("reach_weight = 0.5, robot_uids = panda")
            page.locator(".wb-points tbody tr").filter(has_text="fetch").first.click()
            expect(point).to_have_text("reach_weight = 2, robot_uids = fetch")
            page.locator(".wb-sweep-episodes tr", has_text="seed 11").click()
            until(lambda: opened == [("p7s11",)], "the opened recording", seen=lambda: opened)
            assert not errors
    library.close()
