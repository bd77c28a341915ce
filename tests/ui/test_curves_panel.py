from __future__ import annotations

import numpy as np

from tests.drive.panels import Panels
from tests.ui.scenes import running
from workbench.session.view import Curves
from workbench.ui.curves_panel import CurvesPanel, curve_data
from workbench.ui.line_chart import LONGEST


def curves(length: int, num_envs: int, success: float | None = 0.0, serial: int = 1) -> Curves:
    reward = np.arange(length * num_envs, dtype=np.float32).reshape(length, num_envs)
    flags = np.full_like(reward, np.nan if success is None else success)
    return Curves(serial, np.arange(length), reward, flags, np.zeros_like(reward, bool))


def test_selected_env_against_the_mean() -> None:
    past = curves(5, 4)
    (x, mean, one), labels = curve_data(past.tick, past.reward, 2)
    np.testing.assert_array_equal(x, past.tick)
    np.testing.assert_allclose(mean, past.reward.mean(axis=1))
    np.testing.assert_array_equal(one, past.reward[:, 2])
    assert labels == ("mean of the batch", "env 2")


def test_only_the_newest_part_is_sent() -> None:
    past = curves(LONGEST * 3, 2)
    (x, *_), _ = curve_data(past.tick, past.reward, 0)
    assert len(x) == LONGEST
    assert x[-1] == past.tick[-1]


def test_single_env_has_one_line() -> None:
    past = curves(5, 1)
    assert curve_data(past.tick, past.reward, 0)[1] == ("env 0",)


def test_other_env_shows_its_own_past(panels: Panels) -> None:
    panel = CurvesPanel(panels.server)
    past = curves(50, 4)
    panel.draw(running(4, curves=past, selected_env=0))
    panel.draw(running(4, curves=past, selected_env=3))
    chart = panels.charts()[0]
    assert len(chart.data[0]) == 50
    np.testing.assert_array_equal(chart.data[2], past.reward[:, 3])
    assert chart.series[2].get("label") == "env 3"


def test_task_without_success_has_no_curve_of_it(panels: Panels) -> None:
    panel = CurvesPanel(panels.server)
    panel.draw(running(4, curves=curves(50, 4, success=None)))
    assert [chart.title for chart in panels.charts()] == ["reward"]
    assert "Curves appear" not in panels.html()


def test_without_a_past_nothing_is_drawn(panels: Panels) -> None:
    panel = CurvesPanel(panels.server)
    panel.draw(running(4, curves=None))
    panel.draw(running(4, curves=curves(1, 4)))
    assert panels.charts() == [] and "Curves appear with the second step." in panels.html()
    panel.draw(running(4, curves=curves(2, 4, serial=2)))
    assert len(panels.charts()) == 2 and "Curves appear" not in panels.html()


def test_envs_whose_reward_is_nan_are_counted_and_left_out_of_the_mean(panels: Panels) -> None:
    past = curves(50, 4)
    past.reward[40:, :3] = np.nan
    panel = CurvesPanel(panels.server)
    panel.draw(running(4, curves=past, selected_env=0))
    chart = panels.charts()[0]
    np.testing.assert_array_equal(chart.data[1][40:], past.reward[40:, 3])
    assert np.isnan(chart.data[2][40:]).all()
    assert "NaN in 3 of 4 envs; the mean is of the others" in panels.html()
    panel.draw(running(4, curves=curves(50, 4, serial=2)))
    assert "NaN" not in panels.html()
