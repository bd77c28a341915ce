"""The resolution of the view: steady where the browser draws in software, viser's own affair where it does not."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import pytest
from playwright.sync_api import Browser, Page

from tests.drive.waiting import until
from workbench.ui.server.gated_server import GatedServer, ServerOptions, open_server

pytestmark = [pytest.mark.browser, pytest.mark.slow]
A_CARD = """
const ask = WebGL2RenderingContext.prototype.getParameter, UNMASKED_RENDERER = 0x9246;
WebGL2RenderingContext.prototype.getParameter = function (what) {
    return what === UNMASKED_RENDERER ? 'NVIDIA GeForce RTX 3060' : ask.call(this, what);
};
"""
SLOW_FRAMES = """
const soon = window.requestAnimationFrame.bind(window);
let last = 0;
window.framesSeen = 0;
window.requestAnimationFrame = (draw) => soon(() => setTimeout(() => {
    const now = performance.now();
    if (now - last > 40) { window.framesSeen += 1; last = now; }
    draw(now);
}, 60));
"""
ENOUGH_FRAMES = 60
"""viser decides after ten quarters of a second in which frames follow each other."""
CANVAS = "document.querySelector('canvas[data-engine]')"
Show = Callable[..., Page]


@pytest.fixture(scope="module")
def gated_server() -> Iterator[GatedServer]:
    gated_server = open_server(ServerOptions(port=0))
    yield gated_server
    gated_server.close()


@pytest.fixture(scope="module")
def show(gated_server: GatedServer, browser: Browser) -> Iterator[Show]:
    """Opens the page on a screen of twice the usual resolution, and waits for its view."""

    def opened(*scripts: str, wish: str = "") -> Page:
        page = browser.new_page(viewport={"width": 640, "height": 400}, device_scale_factor=2)
        for script in scripts:
            page.add_init_script(script)
        page.goto(gated_server.url + wish)
        # A function: of an expression every look but the first is an eval, which the page's policy forbids.
        # Made with 300 x 150, as every canvas; the view's size comes some frames later.
        page.wait_for_function(
            f"() => {CANVAS}?.clientWidth === 640 && {CANVAS}.width !== 300", timeout=60_000
        )
        return page

    yield opened


def draw_until(gated_server: GatedServer, page: Page, reached: str) -> None:
    """Something moves in the view until this is true in the page."""
    node = gated_server.server.scene.add_frame("/moved")

    def seen() -> bool:
        node.position = (time.monotonic() % 1, 0, 0)
        return page.evaluate(reached)

    until(seen, reached)


def width(page: Page) -> int:
    return page.evaluate(f"{CANVAS}.width")


def test_a_page_drawn_in_software_keeps_its_resolution_while_frames_come_slowly(
    gated_server: GatedServer, show: Show
) -> None:
    page = show(SLOW_FRAMES)
    assert width(page) == 2 * 640
    draw_until(gated_server, page, f"framesSeen > {ENOUGH_FRAMES}")
    assert width(page) == 2 * 640
    assert page.url == gated_server.url.partition("?")[0]
    page.close()


def test_a_page_with_a_graphics_card_is_sharp_and_still_adapts(gated_server: GatedServer, show: Show) -> None:
    page = show(A_CARD, SLOW_FRAMES)
    assert width(page) == 2 * 640
    draw_until(gated_server, page, f"{CANVAS}.width < {2 * 640}")
    page.close()


def test_a_resolution_that_the_address_asks_for_is_left_alone(show: Show) -> None:
    page = show(wish="&fixedDpr=1.5")
    page.wait_for_function(f"() => {CANVAS}.width === 960")
    assert page.url.endswith("?fixedDpr=1.5")
    page.close()
