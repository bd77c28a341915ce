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
    REWARD,
    SUCCESS,
    Column,
    Columns,
    Group,
    columns_by_label,
    columns_of,
    number_of,
    spans_of,
    without_curve,
)

N = 3
REACH = Column(Group.TERM, "reach")


def step(number: int, **terms: Any) -> StepResult:
    entries = {f"reward_terms/{name}": np.asarray(value, np.float32) for name, value in terms.items()}
    result = moment(np.full(N, number), success=(2,) if number == 2 else ()).step
    return replace(result, evaluate={**result.evaluate, **entries})


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
@example(np.array([[0.0], [np.nan]], np.float32))
@settings(max_examples=15)
def test_a_long_line_becomes_few_points_and_keeps_each_peak_at_its_step(values: NDArray[np.float32]) -> None:
    x, (one, _) = spans_of(values).points()
    assert (np.diff(x) > 0).all() and len(x) <= 3 * 400 + 1
    finite = values[0][np.isfinite(values[0])]
    if len(finite):
        assert (np.nanmin(one), np.nanmax(one)) == (finite.min(), finite.max())
    drawn = np.isfinite(one)
    np.testing.assert_array_equal(values[0][x[drawn].astype(int) - 1], one[drawn])
    assert np.isnan(one).any() == (len(finite) < len(values[0]))
    late, again = spans_of(values, first=41).points()
    np.testing.assert_array_equal(late, x + 40)
    np.testing.assert_array_equal(again[0], one)


def everything() -> StepResult:
    """A step with an entry of every kind."""
    entries = {
        "height": np.arange(3.0),
        "at": np.arange(9.0).reshape(N, 3),
        "picture": np.zeros((N, 64)),
        "none": np.zeros((N, 0)),
    }
    result = step(2, reach=[1, 2, 0])
    mean = OtherEntry("float", numbers=np.array(0.5))
    return replace(
        result,
        evaluate={**result.evaluate, **entries},
        others={"mean": mean, "phase": OtherEntry("str", ("push",))},
        qpos=np.array([[0.1, 1.0], [0.2, 2.0], [0.3, 3.0]], np.float32),
    )


JOINTS = ("hinge", "slide")


def test_entries_terms_and_joints_are_columns_named_after_them() -> None:
    columns = columns_of(everything(), JOINTS)
    assert [column.label for column in columns] == [
        *("reward", "success", "reach", "fail", "height", "at[0]", "at[1]", "at[2]", "mean", "hinge", "slide")
    ]
    assert columns[REWARD].tolist() == [2.0] * N and columns[SUCCESS].tolist() == [False, False, True]
    assert columns[REACH].tolist() == [1, 2, 0]


def test_labels_are_unique_and_an_entry_of_eight_numbers_still_has_curves() -> None:
    result = step(1, reach=[1, 2, 3])
    entries = {"reach": np.zeros(N), "eight": np.zeros((N, 8)), "nine": np.zeros((N, 9))}
    labels = columns_by_label(replace(result, evaluate={**result.evaluate, **entries}), JOINTS)
    assert labels["reach"] == REACH and labels["evaluate reach"] == Column(Group.EVALUATE, "reach")
    assert [one for one in labels if "[" in one] == [f"eight[{k}]" for k in range(8)]


def test_one_number_equals_its_column() -> None:
    result = everything()
    for column, values in columns_of(result, JOINTS).items():
        assert [number_of(result, column, env, JOINTS) for env in range(N)] == values.tolist(), column
    for column in (Column(Group.TERM, "lift"), Column(Group.JOINT, "lift"), Column(Group.EVALUATE, "at", 3)):
        assert np.isnan(number_of(result, column, 0, JOINTS))
    assert np.isnan(number_of(replace(result, qpos=None), Column(Group.JOINT, "hinge"), 0, JOINTS))


def test_a_value_that_is_not_one_number_per_env_has_no_curve_and_is_listed() -> None:
    result = step(1, reach=[1, 2, 3], both=[[1, 2]] * N)
    mean, note = OtherEntry("float", numbers=np.array(0.5)), OtherEntry("str", ("none",))
    result = replace(result, others={"reward_terms/mean": mean, "reward_terms/note": note, "other": note})
    assert [column.name for column in columns_of(result) if column.group is Group.TERM] == ["reach"]
    assert without_curve(result) == ("both", "mean", "note")
    assert without_curve(replace(result, others={"reward_terms": note}, evaluate={})) == ("reward_terms",)
    assert without_curve(step(1, reach=[1, 2, 3])) == ()


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
