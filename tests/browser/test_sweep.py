"""The Sweep tab in a real Chromium: points and episodes chosen with the mouse."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass

import pytest
from playwright.sync_api import Browser, Page, expect

from tests.drive.page import page_at
from tests.drive.waiting import until
from tests.episodes.sweep_files import sweep_folder
from workbench.commands import COMMANDS
from workbench.library.folder import Library
from workbench.page.door.gated_server import ServerOptions, open_server
from workbench.page.widgets.visitors import PATH, Visitors
from workbench.review.view import ReviewView
from workbench.sweep.panel import SweepPanel

pytestmark = [pytest.mark.browser, pytest.mark.slow]


@dataclass
class Shown:
    page: Page
    opened: list[tuple[str, ...]]


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory, browser: Browser) -> Iterator[Shown]:
    folder = tmp_path_factory.mktemp("sweep")
    sweep_folder(folder)
    gated_server = open_server(ServerOptions(port=0))
    server, visitors = gated_server.server, Visitors(gated_server.server, COMMANDS)
    gated_server.add_channel(PATH, visitors.serve)
    library, opened = Library(folder), []
    library.refresh()
    window = server.gui.add_panel()
    with window.add_tab("Sweep"):
        panel = SweepPanel(server, library, opened.append)
    visitors.do = panel.do
    window.dock_left()
    window.set_width(520)
    stopping = threading.Event()

    def draw() -> None:
        while not stopping.wait(0.1):
            panel.key(ReviewView())
            panel.draw(ReviewView())

    drawing = threading.Thread(target=draw, daemon=True)
    drawing.start()
    with page_at(browser, "about:blank") as (page, errors):
        page.set_default_timeout(60_000)
        page.goto(gated_server.url)
        page.wait_for_selector(".wb-parallel")
        yield Shown(page, opened)
        assert not errors
    stopping.set()
    drawing.join()
    library.close()
    gated_server.close()


def test_a_line_a_row_and_an_episode_can_be_pressed_with_the_mouse(shown: Shown) -> None:
    page = shown.page
    point = page.locator(".wb-sweep-point")
    expect(point).to_have_text("reach_weight = 2, robot_uids = panda")
    # Where no other line is: between the axes of the weight and of the robot, next to the latter.
    line = page.locator("polyline.wb-to-press").filter(has_text="reach_weight = 0.5, robot_uids = panda")
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
    until(lambda: shown.opened, "an opened recording")
    assert shown.opened == [("p7s11",)]
