"""Checks a task against the rules of `workbench check`, in one process or several."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from workbench.actions.choose import find_actions, needed_by
from workbench.checks.job_items import (
    CheckedTask,
    CheckOptions,
    CheckUpdate,
    ItemOutcome,
    degrees_of_request,
    plan_of,
)
from workbench.checks.job_worker import check_items
from workbench.checks.results import RuleResult, State, by_rule, failed, merged
from workbench.checks.rule_table import RULES
from workbench.checks.run_rules import RULES_OVER_SEEDS, gpu_results, over_seeds
from workbench.checks.silencing import Comment, comments_without_effect
from workbench.envs.gpu_rules import DEGREES, FailOn, Finding, fails
from workbench.jobs.local_processes import Processes
from workbench.jobs.scheduler import Executor, Failure, Scheduler, ThisProcess, Work
from workbench.task.problem import TaskError

_TRIES = 3
"""Maximum number of starts of a chunk of rules. A chunk is started again if its worker died."""


@dataclass(frozen=True)
class CheckReport:
    """Result of a check."""

    task: CheckedTask
    results: tuple[RuleResult, ...]
    """Results in the order of the table of rules, without rules that are off."""
    seconds: float
    start_seconds: float
    """Part of `seconds` until the first process had imported the task."""
    picture_seconds: float = 0.0
    """Part of `seconds` that the first pictures took."""
    stopped: bool = False
    ignored: tuple[str, ...] = ()
    """Rules that would have been checked without `CheckOptions.ignore`."""
    comments: tuple[Comment, ...] = ()
    """Silencing comments without effect."""
    missing: int = 0
    """Number of items (`job_items.Item`) without a result."""

    @property
    def findings(self) -> tuple[Finding, ...]:
        """All findings, by degree with ``stop`` first, then in the order of the table of rules."""
        found = [finding for result in self.results for finding in result.findings]
        return tuple(sorted(found, key=lambda finding: DEGREES.index(finding.degree)))

    def of_state(self, state: State) -> tuple[RuleResult, ...]:
        return tuple(result for result in self.results if result.state == state)

    def fails(self, fail_on: FailOn) -> bool:
        """Whether the check counts as failed: a finding has the degree `fail_on` or a higher one, the check
        of a rule failed, or the author's code raised and no comment silences the rule `runs`. Always False
        if `fail_on` is ``never``."""
        if fail_on == "never":
            return False
        if self.of_state("failed") or any(fails(finding.degree, fail_on) for finding in self.findings):
            return True
        accepted = any(result.rule == "runs" for result in self.of_state("silenced"))
        return not accepted and any(result.problem is not None for result in self.results)


def check(
    what: CheckOptions,
    on_activity: Callable[[str], None] = lambda activity: None,
    on_result: Callable[[RuleResult], None] = lambda result: None,
    stop: Callable[[], bool] = lambda: False,
    executor: Executor | None = None,
    began: float | None = None,
    on_progress: Callable[[int], None] = lambda done: None,
) -> CheckReport:
    """Check a task.

    Args:
        on_activity: gets the name of the current work, for a status line.
        on_result: gets each result as it comes; one rule may have several. With several parts of the seeds,
            results of `RULES_OVER_SEEDS` are left out, since another part may change them.
        stop: called between steps. Once it returns True, the check ends; rules that are not done are missing
            in the report.
        executor: None to run in this process, or in spawned processes if there are several workers.
        began: when the work began, by ``time.monotonic()``; None for now.
        on_progress: gets the number of items that are done; called only with several parts of the seeds.

    Raises:
        TaskError: the task or the policy cannot be imported, or the task lacks assets.
        PoolError: a checking process failed, or processes die again and again.
        FileNotFoundError, ValueError: the request is invalid.
    """
    began = time.monotonic() if began is None else began
    degrees = degrees_of_request(what)
    _, env_kwargs = find_actions(what.actions, what.task)
    made = replace(what.options, env_kwargs={**env_kwargs, **what.options.env_kwargs})
    what = replace(what, options=made)
    plan = plan_of(what, degrees)
    if executor is None:
        cores = len(os.sched_getaffinity(0))
        workers = min(cores if what.workers is None else what.workers, plan.chunks)
        executor = ThisProcess() if workers == 1 else Processes(workers)
    found = _Results(what, on_activity, on_result, on_progress)
    scheduler: Scheduler[ItemOutcome, CheckUpdate] = Scheduler(
        plan.items, found.take, found.take_update, stop, chunk=plan.chunk, tries=_TRIES, on_failure=found.fail
    )
    needed = needed_by(what.task, what.actions, what.options.imports)
    work = Work(
        check_items,
        what,
        result=ItemOutcome,
        update=CheckUpdate,
        name="that checks",
        folders=needed.folders,
        files=needed.files,
    )
    executor.run(work, scheduler)
    scheduler.require_results()
    return found.report(began, stop())


def report_of(what: CheckOptions, known: Mapping[int, ItemOutcome]) -> CheckReport:
    """Report of a check from the results of these items. Runs nothing. Raises ValueError as
    `degrees_of_request` does."""
    found = _Results(what)
    for number in sorted(known):
        found.take(number, known[number])
    return found.report(None, stopped=False)


class _Results:
    """Collects the results of all processes."""

    def __init__(
        self,
        what: CheckOptions,
        on_activity: Callable[[str], None] = lambda activity: None,
        on_result: Callable[[RuleResult], None] = lambda result: None,
        on_progress: Callable[[int], None] = lambda done: None,
    ) -> None:
        self._what, self._degrees = what, degrees_of_request(what)
        self._plan = plan_of(what, self._degrees)
        self._on_activity, self._on_result, self._on_progress = on_activity, on_result, on_progress
        self._task: CheckedTask | None = None
        self._started = 0.0
        self._outcomes: dict[int, ItemOutcome] = {}

    def take_update(self, update: CheckUpdate) -> None:
        if update.task is not None:
            self._see_task(update.task)
        if update.activity:
            self._on_activity(update.activity)

    def take(self, number: int, outcome: ItemOutcome) -> None:
        if outcome.task is not None:
            self._see_task(outcome.task)
        self._outcomes[number] = outcome
        for result in outcome.results:
            if self._plan.parts == 1 or result.rule not in RULES_OVER_SEEDS:
                self._on_result(result)
        if self._plan.parts > 1:
            self._on_progress(len(self._outcomes))

    def fail(self, failure: Failure) -> None:
        """Record rules that gave no result because their process died. Raises TaskError for a policy that cannot
        be imported, since that concerns every rule."""
        if failure.problem.stage != "worker":
            raise TaskError(failure.problem)
        for number in failure.numbers:
            rules = self._plan.items[number].rules
            self.take(number, ItemOutcome(tuple(failed(rule, failure.problem) for rule in rules)))

    def _see_task(self, task: CheckedTask) -> None:
        if self._task is None:
            self._task, self._started = task, time.monotonic()

    def report(self, began: float | None, stopped: bool) -> CheckReport:
        # Nothing is known of the task if the check was stopped before the task was imported.
        task = self._task or CheckedTask("", "", None)
        by_part: dict[int, list[ItemOutcome]] = {}
        for number in sorted(self._outcomes):
            by_part.setdefault(self._plan.items[number].part, []).append(self._outcomes[number])
        of_rule: dict[str, list[RuleResult]] = {}
        for outcomes in by_part.values():
            for rule, result in self._of_part(outcomes).items():
                of_rule.setdefault(rule, []).append(result)
        ordered = tuple(self._over_parts(of_rule[rule]) for rule in RULES if rule in of_rule)
        now = time.monotonic()
        seconds, started = (0.0, 0.0) if began is None else (now - began, (self._started or now) - began)
        missing = len(self._plan.items) - len(self._outcomes)
        # Which comments silence something is known only when every rule was checked.
        decided = () if missing else ordered
        return CheckReport(
            task,
            ordered,
            seconds,
            started,
            max((outcome.picture_seconds for outcome in self._outcomes.values()), default=0.0),
            stopped,
            self._ignored,
            tuple(comments_without_effect(task.source, decided, task.class_name, task.others)),
            missing,
        )

    @property
    def _ignored(self) -> tuple[str, ...]:
        what = self._what
        return tuple(
            rule for rule in RULES if rule in what.ignore and (not what.select or rule in what.select)
        )

    def _of_part(self, outcomes: Sequence[ItemOutcome]) -> dict[str, RuleResult]:
        """The result of each rule for one part of the seeds."""
        earliest: dict[object, Finding] = {}
        for finding in (finding for outcome in outcomes for finding in outcome.findings):
            known = earliest.setdefault(finding.key, finding)
            # Which breach a process meets first depends on its rules: report the earliest of all processes.
            if (finding.first_step, finding.message) < (known.first_step, known.message):
                earliest[finding.key] = finding
        found = sorted(earliest.values(), key=lambda one: (one.file or "", one.line or 0, one.message))
        silenced = [one for outcome in outcomes for one in outcome.silenced]
        return by_rule(
            (
                *(result for outcome in outcomes for result in outcome.results),
                *gpu_results(found, silenced, self._degrees),
            )
        )

    def _over_parts(self, results: Sequence[RuleResult]) -> RuleResult:
        rule = results[0].rule
        if len(results) == 1:
            whole = results[0]
        elif rule in RULES_OVER_SEEDS:
            whole = over_seeds(results, self._degrees[rule])
        else:
            whole = merged(results, other_seeds=True)
        return replace(whole, seen=())
