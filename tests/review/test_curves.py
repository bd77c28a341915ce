"""The curves of recordings, and the numbers beside them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.drive.charts import Chart
from tests.drive.episodes import made
from tests.drive.panels import Panels
from tests.review.recordings import aligned
from workbench.live.panels.reward_panel import NumberRow
from workbench.page.widgets.templates import colour
from workbench.review.curves_panel import ReviewCurves, compared
from workbench.review.view import Opened, ReviewView, find_events


def test_values_that_only_another_recording_has_are_in_the_table() -> None:
    old = [NumberRow("reward", "0.50", ""), NumberRow("success", "true", "", "good")]
    new = [*old[:1], NumberRow("slope", "0.10", ""), NumberRow("success", "false", "")]
    assert compared(old, [(old, 3), (new, 3)]) == [
        {"name": "reward", "tone": "", "whole": False, "hint": "", "values": ["0.50", "0.50"]},
        {"name": "success", "tone": "good", "whole": False, "hint": "", "values": ["true", "false"]},
        {"name": "slope", "tone": "", "whole": False, "hint": "", "values": ["—", "0.10"]},
    ]


def drawn(panels: Panels, view: ReviewView, title: str = "reward") -> Chart:
    ReviewCurves(panels.server).draw(view)
    (chart,) = (chart for chart in panels.charts() if chart.title == title)
    return chart


@pytest.mark.parametrize("selected", [0, 1])
@pytest.mark.parametrize("position", [-5, -2, 0, 3, 5])
def test_the_cursor_is_at_the_position_and_the_legend_has_each_recordings_value_there(
    panels: Panels, selected: int, position: int
) -> None:
    chart = drawn(panels, aligned((10, 5), (6, 2), selected=selected, position=position))
    assert chart.cursor == pytest.approx(position, abs=0.01)
    # The reward equals the number of its step; the first state has none.
    a, b = chart.of(colour(0)), chart.of(colour(1))
    np.testing.assert_allclose(a, [[step - 5, step] for step in range(1, 11)], atol=0.02)
    np.testing.assert_allclose(b, [[step - 2, step] for step in range(1, 7)], atol=0.02)
    expected = [(at, steps) for at, steps in ((position + 5, 10), (position + 2, 6))]
    assert chart.legend == tuple(
        (name, f"{at}" if 1 <= at <= steps else "—") for name, (at, steps) in zip("AB", expected, strict=True)
    )


def test_in_a_long_recording_the_value_is_that_of_the_point_nearest_to_the_position(panels: Panels) -> None:
    chart = drawn(panels, aligned((1000, 400), position=123))
    points = chart.of(colour(0))
    assert 400 < len(points) <= 600 and chart.cursor == pytest.approx(123, abs=0.1)
    ((_, value),) = chart.legend
    assert abs(float(value) - 523) <= 3


def test_a_peak_of_one_step_in_a_long_recording_is_drawn(panels: Panels) -> None:
    episode = made(3000)
    reward = np.zeros(3000, np.float32)
    reward[1234] = 7.0
    episode = replace(episode, reward=reward)
    view = aligned((3000, 0))
    view = replace(view, opened=(Opened("0", "0.rrd", episode, find_events(episode)),))
    points = drawn(panels, view).of(colour(0))
    assert points[points[:, 1] > 6.9, 0] == pytest.approx([1235], abs=0.1)
