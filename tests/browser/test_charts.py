"""The curves as a browser draws them: read from the pixels of the canvas."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import viser
from numpy.typing import NDArray
from playwright.sync_api import Browser, Page, expect

from tests.drive.page import page_at
from tests.drive.panels import Clock
from tests.drive.waiting import until
from tests.ui.scenes import running
from workbench.session.view import Curves
from workbench.ui.curves_panel import REDRAW_EVERY, CurvesPanel
from workbench.ui.line_chart import SELECTED_COLOUR

pytestmark = pytest.mark.browser
ENVS = 3
COLUMNS_OF = """([colour]) => {
    const canvas = document.querySelector(".uplot canvas");
    if (!canvas || !canvas.width) return [];
    const { width, height } = canvas;
    const pixels = canvas.getContext("2d").getImageData(0, 0, width, height).data;
    const [red, green, blue] = [1, 3, 5].map((at) => parseInt(colour.slice(at, at + 2), 16));
    const found = [];
    for (let x = 0; x < width; x++) {
        for (let y = 0; y < height; y++) {
            const at = 4 * (y * width + x);
            const far = Math.abs(pixels[at] - red) + Math.abs(pixels[at + 1] - green) + Math.abs(pixels[at + 2] - blue);
            if (pixels[at + 3] > 127 && far < 60) { found.push(x / width); break; }
        }
    }
    return found;
}"""
"""Which columns of the first chart, as shares of its width, have a pixel of a colour."""


@pytest.fixture
def server() -> Iterator[viser.ViserServer]:
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    yield server
    server.stop()


def past(first: int, last: int, lost: tuple[int, int] = (0, 0)) -> Curves:
    """Control steps from `first` to `last`; the reward of env 0 is NaN in those of `lost`."""
    tick = np.arange(first, last)
    reward = np.sin(tick / 7)[:, None] + np.arange(ENVS, dtype=np.float32)
    reward[(tick >= lost[0]) & (tick < lost[1]), 0] = np.nan
    flags = np.zeros_like(reward)
    return Curves(last, tick, reward, flags, flags.astype(bool))


def drawn(page: Page) -> NDArray[np.float64]:
    return np.array(page.evaluate(COLUMNS_OF, [SELECTED_COLOUR]))


def widest_gap(columns: NDArray[np.float64]) -> float:
    return float(np.diff(columns).max()) if len(columns) > 1 else 1.0


def whole(page: Page) -> bool:
    """Whether the curve goes without a gap over the chart, but for the axis at its left."""
    columns = drawn(page)
    return len(columns) > 1 and columns[0] < 0.3 and columns[-1] > 0.9 and widest_gap(columns) < 0.05


def test_the_curve_is_drawn_through_nan_another_env_and_a_rebuild(
    server: viser.ViserServer, browser: Browser
) -> None:
    """It went blank, and stayed so: each new range or line moved the x axis, until none of the steps was on it."""
    clock = Clock()
    panel = CurvesPanel(server, clock)
    with page_at(browser, f"http://127.0.0.1:{server.get_port()}") as (page, errors):
        expect(page.get_by_text("Curves appear with the second step.")).to_be_visible()

        def draw(curves: Curves, env: int = 0) -> None:
            clock.passes()
            panel.draw(running(ENVS, curves=curves, selected_env=env))
            page.wait_for_timeout(1000 * REDRAW_EVERY / 4)

        for last in range(40, 200, 20):
            draw(past(0, last))
        until(lambda: whole(page), "the curve")
        for last in range(200, 400, 20):
            draw(past(0, last, (200, 300)))
        until(lambda: widest_gap(drawn(page)) > 0.15, "the gap")
        columns = drawn(page)
        assert columns[0] < 0.3 and columns[-1] > 0.9
        for last in range(400, 500, 20):
            draw(past(0, last), env=last // 20 % ENVS)
        until(lambda: whole(page), "the curve of another env")
        for last in range(2, 60, 2):
            draw(past(0, last), env=last // 20)
        until(lambda: whole(page), "the curve after a rebuild")
        assert errors == []
