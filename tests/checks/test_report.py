"""From the results of items to the report of a check: order, parts of the seeds, what is missing, and whether it fails."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest

from workbench.checks.job import CheckReport, check, report_of
from workbench.checks.job_items import (
    CheckedTask,
    CheckOptions,
    ItemOutcome,
    count_chunks,
    count_items,
    degrees_of_request,
    plan_of,
)
from workbench.checks.results import RuleResult, Seen, Silenced, State
from workbench.checks.rule_table import RULES, SOLVE_RULES
from workbench.checks.run_rules import RULES_OVER_SEEDS
from workbench.envs.gpu_rules import Degree, Finding
from workbench.jobs.scheduler import Scheduler, Work
from workbench.task.description import TaskOptions
from workbench.task.problem import Problem, TaskError

TEXT = (
    "class Task:\n"
    "    def evaluate(self):  # workbench: off[reward-changes] it is sparse\n"
    "        pass  # workbench: off[reward-finite]\n"
)
TASK = CheckedTask("Task-v1", "Task", "task.py", source={"task.py": TEXT})


def finding(
    rule: str, degree: Degree = "warn", line: int = 5, step: int = 0, message: str = "bad"
) -> Finding:
    return Finding(rule, degree, message, "task.py", line, f"line {line}", "evaluate", 1, step)


def options(seeds: int = 4, num_envs: int = 4, **changes: Any) -> CheckOptions:
    return CheckOptions("task.py", TaskOptions(num_envs=num_envs), seeds=seeds, **changes)


def kept(what: CheckOptions, given: Mapping[str, list[RuleResult]] = {}) -> dict[int, ItemOutcome]:
    """Results of all items by number: kept, except the given ones, one for each part of the seeds."""
    found: dict[int, ItemOutcome] = {}
    for number, item in plan_of(what, degrees_of_request(what)).items.items():
        results = [
            given[rule][item.part] if rule in given else RuleResult(rule, "kept", seen=rows(rule))
            for rule in item.rules
        ]
        found[number] = ItemOutcome(tuple(results), picture_seconds=0.5 * item.part, task=TASK)
    return found


def rows(rule: str) -> tuple[Seen, ...]:
    return (Seen(tried=4),) if rule == "success-at-reset" else ()


# --- items -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("seeds", "num_envs"), [(1, 4), (32, 8), (33, 8), (100, 16), (100, 48)])
def test_each_rule_and_each_seed_is_checked_once(seeds: int, num_envs: int) -> None:
    what = options(seeds, num_envs)
    plan = plan_of(what, degrees_of_request(what))
    parts = [[*plan.episodes(part, seeds)] for part in range(plan.parts)]
    assert [seed for part in parts for seed in part] == [*range(seeds)] and all(parts)
    assert all(len(part) <= max(32, num_envs) for part in parts)
    checked = [(item.part, rule) for item in plan.items.values() for rule in item.rules]
    on = RULES.keys() - SOLVE_RULES
    assert sorted(checked) == sorted(
        (part, rule) for part in range(plan.parts) for rule in on if part == 0 or rule in RULES_OVER_SEEDS
    )
    # What one process checks shares its evidence: the rules of a group, or a part of the seeds.
    together: dict[int, set[object]] = {}
    for number, item in plan.items.items():
        together.setdefault(number // plan.chunk, set()).add(item.part if plan.parts > 1 else item.group.name)
    assert all(len(each) == 1 for each in together.values())
    assert count_chunks(what) == plan.chunks == len(together)
    half = plan.chunks // 2
    counted = [count_items(what, chunks) for chunks in (range(half), range(half, plan.chunks))]
    assert sum(counted) == len(plan.items) and counted[1] > 0


def test_rules_that_are_off_have_no_item() -> None:
    what = options(select=("success-at-reset", "rows-lost", "runs"), ignore=("runs",))
    items = [*plan_of(what, degrees_of_request(what)).items.values()]
    assert [item.rules for item in items] == [("success-at-reset",), ("rows-lost",)]
    with pytest.raises(ValueError):
        degrees_of_request(options(select=("runs",), ignore=("runs",)))
    for wrong in (options(0), options(workers=0)):
        with pytest.raises(ValueError):
            degrees_of_request(wrong)
    with pytest.raises(ValueError, match="reward-rows"):
        degrees_of_request(options(select=("reward_row",)))


# --- reports ---------------------------------------------------------------------------------------------


def test_a_report_has_each_rule_once_in_the_order_of_the_table_and_the_worst_findings_first() -> None:
    given = {
        "reward-finite": [RuleResult("reward-finite", "broken", (finding("reward-finite", "warn"),))],
        "body-names": [RuleResult("body-names", "broken", (finding("body-names", "stop"),), seconds=2.0)],
        "camera-sees": [RuleResult("camera-sees", "broken", (finding("camera-sees", "warn"),))],
    }
    what = options(ignore=("reward-rows", "camera-size"))
    known = kept(what, given)
    report = report_of(what, known)
    assert [result.rule for result in report.results] == [
        rule for rule in RULES if rule not in SOLVE_RULES | {"reward-rows", "camera-size"}
    ]
    assert [one.rule for one in report.findings] == ["body-names", "reward-finite", "camera-sees"]
    assert report.task == TASK and report.missing == 0 and report.ignored == ("reward-rows", "camera-size")
    assert report_of(options(select=("runs",), ignore=("reward-rows",)), {}).ignored == ()
    # A comment is known to silence nothing once all rules are checked; one without a reason at once.
    assert [one.line for one in report.comments] == [2, 3]
    first, *others = known
    part = report_of(what, {number: known[number] for number in others})
    assert part.missing == 1 and [one.line for one in part.comments] == [3]


def test_results_of_all_parts_of_the_seeds_become_one() -> None:
    def succeeds(*seeds: int) -> RuleResult:
        seen = Seen(place=("task.py", 3, "evaluate"), tried=20, seeds=seeds, code="pass")
        return RuleResult("success-at-reset", "broken" if seeds else "kept", seen=(seen,), seconds=1.0)

    early, late = finding("rows-lost", step=2, message="b"), finding("rows-lost", step=7, message="a")
    other = finding("rows-lost", line=3, step=9)
    what = options(seeds=60, num_envs=8, select=("success-at-reset", "rows-lost", "runs"))
    known = kept(what, {"success-at-reset": [succeeds(), succeeds(41, 59)]})
    plan = plan_of(what, degrees_of_request(what))
    assert plan.parts == 2
    numbers = [number for number, item in plan.items.items() if item.part == 0]
    for number, of in zip(numbers, ((late, other), (early,), ()), strict=False):
        known[number] = replace(known[number], findings=of)
    report = report_of(what, known)
    (success,) = [result for result in report.results if result.rule == "success-at-reset"]
    assert success.findings[0].count == 2 and "2 of 40 seeds (seed 41, 59)" in success.findings[0].message
    assert success.seconds == 2 and success.seen == () and report.picture_seconds == 0.5
    (lost,) = [result for result in report.results if result.rule == "rows-lost"]
    assert lost.state == "broken" and [(one.line, one.message) for one in lost.findings] == [
        (3, "bad"),
        (5, "b"),
    ]
    assert {one.degree for one in lost.findings} == {"stop"}, "the degree of the request"


@pytest.mark.parametrize(
    ("results", "stop", "warn"),
    [
        ([RuleResult("body-names", "kept")], False, False),
        ([RuleResult("body-names", "not_known", why="no success")], False, False),
        ([RuleResult("body-names", "broken", (finding("body-names"),))], False, True),
        ([RuleResult("body-names", "broken", (finding("body-names", "stop"),))], True, True),
        ([RuleResult("body-names", "failed")], True, True),
    ],
)
def test_a_check_fails_from_the_wanted_degree_on(results: list[RuleResult], stop: bool, warn: bool) -> None:
    report = CheckReport(TASK, tuple(results), 1.0, 1.0)
    assert (report.fails("stop"), report.fails("warn"), report.fails("never")) == (stop, warn, False)


@pytest.mark.parametrize(("state", "fails"), [("silenced", False), ("not_known", True)])
def test_a_task_that_raises_fails_a_check_unless_that_is_silenced(state: State, fails: bool) -> None:
    problem = Problem("step", "it raised", "task.py", 3, "x()", "")
    silenced = (Silenced(finding("runs"), "as meant", 2),) if state == "silenced" else ()
    undecided = RuleResult("reward-finite", "not_known", why="it raised", problem=problem)
    report = CheckReport(TASK, (RuleResult("runs", state, silenced=silenced), undecided), 1.0, 1.0)
    assert report.fails("stop") == fails and not report.fails("never")


# --- processes that die ----------------------------------------------------------------------------------


class Dies:
    """Answers each item, but dies whenever it has the item of this rule."""

    is_remote = False

    def __init__(self, what: CheckOptions, rule: str, problem: Problem | None = None) -> None:
        self.items = plan_of(what, degrees_of_request(what)).items
        self.outcomes, self.rule, self.problem = kept(what), rule, problem

    def run(self, work: Work, scheduler: Scheduler[Any, Any]) -> None:
        while (chunk := scheduler.next("worker")) is not None:
            for number in sorted(chunk.wanted):
                if self.rule not in self.items[number].rules:
                    scheduler.result("worker", number, self.outcomes[number])
                elif self.problem is None:
                    scheduler.died("worker", "was killed by SIGKILL", -9)
                    break
                else:
                    scheduler.failed("worker", TaskError(self.problem))
                    break


def test_a_rule_whose_process_always_dies_fails_and_all_others_have_their_results() -> None:
    what = options(select=("success-at-reset", "entry-name", "body-names", "rows-lost"))
    seen: list[str] = []
    report = check(what, on_result=lambda result: seen.append(result.rule), executor=Dies(what, "entry-name"))
    states = {result.rule: result.state for result in report.results}
    assert states == dict.fromkeys(what.select, "kept") | {"entry-name": "failed"} and report.missing == 0
    assert sorted(seen) == sorted(what.select)
    (failed,) = report.of_state("failed")
    assert "SIGKILL" in failed.why and not failed.is_crash and report.fails("stop")


def test_a_policy_that_cannot_be_imported_ends_the_check() -> None:
    what = options(seeds=40, num_envs=8, select=("success-at-reset", "outside-reach"))
    problem = Problem("import", "there is no policy.py", "policy.py", None, None, "")
    with pytest.raises(TaskError) as raised:
        check(what, executor=Dies(what, "outside-reach", problem))
    assert raised.value.problem == problem


def test_envs_are_made_as_for_the_given_actions_unless_the_request_says_otherwise(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    given = {"control_mode": "pd_joint_pos", "size": 2}
    monkeypatch.setattr("workbench.checks.job.find_actions", lambda actions, task: ([], given))
    asked: list[CheckOptions] = []

    class Notes(Dies):
        def run(self, work: Work, scheduler: Scheduler[Any, Any]) -> None:
            asked.append(work.setup)
            super().run(work, scheduler)

    what = options(select=("body-names",), workers=3)
    what = replace(what, options=replace(what.options, env_kwargs={"size": 3}))
    check(what, executor=Notes(what, ""))
    assert asked == [replace(what, options=replace(what.options, env_kwargs={**given, "size": 3}))]


def test_progress_is_counted_in_items_with_several_parts_only() -> None:
    for seeds, expected in ((4, []), (40, [1, 2, 3, 4])):
        what = options(seeds, num_envs=8, select=("success-at-reset", "outside-reach"))
        counts: list[int] = []
        told: list[RuleResult] = []
        check(what, on_progress=counts.append, on_result=told.append, executor=Dies(what, ""))
        assert counts == expected
        assert len(told) == (2 if seeds == 4 else 0), "another part may change what the first one says"
