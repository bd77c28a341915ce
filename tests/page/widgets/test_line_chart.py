"""Charts of lines over steps."""

from __future__ import annotations

from html import unescape

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.drive.charts import charts_in
from tests.drive.panels import Panels
from workbench.live.timeline_commands import Seek
from workbench.page.widgets.line_chart import (
    MAX_POINTS,
    YES_OR_NO,
    ChartLine,
    LineChart,
    chart_html,
    drawn_span,
    part_round,
    polylines,
    span_of,
    ticks,
)
from workbench.page.widgets.templates import asks

X = np.arange(3.0)
Y = np.array([0.5, np.nan, 1.0])
LINES = (ChartLine("one", Y),)


def test_a_line_is_drawn_at_its_numbers_with_gaps_and_the_legend_has_the_value_at_the_cursor() -> None:
    lines = ChartLine("", np.array([0.0, 1.0, 2.0]), "#868e96"), ChartLine("<one>", Y, "#228be6")
    (chart,) = charts_in(chart_html("reward", X, lines, at=2.0))
    assert chart.title == "reward" and chart.legend == (("<one>", "1"),) and chart.cursor == pytest.approx(2)
    np.testing.assert_allclose(chart.of("#868e96"), [[0, 0], [1, 1], [2, 2]], atol=0.01)
    np.testing.assert_allclose(chart.of("#228be6")[[0, -1]], [[0, 0.5], [2, 1]], atol=0.01)
    assert len(chart.lines) == 3, "the gap splits the second line into two"


def test_larger_numbers_are_higher_and_later_steps_further_right() -> None:
    html = chart_html("reward", X, [ChartLine("one", X)])
    assert 'points="0,100 50,50 100,0"' in html, "y runs down in SVG"


def test_the_legend_of_a_step_without_a_value_has_a_dash() -> None:
    (chart,) = charts_in(chart_html("reward", X, LINES, at=1.0))
    assert chart.legend == (("one", "—"),)


def test_a_press_sends_the_step_under_it() -> None:
    html = chart_html(
        "reward", np.arange(5, 55), [ChartLine("one", np.arange(50.0))], press=lambda k: Seek(step=k)
    )
    assert f'data-do="{asks(Seek(step=5))}"' in unescape(html) and "data-along='[\"step\", 5, 54]'" in html
    assert "data-do" not in chart_html("reward", X, LINES)


def test_a_chart_without_numbers_or_with_a_single_x_is_hidden(panels: Panels) -> None:
    chart = LineChart(panels.server, 150)
    nothing = ChartLine("two", np.array([np.nan, np.inf, np.nan]))
    chart.draw("reward", X, (nothing, *LINES))
    for x, lines in ((X, ()), (X, (nothing,)), (X[:1], (ChartLine("one", Y[:1]),))):
        assert len(panels.charts()) == 1
        chart.draw("reward", x, lines)
        assert panels.charts() == []
        chart.draw("reward", X, LINES)


@pytest.mark.parametrize("value", [0.0, -3.0, 1e9])
def test_a_constant_is_a_line_in_the_middle(value: float) -> None:
    html = chart_html("reward", X, [ChartLine("one", np.full(3, value))])
    assert 'points="0,50 50,50 100,50"' in html


@given(st.floats(-1e6, 1e6), st.floats(1e-3, 1e6))
def test_an_axis_has_a_few_round_numbers_within_its_ends(low: float, size: float) -> None:
    high = low + size
    if not low < high:
        return
    found = ticks(low, high)
    slack = 1e-6 * size
    assert len(found) <= 5 and all(low - slack <= one <= high + slack for one in found)
    assert len(found) >= 1


def test_booleans_have_a_fixed_range_and_numbers_the_range_of_the_data() -> None:
    assert span_of((np.array([0.0, np.nan, 1.0]), np.zeros(2))) == YES_OR_NO
    assert span_of((np.array([0.0, 0.5]),)) is None


def test_a_part_of_a_long_curve_is_around_the_shown_step_or_at_the_newest() -> None:
    half = MAX_POINTS // 2
    for count, place, part in (
        (100, None, (0, 100)),
        (100, 5, (0, 100)),
        (2 * MAX_POINTS, None, (MAX_POINTS, 2 * MAX_POINTS)),
        (2 * MAX_POINTS, 5, (0, MAX_POINTS)),
        (2 * MAX_POINTS, MAX_POINTS, (half, MAX_POINTS + half)),
        (2 * MAX_POINTS, 2 * MAX_POINTS - 3, (MAX_POINTS, 2 * MAX_POINTS)),
    ):
        found = part_round(count, place)
        assert (found.start, found.stop) == part, (count, place)


def test_gaps_split_a_line_and_a_single_point_is_a_dot() -> None:
    assert polylines([None, "1,1", "2,2", None, None, "3,3", None]) == ["1,1 2,2", "3,3 3,3"]
    assert polylines([]) == polylines([None]) == []


def test_an_axis_fits_its_numbers_and_hides_rounding_errors() -> None:
    assert drawn_span(-2.0, 3.0) == (-2.0, 3.0)
    assert drawn_span(1e6, 1e6 + 1) == (500_000.0, 1_500_001.0), "float32 rounds that"
    assert drawn_span(0.0, 0.0) == (-0.5, 0.5)
    assert ticks(0.0, 10.0) == [0.0, 5.0, 10.0] and ticks(-0.3, 0.3) == [-0.2, 0.0, 0.2]


def test_the_cursor_is_drawn_only_within_the_steps() -> None:
    for at, shown in ((-1.0, False), (0.0, True), (2.0, True), (2.5, False), (None, False)):
        (chart,) = charts_in(chart_html("reward", X, LINES, at=at))
        assert (chart.cursor is not None) is shown, at
    (chart,) = charts_in(chart_html("reward", X, LINES, at=0.4))
    assert chart.legend == (("one", "0.5"),), "of the nearest step"
