from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.drive.panels import Panels
from tests.ui.scenes import running
from workbench.session.history.curves import Curves
from workbench.session.live.timeline import TimelineView
from workbench.ui.live.reward import CurvesPanel
from workbench.ui.widgets.line_chart import LONGEST


def curves(length: int, num_envs: int, success: float | None = 0.0, serial: int = 1) -> Curves:
    reward = np.arange(length * num_envs, dtype=np.float32).reshape(length, num_envs)
    flags = np.full_like(reward, np.nan if success is None else success)
    return Curves(serial, np.arange(length), reward, flags)


@pytest.fixture
def panel(panels: Panels) -> CurvesPanel:
    return CurvesPanel(panels.server)


def test_selected_env_against_the_mean(panels: Panels, panel: CurvesPanel) -> None:
    past = curves(5, 4)
    panel.draw(running(4, curves=past, selected_env=2))
    chart = panels.charts()[0]
    x, mean, one = chart.data
    np.testing.assert_array_equal(x, past.tick)
    np.testing.assert_allclose(mean, past.reward.mean(axis=1))
    np.testing.assert_array_equal(one, past.reward[:, 2])
    assert [series.get("label") for series in chart.series] == ["step", "mean of the batch", "env 2"]


def test_only_the_newest_part_is_sent(panels: Panels, panel: CurvesPanel) -> None:
    past = curves(LONGEST * 3, 2)
    panel.draw(running(2, curves=past))
    for chart in panels.charts():
        assert {len(values) for values in chart.data} == {LONGEST}
        assert chart.data[0][-1] == past.tick[-1] and chart.data[1][-1] in (past.reward[-1].mean(), 0)


def test_single_env_has_one_line(panels: Panels, panel: CurvesPanel) -> None:
    panel.draw(running(1, curves=curves(5, 1), selected_env=0))
    assert [series.get("label") for series in panels.charts()[0].series] == ["step", "env 0"]


def test_other_env_shows_its_own_past(panels: Panels, panel: CurvesPanel) -> None:
    past = curves(50, 4)
    panel.draw(running(4, curves=past, selected_env=0))
    panel.draw(running(4, curves=past, selected_env=3))
    chart = panels.charts()[0]
    assert len(chart.data[0]) == 50
    np.testing.assert_array_equal(chart.data[2], past.reward[:, 3])
    assert chart.series[2].get("label") == "env 3"


def test_a_moment_that_is_shown_is_a_dot_on_the_selected_envs_line(
    panels: Panels, panel: CurvesPanel
) -> None:
    past = curves(50, 4)
    panel.draw(running(4, curves=past, selected_env=3, timeline=TimelineView(0, 60, 27, tick=17)))
    for chart, values in zip(panels.charts(), (past.reward, past.success), strict=True):
        *_, one, dot = chart.data
        np.testing.assert_array_equal(one, values[:, 3])
        assert np.flatnonzero(np.isfinite(dot)).tolist() == [17] and dot[17] == values[17, 3]
        assert [series.get("label") for series in chart.series][-2:] == ["env 3", "shown"]


def test_each_part_of_the_reward_has_a_line_of_the_selected_env(panels: Panels, panel: CurvesPanel) -> None:
    term = np.arange(2.0 * LONGEST * 3, dtype=np.float32).reshape(-1, 3)
    parts = {"reach": term, "<b>": -term, "gone": np.full_like(term, np.nan)}
    found = replace(curves(2 * LONGEST, 3), parts=parts, no_curve=("sum",))
    panel.draw(running(3, curves=found, selected_env=1))
    *_, chart = panels.charts()
    assert chart.title == "reward terms, env 1"
    assert [series.get("label") for series in chart.series] == ["step", "reach", "<b>"]
    x, reach, other = chart.data
    np.testing.assert_array_equal(x, found.tick[-LONGEST:])
    np.testing.assert_array_equal(reach, term[-LONGEST:, 1])
    np.testing.assert_array_equal(other, -term[-LONGEST:, 1])
    assert "No curve of sum" in panels.html()


def test_how_parts_get_a_curve_is_said_where_a_dense_reward_names_none(
    panels: Panels, panel: CurvesPanel
) -> None:
    view = running(2, curves=curves(2, 2))
    assert view.task is not None
    panel.draw(view)
    says = "put info[&#34;reward_terms&#34;]" in panels.html()
    assert says == ("dense" in view.task.reward_mode)
    panel.draw(replace(view, task=replace(view.task, reward_mode="normalized_dense")))
    assert "put info" in panels.html()
    panel.draw(replace(view, task=replace(view.task, reward_mode="sparse")))
    assert "put info" not in panels.html()
    assert [chart.title for chart in panels.charts()] == ["reward", "success"]


def test_task_without_success_has_no_curve_of_it(panels: Panels, panel: CurvesPanel) -> None:
    panel.draw(running(4, curves=curves(50, 4, success=None)))
    assert [chart.title for chart in panels.charts()] == ["reward"]
    assert "Curves appear" not in panels.html()


def test_without_a_past_nothing_is_drawn(panels: Panels, panel: CurvesPanel) -> None:
    panel.draw(running(4, curves=None))
    panel.draw(running(4, curves=curves(1, 4)))
    assert panels.charts() == [] and "Curves appear after the second step." in panels.html()
    panel.draw(running(4, curves=curves(2, 4, serial=2)))
    assert len(panels.charts()) == 2 and "Curves appear" not in panels.html()


def test_envs_whose_reward_is_nan_are_counted_and_left_out_of_the_mean(
    panels: Panels, panel: CurvesPanel
) -> None:
    past = curves(50, 4)
    past.reward[40:, :3] = np.nan
    panel.draw(running(4, curves=past, selected_env=0))
    chart = panels.charts()[0]
    np.testing.assert_array_equal(chart.data[1][40:], past.reward[40:, 3])
    assert np.isnan(chart.data[2][40:]).all()
    assert "NaN in 3 of 4 envs; the mean is of the others" in panels.html()
    panel.draw(running(4, curves=curves(50, 4, serial=2)))
    assert "NaN" not in panels.html()
