"""The data of the curves and of the strip under the slider."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from tests.drive.session import moment
from workbench.envs.step_result import OtherEntry, StepResult
from workbench.live.history.curves import (
    MAX_COLUMNS,
    REWARD,
    SUCCESS,
    Column,
    Columns,
    Curves,
    Group,
    StepCurves,
    spans_of,
)

N = 3
REACH = Column(Group.TERM, "reach")


def step(number: int, **terms: Any) -> StepResult:
    entries = {f"reward_terms/{name}": np.asarray(value, np.float32) for name, value in terms.items()}
    result = moment(np.full(N, number), success=(2,) if number == 2 else ()).step
    return replace(result, evaluate={**result.evaluate, **entries})


def line(curves: Curves, column: Column, mean: bool = False) -> tuple[list[float], list[float]]:
    x, (values,) = curves.lines([(column, mean)])
    return x.tolist(), values.tolist()


def test_a_step_is_a_point_of_each_env_and_of_the_mean() -> None:
    steps = StepCurves(N)
    for number in (1, 2, 3):
        steps.add(step(number, reach=[number, 2 * number, 0]))
    curves = steps.curves(1)
    assert curves.serial == steps.count == 3
    assert line(curves, REWARD) == ([1, 2, 3], [1, 2, 3])
    assert line(curves, REACH) == ([1, 2, 3], [2, 4, 6])
    assert line(curves, REACH, mean=True) == ([1, 2, 3], [1, 2, 3])
    assert line(steps.curves(2), SUCCESS)[1] == [0, 1, 0]


def test_a_later_step_does_not_change_curves_that_were_read() -> None:
    steps = StepCurves(N)
    steps.add(step(1, reach=[1, 1, 1]))
    curves = steps.curves(0)
    for number in range(2000):
        steps.add(step(number))
    assert line(curves, REACH) == ([1], [1]) and curves.newest.tolist() == [1] * N


NUMBERS = arrays(
    np.float32,
    st.tuples(st.just(2), st.integers(1, 1100)),
    elements=st.one_of(st.integers(-3, 3).map(float), st.sampled_from([np.nan, np.inf, -np.inf])),
    fill=st.sampled_from([0.0, np.nan]),
)


INFINITE_AT_THE_END = np.zeros((2, 812), np.float32)
INFINITE_AT_THE_END[:, -1] = np.inf


@given(NUMBERS)
@example(INFINITE_AT_THE_END)
@settings(max_examples=15)
def test_the_whole_run_fits_bounded_memory_and_keeps_each_peak_at_its_step(
    rewards: NDArray[np.float32],
) -> None:
    steps = StepCurves(2)
    base = moment(np.full(N, 1)).step
    for number in range(rewards.shape[1]):
        steps.add(replace(base, reward=rewards[:, number], evaluate={}))
    curves = steps.curves(1)
    spans, whole = curves.spans, spans_of(rewards[1:])
    assert spans.width == whole.width and spans.low.shape[1] <= 400
    for kept, made in ((spans.low, whole.low), (spans.high, whole.high), (spans.gap, whole.gap)):
        np.testing.assert_array_equal(kept[:1], made)
    known = np.isfinite(whole.low)
    np.testing.assert_array_equal(spans.low_at[:1][known], whole.low_at[known])
    np.testing.assert_array_equal(spans.high_at[:1][known], whole.high_at[known])
    x, (one,) = curves.lines([(REWARD, False)])
    assert (np.diff(x) > 0).all() and len(x) <= 3 * 400 + 1
    if np.isfinite(rewards[1]).any():
        finite = rewards[1][np.isfinite(rewards[1])]
        assert (np.nanmin(one), np.nanmax(one)) == (finite.min(), finite.max())
    drawn = np.isfinite(one)
    np.testing.assert_array_equal(rewards[1][x[drawn].astype(int) - 1], one[drawn])
    lost = ~np.isfinite(rewards[1])
    assert np.isnan(one).any() == lost.any()


def test_entries_terms_and_joints_are_columns_named_after_them() -> None:
    steps = StepCurves(N, joints=("hinge", "slide"))
    entries = {
        "height": np.arange(3.0),
        "at": np.zeros((N, 3)),
        "picture": np.zeros((N, 64)),
        "none": np.zeros((N, 0)),
    }
    result = step(1, reach=[1, 2, 0])
    mean = OtherEntry("float", numbers=np.array(0.5))
    steps.add(
        replace(
            result,
            evaluate={**result.evaluate, **entries},
            others={"mean": mean, "phase": OtherEntry("str", ("push",))},
            qpos=np.array([[0.1, 1.0], [0.2, 2.0], [0.3, 3.0]], np.float32),
        )
    )
    curves = steps.curves(2)
    assert [column.label for column in curves.columns] == [
        *("reward", "success", "reach", "fail", "height", "at[0]", "at[1]", "at[2]", "mean", "hinge", "slide")
    ]
    assert line(curves, Column(Group.JOINT, "slide"))[1] == [3.0]
    assert line(curves, Column(Group.EVALUATE, "mean"))[1] == [0.5]


def test_a_value_that_is_not_one_number_per_env_has_no_curve_and_is_listed() -> None:
    steps = StepCurves(N)
    result = step(1, reach=[1, 2, 3], both=[[1, 2]] * N)
    mean, note = OtherEntry("float", numbers=np.array(0.5)), OtherEntry("str", ("none",))
    result = replace(result, others={"reward_terms/mean": mean, "reward_terms/note": note, "other": note})
    for _ in range(2):
        steps.add(result)
    curves = steps.curves(0)
    assert [column.name for column in curves.columns if column.group is Group.TERM] == ["reach"]
    assert curves.no_curve == ("both", "mean", "note")
    steps.add(replace(result, others={"reward_terms": note}, evaluate={}))
    assert steps.curves(0).no_curve == ("reward_terms",)
    steps.add(step(1, reach=[1, 2, 3]))
    assert steps.curves(0).no_curve == ()


def test_columns_are_limited_and_dropped_ones_make_room() -> None:
    steps = StepCurves(N)
    steps.add(step(1, **{f"term{i}": [0] * N for i in range(MAX_COLUMNS + 5)}))
    kept = steps.curves(0).columns
    assert len(kept) == MAX_COLUMNS and kept[:2] == (REWARD, SUCCESS)
    steps.add(step(2, other=[1] * N))
    assert [column.name for column in steps.curves(0).columns] == ["reward", "success", "other", "fail"]
    assert line(steps.curves(0), REWARD) == ([1, 2], [1, 2])


def test_requested_rows_keep_their_step_numbers_and_a_missing_value_is_nan() -> None:
    columns = Columns(2, first=50)
    for number in range(50, 5050):
        values = {"a": np.array([number, -number])}
        columns.write(number, max(50, number - 700), values if number % 7 else {**values, "b": np.ones(2)})
    assert columns.between("a", 4400, 5049)[:, 1].tolist() == [-number for number in range(4400, 5050)]
    assert np.flatnonzero(np.isfinite(columns.between("b", 4400, 5049)[:, 0])).tolist() == [
        number - 4400 for number in range(4400, 5050) if number % 7 == 0
    ]
    assert (
        columns.between("c", 4400, 4402).shape == (3, 2) and np.isnan(columns.between("c", 4400, 4402)).all()
    )
    columns.write(5049, 4400, {"a": np.zeros(2)})
    assert columns.between("a", 5048, 5049).tolist() == [[5048, -5048], [0, 0]], (
        "the newest row is overwritten"
    )
    assert columns.between("a", 5049, 5048).shape == (0, 2)
