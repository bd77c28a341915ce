"""The rows of numbers that curves and the strip under the slider are drawn from."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.session.moments import N, stepped
from workbench.core.env.step_result import OtherEntry, StepResult
from workbench.session.history.curves import MOST, Columns, RecentSteps


def step(number: int, **terms: Any) -> StepResult:
    entries = {f"reward_terms/{name}": np.asarray(value, np.float32) for name, value in terms.items()}
    result = stepped(number, success=(2,) if number == 2 else ()).step
    return replace(result, evaluate={**result.evaluate, **entries})


def test_a_row_is_a_step() -> None:
    recent = RecentSteps(N)
    for number in (1, 2, 3):
        recent.add(step(number))
    curves = recent.curves()
    assert curves.serial == recent.count == 3 and curves.tick.tolist() == [1, 2, 3]
    assert curves.reward.tolist() == [[1.0] * N, [2.0] * N, [3.0] * N]
    assert curves.success.tolist() == [[0, 0, 0], [0, 0, 1], [0, 0, 0]]


def test_a_task_has_empty_curves_before_its_first_step() -> None:
    curves = RecentSteps(N).curves()
    assert curves.tick.tolist() == [] and curves.reward.shape == curves.success.shape == (0, N)
    assert curves.terms == {}


@pytest.mark.parametrize("count", [999, 1000, 1001, 2048, 2500])
def test_only_the_newest_are_kept_oldest_first(count: int) -> None:
    recent = RecentSteps(N)
    for number in range(count):
        recent.add(step(number, reach=[number, -number, 0]))
    curves = recent.curves()
    kept = list(range(max(0, count - 1000), count))
    assert curves.tick.tolist() == [number + 1 for number in kept]
    assert curves.reward[:, 1].tolist() == curves.terms["reach"][:, 0].tolist() == kept
    assert curves.serial == count


def test_curves_that_were_taken_do_not_change_and_a_task_without_success_has_none() -> None:
    recent = RecentSteps(N)
    recent.add(replace(step(1), evaluate={"reward_terms/reach": np.ones(N)}))
    curves = recent.curves()
    before = curves.reward.copy(), curves.terms["reach"].copy()
    assert np.shares_memory(recent.curves().reward, curves.reward), "nothing is copied"
    for number in range(2000):
        recent.add(step(number))
    assert np.array_equal((curves.reward, curves.terms["reach"]), before) and np.isnan(curves.success).all()


def test_terms_are_kept_by_their_name_and_other_entries_are_not() -> None:
    recent = RecentSteps(N)
    recent.add(step(1, reach=[1, 2, 0]))
    recent.add(step(2, reach=[3, 4, 0], push=[5, 6, 7]))
    curves = recent.curves()
    assert curves.tick.tolist() == [1, 2]
    assert curves.terms.keys() == {"reach", "push"}
    assert curves.terms["reach"].tolist() == [[1, 2, 0], [3, 4, 0]]
    np.testing.assert_array_equal(curves.terms["push"], [[np.nan] * 3, [5, 6, 7]])


def test_what_is_no_number_for_each_env_has_no_curve_and_is_named() -> None:
    recent = RecentSteps(N)
    result = step(1, reach=[1, 2, 3], both=[[1, 2]] * N)
    mean, note = OtherEntry("float", numbers=np.array(0.5)), OtherEntry("str", ("none",))
    result = replace(result, others={"reward_terms/mean": mean, "reward_terms/note": note, "other": note})
    for _ in range(2):
        recent.add(result)
    curves = recent.curves()
    assert (list(curves.terms), curves.no_curve) == (["reach"], ("both", "mean", "note"))
    recent.add(replace(result, others={"reward_terms": note}, evaluate={}))
    assert recent.curves().no_curve == ("reward_terms",)
    recent.add(step(1, reach=[1, 2, 3]))
    assert recent.curves().no_curve == ()


def test_a_success_of_several_numbers_counts_by_its_first() -> None:
    recent = RecentSteps(N)
    recent.add(replace(step(1), evaluate={"success": np.array([[0, 1], [1, 0], [1, 1]], np.float32)}))
    assert recent.curves().success.tolist() == [[0, 1, 1]]


def test_a_term_that_a_new_version_drops_goes_when_its_last_value_goes() -> None:
    recent = RecentSteps(N)
    recent.add(step(1, reach=[1, 1, 1]))
    for number in range(999):
        recent.add(step(number, push=[1, 1, 1]))
    assert recent.curves().terms.keys() == {"reach", "push"}
    recent.add(step(1, push=[1, 1, 1]))
    assert recent.curves().terms.keys() == {"push"}


def test_the_number_of_terms_is_bounded_and_those_that_are_long_gone_make_room() -> None:
    recent = RecentSteps(N)
    recent.add(step(1, **{f"term{i}": [0] * N for i in range(MOST + 5)}))
    recent.add(step(2, other=[1] * N))
    assert list(recent.curves().terms) == [f"term{i}" for i in range(MOST)]
    for number in range(1100):
        recent.add(step(number))
    recent.add(step(3, other=[1] * N))
    assert list(recent.curves().terms) == ["other"]


def test_rows_that_are_wanted_stay_with_their_numbers_and_a_missing_value_is_none() -> None:
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
    assert columns.between("a", 5048, 5049).tolist() == [[5048, -5048], [0, 0]], "the newest is written again"
    assert columns.between("a", 5049, 5048).shape == (0, 2)
