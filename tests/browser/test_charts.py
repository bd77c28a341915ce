"""The curves as a browser draws them, read from the canvas pixels."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import viser
from numpy.typing import NDArray
from playwright.sync_api import Browser, Page, expect

from tests.drive.charts import drawn
from tests.drive.page import page_at
from tests.drive.panels import Clock
from tests.drive.scenes import running, step_of
from tests.drive.waiting import until
from workbench.live.history.curves import Curves, StepCurves
from workbench.live.panels.reward_panel import CurvesPanel

pytestmark = [pytest.mark.browser, pytest.mark.slow]
ENVS = 3


@pytest.fixture
def server() -> Iterator[viser.ViserServer]:
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    yield server
    server.stop()


def past(last: int, env: int = 0, lost: tuple[int, int] = (0, 0)) -> Curves:
    """Control steps 1 to `last`; the reward of env 0 is NaN in those of `lost`."""
    steps = StepCurves(ENVS)
    result = step_of(np.zeros((ENVS, 1, 7), np.float32), success=np.zeros(ENVS, bool))
    for tick in range(1, last + 1):
        reward = np.sin(tick / 7) + np.arange(ENVS, dtype=np.float32)
        reward[0] = np.nan if lost[0] <= tick < lost[1] else reward[0]
        steps.add(replace(result, reward=reward))
    return steps.curves(env)


def widest_gap(columns: NDArray[np.float64]) -> float:
    return float(np.diff(columns).max()) if len(columns) > 1 else 1.0


def whole(page: Page) -> bool:
    """Whether the curve spans the chart, except for the axis at the left, without a gap."""
    columns = drawn(page)
    return len(columns) > 1 and columns[0] < 0.3 and columns[-1] > 0.9 and widest_gap(columns) < 0.05


def test_the_curve_is_drawn_through_nan_another_env_and_a_rebuild(
    server: viser.ViserServer, browser: Browser
) -> None:
    """The chart must not go blank because new ranges or lines move the x axis off all steps."""
    clock = Clock()
    panel = CurvesPanel(server)
    with page_at(browser, f"http://127.0.0.1:{server.get_port()}") as (page, errors):
        expect(page.get_by_text("Curves appear after the second step.")).to_be_visible()

        def draw(curves: Curves, env: int = 0) -> None:
            clock.passes()
            panel.draw(running(ENVS, curves=curves, selected_env=env))
            page.wait_for_timeout(1000 * CurvesPanel.every / 4)  # as fast as steps arrive while playing

        for last in range(40, 200, 20):
            draw(past(last))
        until(lambda: whole(page), "the curve")
        for last in range(200, 400, 20):
            draw(past(last, lost=(200, 300)))
        until(lambda: widest_gap(drawn(page)) > 0.15, "the gap")
        columns = drawn(page)
        assert columns[0] < 0.3 and columns[-1] > 0.9
        for last in range(400, 500, 20):
            draw(past(last, last // 20 % ENVS), env=last // 20 % ENVS)
        until(lambda: whole(page), "the curve of another env")
        for last in range(2, 60, 2):
            draw(past(last, last // 20), env=last // 20)
        until(lambda: whole(page), "the curve after a rebuild")
        assert errors == []
