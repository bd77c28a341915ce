"""Verdicts in words and as tables, for the page, the terminal and files."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.rescore.verdicts import verdict
from workbench.rescore import verdict_text

NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, ["unchanged"]),
        ({"differing": ("height",)}, ["unchanged", "height"]),
        ({"why_not": "it is broken"}, ["it is broken"]),
        ({"success": (None, 3), "first_difference": 3}, ["success", "3", "never"]),
        ({"success": (3, None), "first_difference": 3}, ["success", "never", "3"]),
        (
            {"fail": (4, 2), "success": (None, 3), "first_difference": 2},
            ["success", "3", "never", "fail", "2", "4"],
        ),
        ({"differing": ("reward",), "first_difference": 2, "largest": 0.5}, ["reward", "0.5", "2"]),
        (
            {"differing": ("reward",), "first_difference": 2, "largest": INF, "returns": (1.5, NAN)},
            ["NaN", "2"],
        ),
        (
            {"differing": ("reward",), "first_difference": 2, "largest": NAN, "returns": (NAN, 1.5)},
            ["NaN", "2"],
        ),
        (
            {"differing": ("reward",), "first_difference": 2, "largest": NAN, "returns": (NAN, NAN)},
            ["NaN", "2"],
        ),
        ({"differing": ("success", "fail"), "first_difference": 2}, ["success", "fail", "2"]),
        (
            {"differing": ("reward", "success"), "first_difference": 2, "largest": 9.0},
            ["reward", "9", "2"],
        ),
    ],
)
def test_a_change_is_told_with_its_steps(changes: dict[str, Any], words: list[str]) -> None:
    text, at = verdict_text.change_text(verdict(**changes)), 0
    for word in words:
        at = text.index(word, at) + len(word)
    assert verdict_text.change_text(verdict()) in text or "unchanged" not in words


def test_a_reward_that_is_nan_before_now_or_both_is_told_apart_and_counted() -> None:
    lost = {"differing": ("reward",), "first_difference": 2, "largest": INF}
    found = [
        verdict(has=("reward",), returns=returns, **lost) for returns in ((1.0, NAN), (NAN, 1.0), (NAN, NAN))
    ]
    assert len({verdict_text.change_text(one) for one in found}) == 3
    (text,) = verdict_text.totals([found[0], verdict(has=("reward",), returns=(1.0, 2.0))])
    assert "1 → 2" in text and "NaN in 1 of 2" in text


def test_every_fact_of_a_verdict_has_its_column() -> None:
    """In the table that the command writes."""
    one = verdict(
        "a",
        success=(1, 2),
        fail=(3, 4),
        returns=(5.0, 6.0),
        has=("reward", "success"),
        first_difference=7,
        largest=8.0,
        differing=("reward", "height", "phase"),
        metres=9.0,
        drift_at=10,
        start_differs=True,
        missed={"cube": "gone", "goal": "new"},
        damaged=True,
    )
    (row,) = verdict_text.as_rows([one])
    assert row == {
        "episode": "push_a",
        "file": "a.json",
        "trajectory": None,
        "task": "Push-v1",
        "seed": 3,
        "length": 5,
        "success_before": 1,
        "success_now": 2,
        "fail_before": 3,
        "fail_now": 4,
        "return_before": 5.0,
        "return_now": 6.0,
        "differs": True,
        "first_difference": 7,
        "largest_reward_change": 8.0,
        "other_entries": "height, phase",
        "drift_metres": 9.0,
        "drift_at": 10,
        "first_state_put_in": True,
        "not_carried": "cube: gone; goal: new",
        "not_judged": "",
        "damaged": True,
    }
    (other,) = verdict_text.as_rows([verdict(seed=-1, has=(), why_not="no")])
    assert (other["seed"], other["return_before"], other["return_now"], other["not_judged"]) == (
        None,
        None,
        None,
        "no",
    )
    assert verdict_text.as_csv([one]).splitlines()[0].split(",") == list(row)


def test_returns_successes_drift_and_what_was_not_restored_are_of_all_episodes() -> None:
    many = [
        verdict(
            "a",
            success=(2, None),
            has=("reward", "success"),
            metres=0.001,
            radians=0.5,
            missed={"cube": "gone"},
        ),
        verdict(
            "b",
            success=(2, 3),
            has=("reward", "success"),
            returns=(2.0, 4.0),
            metres=0.5,
            missed={"cube": "gone"},
        ),
        verdict("c", has=(), metres=None, missed={"goal": "new"}),
        verdict("d", why_not="x", success=(1, 1), has=("success",)),
    ]
    successes, returns, skipped = verdict_text.totals(many)
    assert "2 → 1" in successes and "6 → 7" in returns and "1" in skipped
    for text in (verdict_text.headline(many), *verdict_text.totals(many)):
        assert text[1:] in verdict_text.summary(many)
    assert not verdict_text.totals([verdict(has=())])
    assert len(verdict_text.totals([verdict(has=("success", "fail"))])) == 1, "it has no return"
    assert verdict_text.not_carried(many) == ("cube: gone", "goal: new")
    text = verdict_text.drift_summary(many)
    assert "50 cm" in text and "29°" in text and "push_b" in text and verdict_text.count_drifted(many) == 2
    assert verdict_text.returns_text(many[1]) == "2 → 4" and verdict_text.returns_text(many[2]) == ""
    nothing = verdict(returns=(NAN, 4.0), old_reward=np.full(5, NAN, np.float32))
    assert "4" in verdict_text.returns_text(nothing) and "NaN" not in verdict_text.returns_text(nothing)
    texts = [verdict_text.drift_text(verdict(metres=metres)) for metres in (None, 0.0, 0.25)]
    assert len(set(texts)) == 3 and "25 cm" in texts[2]
    assert "height" in verdict_text.headline(many[:1], others=["height"]) and not verdict_text.headline([])
    assert verdict_text.headline(many[:1]) != verdict_text.headline(many[:1], so_far=True)
    assert "1 of 2" in verdict_text.headline([verdict(), verdict(first_difference=3)], so_far=True)
    assert verdict_text.headline(many[3:]) not in ("", verdict_text.headline(many[:1]))


@pytest.mark.parametrize(
    ("metres", "radians", "says", "far"),
    [
        (0.0, 0.0, "exactly where it was recorded", False),
        (4e-4, 1e-4, "0.4 mm", False),
        (0.032, 0.0, "3.2 cm", True),
        (0.0, 0.2, "11°", True),
        (INF, 0.0, "infinite", True),
    ],
)
def test_drift_is_reported_and_large_drift_raises_doubt(
    metres: float, radians: float, says: str, far: bool
) -> None:
    found = [verdict("a"), verdict("b", metres=metres, radians=radians)]
    summary = verdict_text.drift_summary(found, verdict_text.PUT_IN)
    assert says in summary and verdict_text.count_drifted(found) == far
    assert metres == 0 or ("push_b" in summary) == far
    assert summary.endswith(verdict_text.PUT_IN) == far
    assert not verdict_text.drift_summary([verdict(metres=None)])


def test_nan_is_null_in_json() -> None:
    assert '"return_now": null' in verdict_text.as_json([verdict(returns=(1.0, float("nan")))])
    assert verdict_text.as_csv([]) == "\n"
