"""Verdicts: differences between the recorded and the new scores of a run."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from workbench.episodes.equal_numbers import gap
from workbench.rescore.verdict import (
    DOUBTFUL_METRES,
    DOUBTFUL_RADIANS,
    Scores,
    Verdict,
    by_change,
    compare,
    scalar_entries,
)

REWARD = [0.0, 1.0, 2.0, 3.0]


def scores(reward: Any = REWARD, **evaluate: Any) -> Scores:
    return Scores(np.array(reward, float), {name: np.array(rows) for name, rows in evaluate.items()})


def test_equal_scores_have_no_difference() -> None:
    found = compare(
        "it", scores(success=[False] * 5, height=[0.1] * 5), scores(success=[0.0] * 5, height=[0.1] * 5)
    )
    assert found.of == "it" and found.length == 4 and not found.differs and found.differing == ()
    assert found.returns == (6, 6) and found.largest == 0 and found.has_success
    assert found.success == found.fail == (None, None) and found.look_at is None
    assert (found.metres, found.radians, found.drift_at) == (None, 0, None) and not found.drifted
    assert (found.task, found.seed, found.start_differs, found.missed) == ("", -1, False, {})


@pytest.mark.parametrize(("share", "differs"), [(0.9e-5, False), (1.1e-5, True)])
def test_a_reward_differs_from_a_fraction_of_the_largest_reward_on(share: float, differs: bool) -> None:
    now = [0.0, 1.0, 2.0 + 3.0 * share, 3.0]
    found = compare(0, scores(), scores(now))
    assert found.differs == differs and found.largest == pytest.approx(3 * share)
    assert found.first_difference == (3 if differs else None) and found.differing == ("reward",) * differs


def test_the_first_and_largest_reward_difference_are_steps_of_the_episode() -> None:
    found = compare(0, scores(), scores([0.0, 1.5, 4.0, 3.5]), begin=10)
    assert (found.first_difference, found.look_at, found.largest) == (12, 13, 2)


def test_success_and_fail_are_located_by_their_first_true_step() -> None:
    old = scores(success=[0, 0, 1, 1, 0], fail=[0] * 5)
    found = compare(0, old, scores(success=[0, 0, 0, 1, 0], fail=[0, 1, 0, 0, 0]), begin=5)
    assert found.success == (7, 8) and found.fail == (None, 6)
    assert (found.first_difference, found.look_at) == (6, 8) and found.differing == ("success", "fail")
    missing = compare(0, scores([1, 1, 1, 1], fail=[0, 0, 1, 1, 1]), scores([1, 1, 1, 9]))
    assert missing.fail == (2, None) and missing.look_at == 2 and missing.first_difference == 2
    assert not missing.has_success


def test_a_flag_that_changes_after_its_first_true_step_is_reported() -> None:
    found = compare(0, scores(success=[0, 1, 1, 1, 1]), scores(success=[0, 1, 1, 0, 1]))
    assert found.success == (1, 1) and found.differing == ("success",)
    assert (found.first_difference, found.look_at) == (3, 3)
    assert not compare(0, scores(success=[0.5] * 5), scores(success=[0.0] * 5)).differs, (
        "0.5 does not count as true"
    )
    both = compare(0, scores(success=[1, 1, 1, 1, 1]), scores([9, 1, 2, 3], success=[1, 0, 1, 1, 1]))
    assert both.differing == ("reward", "success") and both.first_difference == both.look_at == 1


def test_other_shared_entries_are_named_but_count_as_no_difference() -> None:
    old = scores(height=[0.1] * 5, speed=[1.0] * 5, gone=[1] * 5)
    found = compare(0, old, scores(height=[0.1, 0.1, 0.2, 0.1, 0.1], speed=[1.0] * 5, new=[2] * 5))
    assert not found.differs and found.differing == found.others == ("height",)


def test_nan_against_a_number_is_a_difference_except_where_a_file_has_no_value() -> None:
    nan = np.nan
    old = scores(a=[nan, 1, 1, 1, 1], b=[1, 1, 1, nan, 1], c=[1, 1, 1, 1, 1], success=[nan, 0, 0, 0, 0])
    found = compare(
        0, old, scores(a=[5, 1, 1, 1, 1], b=[1, 1, 1, 1, 1], c=[nan, 1, 1, 1, 1], success=[0] * 5)
    )
    assert found.differing == ("b", "c")
    assert compare(0, old, scores(a=[5, 2, 1, 1, 1])).differing == ("a",)
    inf = compare(0, scores([np.inf, 1, 1, 1]), scores([np.inf, 1, 1, 1]))
    assert not inf.differs and inf.largest == 0
    assert gap(np.array([nan, np.inf, 1, 1]), np.array([nan, np.inf, 1, nan])).tolist() == [0, 0, 0, np.inf]
    lost = compare(0, scores(), scores([0.0, nan, 2.0, 3.0]))
    assert lost.look_at == lost.first_difference == 2


def test_drift_is_that_of_the_furthest_state() -> None:
    drift = np.array([[0, 0], [2e-3, 1e-4], [1e-3, 0.02], [0, 0], [0, 0]])
    found = compare(0, scores(), scores(), drift, begin=7)
    assert (found.metres, found.radians, found.drift_at) == (2e-3, 0.02, 8) and found.drifted
    still = compare(0, scores(), scores(), np.zeros((5, 2)))
    assert (still.metres, still.drift_at) == (0, None) and not still.drifted
    for metres, radians, drifted in (
        (DOUBTFUL_METRES, DOUBTFUL_RADIANS, False),
        (2 * DOUBTFUL_METRES, 0.0, True),
        (0.0, 2 * DOUBTFUL_RADIANS, True),
        (0.0, 0.02, True),
        (0.002, 0.0, True),
        (float("nan"), 0.0, True),
        (None, 1.0, False),
    ):
        assert Verdict(0, metres=metres, radians=radians).drifted == drifted


def test_the_largest_changes_come_first_and_unjudged_runs_last() -> None:
    moved = {"first_difference": 1, "returns": (1.0, 1.0)}
    given = [
        Verdict("same"),
        Verdict("skipped", why_not="x"),
        Verdict("less", first_difference=1, returns=(1.0, 1.1)),
        Verdict("lost", first_difference=1, returns=(1.0, float("nan"))),
        Verdict("fails", fail=(None, 2), **moved),  # pyright: ignore[reportArgumentType]
        Verdict("succeeds", success=(None, 2), **moved),  # pyright: ignore[reportArgumentType]
        Verdict("both", success=(None, 2), fail=(1, None), **moved),  # pyright: ignore[reportArgumentType]
        Verdict("more", first_difference=1, returns=(1.0, -9.0)),
    ]
    order = ["both", "succeeds", "fails", "lost", "more", "less", "same", "skipped"]
    assert [verdict.of for verdict in by_change(given)] == order
    never = replace(given[3], returns=(float("nan"), float("nan")))
    assert [verdict.of for verdict in by_change([never, given[2]])] == ["less", "lost"]


def test_only_entries_with_one_number_per_env_are_compared() -> None:
    evaluate: dict[str, Any] = {
        "flag": np.array([True, False]),
        "column": np.array([[1], [2]]),
        "place": np.zeros((2, 3)),
        "odd": np.array(["a", "b"]),
        "reward": np.array([1.0, 2.0]),
    }
    found = scalar_entries(evaluate)
    assert list(found) == ["flag", "column", "evaluate/reward"] and found["column"].tolist() == [1, 2]
