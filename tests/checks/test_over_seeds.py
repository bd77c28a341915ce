"""Merging the results of several parts of the seeds into verdicts that one part alone could not give."""

from __future__ import annotations

from typing import Literal

import pytest

from workbench.checks.evidence.collect import Found, Note, NotKnown
from workbench.checks.results import RuleResult, Seen
from workbench.checks.run_rules import RULES_OVER_SEEDS, over_seeds, result_of
from workbench.task.problem import Problem

PLACE = "task.py", 12, "evaluate"


def judged(rule: str, *rows: Seen) -> list[Found | Note]:
    return [*RULES_OVER_SEEDS[rule].judge(rows)]


def result(rule: str, *rows: Seen) -> RuleResult:
    """The result of one part of the seeds."""
    try:
        found = judged(rule, *rows)
    except NotKnown as reason:
        return RuleResult(rule, "not_known", why=str(reason), seen=rows)
    from_rows = result_of(rule, "warn", found, rows)
    return RuleResult(
        rule, from_rows.state, from_rows.findings, from_rows.silenced, from_rows.notes, seen=rows
    )


def succeeds_at_reset(tried: int, *seeds: int) -> Seen:
    return Seen(place=PLACE, tried=tried, seeds=seeds, code="return {}")


def test_breaches_are_counted_over_all_seeds() -> None:
    parts = [
        result("success-at-reset", succeeds_at_reset(32, 3)),
        result("success-at-reset", succeeds_at_reset(32)),
        result("success-at-reset", succeeds_at_reset(6, 65, 66)),
    ]
    assert [part.state for part in parts] == ["broken", "kept", "broken"]
    (finding,) = over_seeds(parts, "stop").findings
    assert finding.count == 3 and finding.degree == "stop" and finding.code == "return {}"
    assert "of 3 of 70 seeds (seed 3, 65, 66)" in finding.message


def test_the_worst_value_of_all_parts_is_reported() -> None:
    loose = Seen(("loose", "cube"))

    def falls(metres: float, *seeds: int) -> tuple[Seen, ...]:
        text = (f"falls {metres:.2f} m and turns 0 degrees",)
        return (
            Seen(tried=32),
            loose,
            Seen(("body", "cube", "cube"), PLACE, seeds=seeds, size=metres, texts=text),
        )

    parts = [result("falls-at-reset", *falls(0.1, 4)), result("falls-at-reset", *falls(0.3, 40, 41))]
    (finding,) = over_seeds(parts, "warn").findings
    assert (
        finding.message.startswith("cube falls 0.30 m")
        and "3 of 64 seeds (seed 4, 40, 41)" in finding.message
    )
    # A body that is held at one seed may slip at all seeds.
    held = result("falls-at-reset", Seen(("wanted", "cube")), loose, Seen(tried=32))
    assert over_seeds([*parts, held], "warn").state == "not_known"


def test_a_value_that_changes_between_parts_is_not_constant() -> None:
    def rewards(most: float, least: float) -> RuleResult:
        return result("reward-changes", Seen(place=PLACE, tried=50, numbers=(most, least), texts=("0",)))

    assert rewards(0, 0).state == rewards(1, 1).state == "broken"
    assert over_seeds([rewards(0, 0), rewards(1, 1)], "warn").state == "kept"
    (finding,) = over_seeds([rewards(0, 0), rewards(0, 0)], "warn").findings
    assert "at each of 100 steps" in finding.message

    def leaf(*numbers: float) -> RuleResult:
        rows = Seen(tried=32), Seen(("extra/goal",), PLACE, tried=1632, numbers=numbers)
        return result("observation-constant", *rows)

    assert over_seeds([leaf(0.5), leaf(0.25)], "warn").state == "kept"
    assert over_seeds([leaf(0.5), leaf()], "warn").state == "kept"
    (finding,) = over_seeds([leaf(0.5), leaf(0.5)], "warn").findings
    assert "is 0.5 in all of 3264 states, over 64 seeds" in finding.message

    def shelf(height: float) -> RuleResult:
        pose = (0.0, 0.0, height, 1.0, 0.0, 0.0, 0.0)
        return result("kinematic-never-moved", Seen(tried=32), Seen(("shelf",), PLACE, numbers=pose + pose))

    assert over_seeds([shelf(0.1), shelf(0.2)], "warn").state == "kept"
    assert over_seeds([shelf(0.1), shelf(0.1)], "warn").state == "broken"
    # A part of a single seed is not conclusive alone, and is counted with the others.
    last = result("kinematic-never-moved", Seen(tried=1), Seen(("shelf",), PLACE, numbers=(0.0,) * 14))
    assert last.state == "not_known" and over_seeds([shelf(0.1), last], "warn").state == "kept"


def test_a_body_out_of_reach_at_some_seeds_is_reported_and_at_all_seeds_is_not_known() -> None:
    def cube(tried: int, *beyond: int) -> RuleResult:
        return result("outside-reach", Seen(("cube",), PLACE, tried, beyond, size=0.9, numbers=(0.8,)))

    assert cube(2, 0, 1).state == "not_known"
    assert over_seeds([cube(2, 0, 1), cube(2, 2, 3)], "warn").state == "not_known"
    assert over_seeds([cube(2), cube(2)], "warn").state == "kept"
    (finding,) = over_seeds([cube(2, 0, 1), cube(2)], "warn").findings
    assert "in 2 of 4 seeds" in finding.message


def test_successes_are_counted_over_all_parts() -> None:
    parts = [
        result("success-stays-possible", Seen(("random",), tried=32, count=count), Seen(("given",), tried=3))
        for count in (0, 5)
    ]
    notes = over_seeds(parts, "warn").notes
    assert notes == ("success in 5 of 64 random episodes", "success in 0 of 6 given episodes")

    def flickers(times: int, gone: int) -> Seen:
        return Seen(("random",), PLACE, tried=times, count=gone, numbers=(0.0, float(times > 0)))

    never, often = result("success-flickers", flickers(0, 0)), result("success-flickers", flickers(4, 2))
    assert (never.state, often.state) == ("not_known", "broken")
    assert over_seeds([never, often], "warn").state == "broken"
    holds = result("success-flickers", flickers(20, 0))
    assert over_seeds([often, holds], "warn").state == "kept", "2 of 24 times is below the limit"
    assert over_seeds([never, never], "warn").state == "not_known"
    assert result("success-flickers", flickers(4, 1)).state == "kept", "a single flicker may be chance"


@pytest.mark.parametrize("state", ["not_known", "failed"])
def test_a_part_that_raises_leaves_the_rule_undecided_unless_another_breaks_it(
    state: Literal["not_known", "failed"],
) -> None:
    problem = Problem("step", "it raised", "task.py", 3, "x()", "")
    raised = RuleResult("success-at-reset", state, why="it raised", problem=problem)
    kept = result("success-at-reset", succeeds_at_reset(32))
    broken = result("success-at-reset", succeeds_at_reset(32, 40))
    whole = over_seeds([kept, raised], "stop")
    assert (whole.state, whole.why, whole.problem) == (state, "it raised", problem)
    assert over_seeds([raised, broken], "stop").state == "broken"
    assert over_seeds([raised, raised], "stop").state == state


@pytest.mark.parametrize("rule", RULES_OVER_SEEDS)
def test_no_observations_break_no_rule(rule: str) -> None:
    assert [*RULES_OVER_SEEDS[rule].so_far(())] == []
