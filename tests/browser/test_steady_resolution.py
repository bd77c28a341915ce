"""The view with software rendering has simplified meshes and a fixed resolution; with a GPU viser's defaults apply."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from playwright.sync_api import Browser, Page, expect

from tests.drive.page import PRETEND_GPU_JS
from tests.drive.scenes import table_scene
from tests.drive.waiting import until
from workbench.commands import COMMANDS
from workbench.envs.scene.shapes import Mesh
from workbench.page.door.gated_server import GatedServer, ServerOptions, open_server
from workbench.page.scene.bodies import DrawStyle
from workbench.page.scene.env_grid import lay_out
from workbench.page.scene.software_rendering import InSoftware
from workbench.page.widgets.visitors import PATH, Visitors

pytestmark = [pytest.mark.browser, pytest.mark.slow]
SLOW_FRAMES_JS = """
const soon = window.requestAnimationFrame.bind(window);
let last = 0;
window.framesSeen = 0;
window.requestAnimationFrame = (draw) => soon(() => setTimeout(() => {
    const now = performance.now();
    if (now - last > 40) { window.framesSeen += 1; last = now; }
    draw(now);
}, 60));
"""
MIN_FRAMES = 60
"""viser decides after 2.5 s of continuous frames."""
CANVAS = "document.querySelector('canvas[data-engine]')"
Show = Callable[..., Page]


@pytest.fixture(scope="module")
def gated_server() -> Iterator[GatedServer]:
    gated_server = open_server(ServerOptions(port=0))
    yield gated_server
    gated_server.close()


@pytest.fixture(scope="module")
def show(gated_server: GatedServer, browser: Browser) -> Iterator[Show]:
    """A function that opens the page on a screen with device pixel ratio 2 and waits for its view."""

    def opened(*scripts: str, choice: str = "") -> Page:
        page = browser.new_page(viewport={"width": 640, "height": 400}, device_scale_factor=2)
        for script in scripts:
            page.add_init_script(script)
        page.goto(gated_server.url + choice)
        # A function: an expression would be polled with eval, which the page's policy forbids.
        # A canvas starts with 300 x 150; it gets the view's size some frames later.
        page.wait_for_function(
            f"() => {CANVAS}?.clientWidth === 640 && {CANVAS}.width !== 300", timeout=60_000
        )
        return page

    yield opened


def draw_until(gated_server: GatedServer, page: Page, reached: str) -> None:
    """Move a body in the view until the expression `reached` is true in the page."""
    node = gated_server.server.scene.add_frame("/moved")

    def seen() -> bool:
        node.position = (time.monotonic() % 1, 0, 0)
        return page.evaluate(reached)

    until(seen, reached)


def width(page: Page) -> int:
    return page.evaluate(f"{CANVAS}.width")


def test_a_software_rendered_page_keeps_its_resolution_with_slow_frames(
    gated_server: GatedServer, show: Show
) -> None:
    page = show(SLOW_FRAMES_JS)
    assert width(page) == 2 * 640
    draw_until(gated_server, page, f"framesSeen > {MIN_FRAMES}")
    assert width(page) == 2 * 640
    assert page.url == gated_server.url.partition("?")[0]
    page.close()


def test_a_page_with_a_graphics_card_is_sharp_and_still_adapts(gated_server: GatedServer, show: Show) -> None:
    page = show(PRETEND_GPU_JS, SLOW_FRAMES_JS)
    assert width(page) == 2 * 640
    draw_until(gated_server, page, f"{CANVAS}.width < {2 * 640}")
    page.close()


def test_the_software_rendering_notice_closes_itself_and_is_not_shown_again(
    gated_server: GatedServer, browser: Browser
) -> None:
    context = browser.new_context()
    for shown in (True, False):
        page = context.new_page()
        page.goto(gated_server.url)
        notice = page.get_by_text("software mode")
        expect(notice).to_be_attached(timeout=60_000)
        if shown:
            expect(notice).to_be_visible()
        expect(notice).to_be_hidden()
        page.close()
    context.close()


def test_meshes_are_simplified_only_while_every_page_uses_software_rendering(
    gated_server: GatedServer, show: Show
) -> None:
    in_software = InSoftware(gated_server.server)
    visitors = Visitors(gated_server.server, COMMANDS)
    visitors.do = lambda command, visitor: in_software.report_arrived(visitor)
    gated_server.add_channel(PATH, visitors.serve)
    page = show()
    until(lambda: len(gated_server.server.get_clients()) == 1, "the page")
    assert not in_software.all_pages
    in_software.ask()
    until(lambda: in_software.all_pages, "the page's report")
    geometry, poses = table_scene(100)
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.05)
    mesh = Mesh(ball.vertices.astype(np.float32), ball.faces.astype(np.uint32))
    geometry = replace(geometry, visuals=tuple(replace(visual, mesh=mesh) for visual in geometry.visuals))
    layout = lay_out(geometry, poses)
    until(lambda: in_software.looks(DrawStyle(), geometry, layout, alone=False).error > 0, "simpler shapes")
    assert in_software.looks(DrawStyle(), geometry, layout, alone=True) == DrawStyle()
    assert in_software.looks(DrawStyle(1_000_000), geometry, layout, alone=False).error == 0
    other = show(PRETEND_GPU_JS)
    until(lambda: len(gated_server.server.get_clients()) == 2, "the other page")
    assert in_software.all_pages
    until(lambda: not in_software.all_pages, "the timeout of the other page's report")
    assert in_software.looks(DrawStyle(), geometry, layout, alone=False) == DrawStyle()
    other.close()
    until(lambda: in_software.all_pages, "the end of the other page")
    page.close()
