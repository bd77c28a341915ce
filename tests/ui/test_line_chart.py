"""A chart that is there is only ever sent data; what a browser draws of them is in ``tests/browser/test_charts.py``."""

from __future__ import annotations

import numpy as np
import viser

from tests.drive.panels import Panels
from workbench.ui.line_chart import CURSOR, STEP, TAKING_TURNS, YES_OR_NO, LineChart, line, span_of, with_gaps

SERIES = (STEP, line("one", "#228be6", 1.8))
X = np.arange(3.0)
Y = np.array([0.5, np.nan, 1.0])


def test_what_is_no_number_is_a_gap() -> None:
    assert with_gaps(np.array([0.5, np.nan, np.inf, -np.inf, 1.0])) == [0.5, None, None, None, 1.0]
    assert with_gaps(X) is X


def test_new_data_go_to_the_same_chart_and_other_lines_to_another(server: viser.ViserServer) -> None:
    chart = LineChart(server, server.gui.add_folder(None), 150)
    chart.draw("reward", (X, Y), SERIES)
    first = chart.handle
    chart.draw("reward", (X, Y + 1), SERIES)
    assert chart.handle is first and first is not None
    np.testing.assert_array_equal(first.data[1], Y + 1)
    for title, series, span in (
        ("reward of env 1", SERIES, None),
        ("reward of env 1", (*SERIES, CURSOR), None),
        ("reward of env 1", (*SERIES, CURSOR), YES_OR_NO),
    ):
        before = chart.handle
        chart.draw(title, (X, Y, Y)[: len(series)], series, span)
        assert chart.handle is not before


def test_charts_take_turns_in_one_place_and_one_is_shown(panels: Panels) -> None:
    folder = panels.server.gui.add_folder(None)
    upper, lower = LineChart(panels.server, folder, 150), LineChart(panels.server, folder, 150)
    upper.draw("reward", (X, Y), SERIES)
    lower.draw("success", (X, Y), SERIES)
    seen = [upper.handle]
    for env in range(5):
        upper.draw(f"reward of env {env}", (X, Y), SERIES)
        assert upper.handle is not None and lower.handle is not None and upper.handle not in seen[-2:]
        assert upper.handle.title == f"reward of env {env}" and upper.handle.order < lower.handle.order
        seen.append(upper.handle)
        assert sorted(panels.charts(), key=lambda chart: chart.order) == [upper.handle, lower.handle]
    assert len(panels.charts(hidden=True)) == TAKING_TURNS + 1
    upper.hide()
    assert panels.charts() == [lower.handle]


def test_yes_or_no_has_one_range_and_numbers_that_of_the_data() -> None:
    assert span_of((np.array([0.0, np.nan, 1.0]), np.zeros(2))) == YES_OR_NO
    assert span_of((np.array([0.0, 0.5]),)) is None
