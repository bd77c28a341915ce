"""The curves of the Reward tab: which ones, of which env, and what a click does."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.drive.live import Live
from tests.drive.scenes import running, step_of
from workbench.envs.step_result import StepResult
from workbench.live.commands import ToggleCurve
from workbench.live.history.curves import Curves, Group, StepCurves
from workbench.live.past import TimelineView
from workbench.live.timeline_commands import Seek, SeekOnCurve
from workbench.live.view import SessionView

JOINTS = ("hinge", "slide")


def step(number: int, num_envs: int, success: float | None = 0.0, **entries: Any) -> StepResult:
    evaluate = {} if success is None else {"success": np.full(num_envs, success, bool)}
    result = step_of(np.zeros((num_envs, 1, 7), np.float32), **evaluate, **entries)
    reward = np.arange(num_envs, dtype=np.float32) + number * num_envs
    return replace(result, reward=reward, qpos=np.full((num_envs, 2), number, np.float32))


def curves(length: int, num_envs: int, env: int = 0, success: float | None = 0.0, **entries: Any) -> Curves:
    """The reward of env k at step t is k + t N."""
    steps = StepCurves(num_envs, JOINTS)
    for number in range(1, length + 1):
        steps.add(step(number, num_envs, success, **entries))
    return steps.curves(env)


@pytest.fixture
def live(open_live: Live) -> Live:
    open_live.show(running(4))
    open_live.asked.clear()
    return open_live


def reward(length: int, num_envs: int, env: int) -> list[float]:
    return [env + number * num_envs for number in range(1, length + 1)]


def seen(length: int, num_envs: int, env: int = 0, past: int | None = None, **entries: Any) -> SessionView:
    """A view after `length` steps; `past` is the shown step, if not the last."""
    view = running(num_envs, curves=curves(length, num_envs, env, **entries), selected_env=env)
    shown = step(length if past is None else past, num_envs)
    timeline = TimelineView(0, length, past, tick=length if past is None else past)
    assert view.task is not None
    return replace(view, step=shown, timeline=timeline, task=replace(view.task, joints=JOINTS))


def test_selected_env_against_the_mean(live: Live) -> None:
    live.show(seen(5, 4, env=2))
    chart = live.part("Reward").charts()[0]
    x, mean, one = chart.data
    assert x.tolist() == [1, 2, 3, 4, 5]
    assert mean.tolist() == [1.5 + 4 * number for number in x] and one.tolist() == reward(5, 4, 2)
    assert [series.get("label") for series in chart.series] == ["step", "mean of the batch", "env 2"]


@pytest.mark.thorough
def test_a_long_run_is_sent_as_few_points(live: Live) -> None:
    live.show(seen(3000, 2))
    for chart in live.part("Reward").charts():
        assert {len(values) for values in chart.data} == {len(chart.data[0])} and len(chart.data[0]) < 1000
        assert chart.data[0][0] == 1 and chart.data[0][-1] == 3000


def test_other_env_shows_its_own_past(live: Live) -> None:
    live.show(seen(50, 4))
    live.show(seen(50, 4, env=3))
    chart = live.part("Reward").charts()[0]
    assert chart.data[2].tolist() == reward(50, 4, 3)
    assert chart.series[2].get("label") == "env 3"


@pytest.mark.thorough
@pytest.mark.parametrize("length", [50, 3000])
def test_the_shown_moment_is_a_dot_on_the_selected_envs_line(live: Live, length: int) -> None:
    live.show(seen(length, 4, env=3, past=17))
    drawn = live.part("Reward").charts()
    assert [chart.title for chart in drawn] == ["reward", "success"]
    x, *_, dot = drawn[0].data
    (at,) = np.flatnonzero(np.isfinite(dot))
    assert abs(x[at] - 17) <= 8 and dot[at] == 3 + 17 * 4
    assert [series.get("label") for series in drawn[0].series][-2:] == ["env 3", "shown"]
    live.show(seen(length, 4, env=3))
    assert "shown" not in [series.get("label") for series in live.part("Reward").charts()[0].series]


def test_each_part_of_the_reward_has_a_line_of_the_selected_env(live: Live) -> None:
    terms: dict[str, Any] = {
        "reward_terms/reach": np.array([1.0, 2, 3]),
        "reward_terms/<b>": np.array([-1.0, -2, -3]),
    }
    view = seen(4, 3, env=1, **terms)
    assert view.curves is not None
    live.show(replace(view, curves=replace(view.curves, no_curve=("sum",))))
    *_, chart = live.part("Reward").charts()
    assert chart.title == "reward terms, env 1"
    assert [series.get("label") for series in chart.series] == ["step", "reach", "<b>"]
    assert [values.tolist() for values in chart.data[1:]] == [[2.0] * 4, [-2.0] * 4]
    assert "No curve of sum" in live.part("Reward").html() and "<b>" not in live.part(
        "Reward"
    ).html().replace("<b>⚑", "")


def test_any_entry_or_joint_can_be_chosen_and_the_choice_is_kept_per_task(live: Live) -> None:
    entries = {"height": np.array([0.1, 0.2]), "at": np.ones((2, 3)), "touches": np.array([True, False])}
    view = seen(3, 2, env=1, **entries)
    live.show(view)
    for entry in ((Group.EVALUATE, "height"), (Group.EVALUATE, "at"), (Group.JOINT, "slide")):
        live.part("Reward").ask(ToggleCurve(group=entry[0].value, name=entry[1]))
    live.part("Reward").ask(ToggleCurve(group="evaluate", name="success"))
    live.show(view)
    assert [chart.title for chart in live.part("Reward").charts()] == [
        "reward",
        "height",
        "at, env 1",
        "joints, env 1",
    ]
    _, height, at, joints = live.part("Reward").charts()
    np.testing.assert_allclose(height.data[1:], [[0.15] * 3, [0.2] * 3], rtol=1e-6)
    assert [series.get("label") for series in at.series] == ["step", "at[0]", "at[1]", "at[2]"]
    assert joints.data[1].tolist() == [1, 2, 3]
    assert view.task is not None
    live.show(replace(view, task=replace(view.task, class_name="Other")))
    assert [chart.title for chart in live.part("Reward").charts()] == ["reward", "success"]
    live.show(view)
    assert [chart.title for chart in live.part("Reward").charts()] == [
        "reward",
        "height",
        "at, env 1",
        "joints, env 1",
    ]


def test_a_click_on_a_curve_seeks_its_step_and_a_dropped_step_is_refused(live: Live) -> None:
    view = seen(50, 2)
    live.show(view)
    live.do(SeekOnCurve(step=7))
    assert live.asked == [Seek(step=7)]
    kept = TimelineView(30, 50, 30, tick=31)
    live.show(replace(view, timeline=kept))
    assert (
        "Step 7 is no longer in memory: step 31 is shown, the oldest one there" in live.part("Reward").html()
    )
    live.do(SeekOnCurve(step=40))
    live.show(replace(view, timeline=replace(kept, shown=39, tick=40)))
    assert "no longer in memory" not in live.part("Reward").html()


def test_no_curve_is_drawn_without_a_past(live: Live) -> None:
    live.show(running(4, curves=None))
    live.show(seen(1, 4))
    assert (
        live.part("Reward").charts() == []
        and "Curves appear after the second step." in live.part("Reward").html()
    )
    live.show(seen(2, 4))
    assert len(live.part("Reward").charts()) == 2 and "Curves appear" not in live.part("Reward").html()
    live.show(seen(1, 4))
    assert live.part("Reward").charts() == []


def test_envs_whose_reward_is_nan_are_counted_and_left_out_of_the_mean(live: Live) -> None:
    steps = StepCurves(4)
    for number in range(50):
        result = step(number, 4)
        if number >= 40:
            result.reward[:3] = np.nan
        steps.add(result)
    live.show(replace(seen(50, 4), curves=steps.curves(0)))
    chart = live.part("Reward").charts()[0]
    assert chart.data[1][40:].tolist() == [3 + 4 * number for number in range(40, 50)]
    assert np.isnan(chart.data[2][40:]).all()
    assert "NaN in 3 of 4 envs; the mean is of the others" in live.part("Reward").html()
    live.show(seen(50, 4))
    assert "NaN" not in live.part("Reward").html()
