"""From what a check gives or raises to the result of its rule."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, cast

import pytest

from workbench.checks.evidence.collect import (
    Check,
    CheckEnded,
    Checkup,
    Found,
    NotApplicable,
    Note,
    NotKnown,
    finding_of,
)
from workbench.checks.evidence.over_seeds import OverSeeds
from workbench.checks.results import RuleResult, Seen, Silenced, by_rule, failed
from workbench.checks.rule_table import RULES, degree_of_each
from workbench.checks.run_rules import check_rule, gpu_results
from workbench.envs.gpu_rules import Finding
from workbench.task.problem import Problem, TaskError

pytestmark = pytest.mark.thorough

RULE = "reward-changes"
POLICY = Problem("policy", "no such joint", "policy.py", 3, "act()", "")


def evaluate_line(example: Checkup) -> tuple[str, int, str]:
    place = example.places.entry("success")
    assert place is not None
    return place


def run(example: Checkup, check: Check, **degrees: str) -> list[RuleResult]:
    return check_rule(RULE, check, example, cast(Any, {**degree_of_each(), **degrees}))


def breach_then(raises: Callable[[Checkup], Any] = lambda checkup: None, *, found: bool = True) -> Check:
    def check(checkup: Checkup) -> Iterator[Found | Note]:
        yield Note("seen 3 of 4")
        if found:
            yield Found("it never changes", evaluate_line(checkup), 7)
        raises(checkup)

    return check


def throw(error: Exception) -> Callable[[Checkup], None]:
    def raises(checkup: Checkup) -> None:
        raise error

    return raises


def in_the_task(checkup: Checkup) -> None:
    """Raise in a line of the task's file."""
    file = next(iter(checkup.files))
    exec(compile("\n" * 149 + "{}['gone']", file, "exec"), {})


@pytest.mark.parametrize(
    ("error", "state"),
    [(NotApplicable("no reward"), "not_applicable"), (NotKnown("no success"), "not_known")],
)
def test_a_breach_counts_even_if_the_check_could_not_go_on(
    example: Checkup, error: Exception, state: str
) -> None:
    (result,) = run(example, breach_then(throw(error), found=False))
    assert (result.state, result.why, result.notes) == (state, str(error), ("seen 3 of 4",))
    (result,) = run(example, breach_then(throw(error)))
    (finding,) = result.findings
    assert (result.rule, result.state, result.why, result.notes) == (RULE, "broken", "", ("seen 3 of 4",))
    assert (finding.rule, finding.degree, finding.count, finding.first_step) == (RULE, "warn", 7, 0)
    assert (finding.file, finding.line, finding.function) == evaluate_line(example)
    assert finding.code.startswith('"success"')
    (stopping,) = run(example, breach_then(), **{RULE: "stop"})
    assert stopping.findings[0].degree == "stop"
    (kept,) = run(example, breach_then(found=False))
    assert (kept.state, kept.why, kept.problem) == ("kept", "", None)


def test_an_error_of_the_task_leaves_a_rule_undecided_and_breaks_the_rule_runs(example: Checkup) -> None:
    result, runs = run(example, breach_then(in_the_task, found=False))
    assert (result.state, runs.rule, runs.state) == ("not_known", "runs", "broken")
    assert result.problem is not None and "gone" in result.why
    (finding,) = runs.findings
    assert (finding.degree, finding.file, finding.line) == ("stop", result.problem.file, 150)
    result, _ = run(example, breach_then(in_the_task))
    assert result.state == "broken" and result.problem is not None and "gone" in result.why
    assert len(run(example, breach_then(in_the_task), runs="off")) == 1
    policy = throw(TaskError(POLICY))
    (result,) = run(example, breach_then(policy, found=False))
    assert (result.state, result.problem) == ("not_known", POLICY), "a policy is no fault of the task"


def test_a_check_that_raises_itself_fails_with_its_traceback(example: Checkup) -> None:
    def broken(checkup: Checkup) -> Iterator[Found | Note]:
        yield Found("it never changes", ("task.py", "seven", "evaluate"))  # type: ignore[arg-type]

    for check in (breach_then(throw(ZeroDivisionError("by nothing"))), broken):
        (result,) = run(example, check)
        assert (result.state, result.findings) == ("failed", ()) and result.is_crash
        assert result.problem is not None and result.problem.file is not None
        assert result.problem.file.startswith("workbench/") and result.problem.file in result.why
    died = failed(RULE, Problem("worker", "the worker was killed", None, None, None, ""))
    assert (died.state, died.why) == ("failed", "the worker was killed") and not died.is_crash
    with pytest.raises(CheckEnded):
        run(example, breach_then(throw(CheckEnded())))


def test_rows_that_came_before_an_error_of_the_task_are_judged(example: Checkup) -> None:
    line = evaluate_line(example)

    def see(checkup: Checkup) -> Iterator[Seen]:
        yield Seen(("random",), line, tried=4, seeds=(3,))
        in_the_task(checkup)

    def judge(rows: Any) -> Iterator[Found | Note]:
        for row in rows:
            yield Found(f"{row.names[0]} {row.tried}", row.place, len(row.seeds))
        if len(rows) < 2:
            raise NotKnown("too few")

    result, runs = run(example, OverSeeds(see, judge))
    assert (result.state, runs.state) == ("broken", "broken") and result.findings[0].message == "random 4"
    (row,) = result.seen
    assert row.seeds == (3,) and row.code == result.findings[0].code != "", (
        "another process may have other files"
    )
    assert result.problem is not None and result.problem.line == 150


def test_findings_of_gpu_rules_take_the_degree_of_the_request_and_are_told_once() -> None:
    def finding(line: int, code: str = "x = 1", rule: str = "rows-lost") -> Finding:
        return Finding(rule, "warn", f"line {line}", "task.py", line, code, "evaluate", 1, line)

    degrees = {
        **dict.fromkeys(RULES, "off"),
        "rows-lost": "stop",
        "reward-rows": "warn",
        "not-applied": "warn",
    }
    silenced = [Silenced(finding(9, "y = 2", "not-applied"), "on purpose", 8)] * 2
    found = [finding(3), finding(5, "z = 3"), finding(3), finding(4, rule="evaluate-rows")]
    results = by_rule(gpu_results(found, silenced, degrees))  # type: ignore[arg-type]
    assert {rule: result.state for rule, result in results.items()} == {
        "rows-lost": "broken",
        "not-applied": "silenced",
    }
    assert [(one.line, one.degree) for one in results["rows-lost"].findings] == [(3, "stop"), (5, "stop")]
    (one,) = results["not-applied"].silenced
    assert (one.reason, one.line, one.finding.degree) == ("on purpose", 8, "warn")
    both = by_rule(gpu_results([finding(9, "a", "not-applied")], silenced, degrees))["not-applied"]  # type: ignore[arg-type]
    assert both.state == "broken" and len(both.silenced) == 1


def test_a_finding_without_a_line_has_no_place() -> None:
    found = finding_of(RULE, "warn", Found("nothing changes", None))
    assert (found.file, found.line, found.code, found.function, found.count) == (None, None, "", "", 1)
    assert replace(found, count=2).key == found.key
