"""An existing chart is only sent data; what a browser draws is tested in ``tests/browser/test_charts.py``."""

from __future__ import annotations

import numpy as np
import viser

from tests.drive.panels import Panels
from workbench.page.widgets.line_chart import ROTATED_CHARTS, YES_OR_NO, ChartLine, LineChart, span_of

X = np.arange(3.0)
Y = np.array([0.5, np.nan, 1.0])
LINES = (ChartLine("one", Y),)


def test_new_data_reuse_the_chart_and_other_lines_need_a_new_one(server: viser.ViserServer) -> None:
    chart = LineChart(server, server.gui.add_folder(None), 150)
    chart.draw("reward", X, LINES)
    first = chart.handle
    chart.draw("reward", X, (ChartLine("one", Y + 1),))
    assert chart.handle is first and first is not None
    np.testing.assert_array_equal(first.data[1], Y + 1)
    for lines, dot, span in (
        (LINES, None, None),
        (LINES, Y, None),
        (LINES, Y, YES_OR_NO),
        ((ChartLine("one", Y, "#000000"),), Y, YES_OR_NO),
        ((ChartLine("one", Y, "#000000", 1.0),), Y, YES_OR_NO),
    ):
        before = chart.handle
        chart.draw("reward of env 1", X, lines, dot, span)
        assert chart.handle is not before


def test_a_chart_without_numbers_or_with_a_single_x_is_hidden(panels: Panels) -> None:
    chart = LineChart(panels.server, panels.server.gui.add_folder(None), 150)
    nothing = ChartLine("two", np.array([np.nan, np.inf, np.nan]))
    chart.draw("reward", X, (nothing, *LINES))
    for x, lines in ((X, ()), (X, (nothing,)), (X[:1], (ChartLine("one", Y[:1]),))):
        assert len(panels.charts()) == 1
        chart.draw("reward", x, lines)
        assert panels.charts() == []
        chart.draw("reward", X, LINES)


def test_charts_share_one_place_and_one_of_them_is_shown(panels: Panels) -> None:
    folder = panels.server.gui.add_folder(None)
    upper, lower = LineChart(panels.server, folder, 150), LineChart(panels.server, folder, 150)
    upper.draw("reward", X, LINES)
    lower.draw("success", X, LINES)
    seen = [upper.handle]
    for env in range(5):
        upper.draw(f"reward of env {env}", X, LINES)
        assert upper.handle is not None and lower.handle is not None and upper.handle not in seen[-2:]
        assert upper.handle.title == f"reward of env {env}" and upper.handle.order < lower.handle.order
        seen.append(upper.handle)
        assert sorted(panels.charts(), key=lambda chart: chart.order) == [upper.handle, lower.handle]
    assert len(panels.charts(hidden=True)) == ROTATED_CHARTS + 1
    upper.hide()
    assert panels.charts() == [lower.handle]


def test_booleans_have_a_fixed_range_and_numbers_the_range_of_the_data() -> None:
    assert span_of((np.array([0.0, np.nan, 1.0]), np.zeros(2))) == YES_OR_NO
    assert span_of((np.array([0.0, 0.5]),)) is None
