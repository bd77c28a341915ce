"""Checks a task against the rules of `workbench check`, in one process or several."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray

from workbench.authoring.loading.blamed import blamed
from workbench.authoring.loading.load import LoadedTask, undo_load
from workbench.authoring.problem import Problem, TaskError
from workbench.checks.by_hook.run import (
    CORE_GROUP,
    GROUPS,
    Group,
    RuleResult,
    State,
    core_results,
    run_core,
    run_group,
)
from workbench.checks.comments import Comment, comments_without_effect
from workbench.checks.evidence.checkup import Checkup
from workbench.checks.results import Silenced
from workbench.checks.rules import CHECK_RULES, RULES, degree_of_each
from workbench.core.backends import find_renderer, keep_render_device
from workbench.core.capture.recorded_run import RecordedRun
from workbench.core.env.assets import require_assets, robots_of
from workbench.core.env.step_result import StepResult
from workbench.core.env.task_env import TaskEnv, given_arguments
from workbench.core.rules import DEGREES, Degree, FailOn, Finding, fails
from workbench.jobs.actions import (
    SOLVE,
    STEPS_WITHOUT_LIMIT,
    RecordActionChooser,
    find_actions,
    plain_chooser,
)
from workbench.jobs.open_task import Opening, import_task
from workbench.jobs.pool.deal import Deal, Executor, ItemQueue, ThisProcess, Work
from workbench.jobs.pool.processes import Processes
from workbench.jobs.replay import begin_run
from workbench.jobs.task import TaskOptions
from workbench.machine.folders import CurrentFolder

_ORDER: tuple[State, ...] = ("broken", "silenced", "failed", "kept", "skipped")
"""Of the states that one rule has in several processes, the first counts."""


@dataclass(frozen=True)
class CheckOptions:
    """What to check, and how."""

    task: str
    options: TaskOptions = field(default_factory=lambda: TaskOptions(num_envs=8))
    seeds: int = 32
    """How many are tried, from ``options.seed`` on."""
    select: tuple[str, ...] = ()
    """Only these rules; empty for all."""
    ignore: tuple[str, ...] = ()
    actions: str = "random"
    """As `RecordArguments.actions`. In further episodes, beside random ones, what it names acts."""
    workers: int | None = None
    """Processes; None for as many as cores and groups of rules allow."""
    solve: bool = False
    """Whether the rules that need planned episodes are checked too."""


@dataclass(frozen=True)
class CheckedTask:
    """The task that was imported."""

    env_id: str
    class_name: str
    file: str | None
    others: tuple[str, ...] = ()
    """Further tasks of the file, which were not checked."""
    notices: tuple[str, ...] = ()
    source: Mapping[str, str] = field(default_factory=dict)
    """Path to text of the author's files."""


@dataclass(frozen=True)
class CheckUpdate:
    """Progress of a process; one of these."""

    task: CheckedTask | None = None
    """It is imported, and the checks begin."""
    activity: str = ""
    """What is being looked at."""
    result: RuleResult | None = None
    finding: Finding | None = None
    """Of a rule of GPU simulation."""
    picture_seconds: float = 0.0
    """For the first pictures of a process."""
    silenced: Silenced | None = None
    """Likewise, with a comment that silences it."""


@dataclass(frozen=True)
class CheckReport:
    """What the checks came to."""

    task: CheckedTask
    results: tuple[RuleResult, ...]
    """In the order of the table, without rules that are off."""
    seconds: float
    start_seconds: float
    """Of those, until the first process had imported the task."""
    picture_seconds: float = 0.0
    """Of those, for the first pictures."""
    stopped: bool = False
    ignored: tuple[str, ...] = ()
    """Rules that would have been checked without `CheckOptions.ignore`."""
    comments: tuple[Comment, ...] = ()
    """Silencing comments that silence nothing."""

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Those that stop first; then in the order of the table."""
        found = [finding for result in self.results for finding in result.findings]
        return tuple(sorted(found, key=lambda finding: DEGREES.index(finding.degree)))

    def of_state(self, state: State) -> tuple[RuleResult, ...]:
        return tuple(result for result in self.results if result.state == state)

    def fails(self, fail_on: FailOn) -> bool:
        """Whether a finding has this degree or a higher one, or a rule is undecided because the task raised. Never for
        ``never``."""
        if fail_on == "never":
            return False
        if any(fails(finding.degree, fail_on) for finding in self.findings):
            return True
        accepted = any(result.rule == "runs" for result in self.of_state("silenced"))
        return bool(self.of_state("failed")) and not accepted


def groups_of(degrees: Mapping[str, Degree]) -> list[Group]:
    """The groups with a rule that is not off; the last one lets the rules of GPU simulation look, and checks none itself."""
    groups = [group for group in GROUPS if any(degrees[rule] != "off" for rule in group.checks)]
    core = any(degrees[rule] != "off" for rule in RULES if rule not in CHECK_RULES)
    # Whether the task runs is known from there too.
    return [*groups, Group(CORE_GROUP, {})] if core or degrees["runs"] != "off" else groups


def count_rules(degrees: Mapping[str, Degree]) -> int:
    """How many rules a check gives a result of."""
    in_groups = {rule for group in groups_of(degrees) for rule in group.checks if degrees[rule] != "off"}
    core = {rule for rule in RULES if rule not in CHECK_RULES and degrees[rule] != "off"}
    return len(in_groups | core)


def degrees_of_request(what: CheckOptions) -> dict[str, Degree]:
    """The degree of each rule. Raises ValueError for a request that is invalid."""
    for name, number in (("seeds", what.seeds), ("workers", what.workers)):
        if number is not None and number < 1:
            raise ValueError(f"--{name} must be at least 1, not {number}")
    if what.actions == SOLVE:
        raise ValueError("--actions solve is for workbench record: --solve checks rules on planned episodes")
    degrees = degree_of_each(what.select, what.ignore, solve=what.solve)
    if not groups_of(degrees):
        raise ValueError("no rule is left to check")
    return degrees


def check(
    what: CheckOptions,
    on_activity: Callable[[str], None] = lambda activity: None,
    on_result: Callable[[RuleResult], None] = lambda result: None,
    stop: Callable[[], bool] = lambda: False,
    executor: Executor | None = None,
    began: float | None = None,
) -> CheckReport:
    """Check a task.

    Args:
        on_activity: gets what is being looked at, for a status line.
        on_result: gets the result of each rule as it comes; of a rule that several processes look at, several.
        stop: called between steps; after True the rules that are not done are missing in the report.
        executor: None for this process, or for spawned processes with several workers.
        began: when the work began, by ``time.monotonic()``; None for now.

    Raises:
        TaskError: the task or the policy cannot be imported, or the task lacks assets.
        PoolError: a process that checks died.
        FileNotFoundError, ValueError: the request is invalid.
    """
    began = time.monotonic() if began is None else began
    degrees = degrees_of_request(what)
    _, env_kwargs = find_actions(what.actions, what.task)
    made = replace(what.options, env_kwargs={**env_kwargs, **what.options.env_kwargs})
    what = replace(what, options=made)
    groups = groups_of(degrees)
    cores = len(os.sched_getaffinity(0))
    workers = min(cores if what.workers is None else what.workers, len(groups))
    found = _Results(degrees, on_activity, on_result)
    deal: Deal[None, CheckUpdate] = Deal(range(len(groups)), lambda number, none: None, found.take, stop)
    work = Work(_check_groups, what, result=None, update=CheckUpdate, name="that checks")
    (executor or (ThisProcess() if workers == 1 else Processes(workers))).run(work, deal)
    return found.report(began, stop(), _ignored(what))


def _ignored(what: CheckOptions) -> tuple[str, ...]:
    return tuple(rule for rule in RULES if rule in what.ignore and (not what.select or rule in what.select))


class _Results:
    """Collects the results of all processes."""

    def __init__(
        self,
        degrees: Mapping[str, Degree],
        on_activity: Callable[[str], None],
        on_result: Callable[[RuleResult], None],
    ) -> None:
        self._degrees, self._on_activity, self._on_result = degrees, on_activity, on_result
        self._task: CheckedTask | None = None
        self._started = 0.0
        self._picture_seconds = 0.0
        self._results: list[RuleResult] = []
        self._findings: list[Finding] = []
        self._silenced: list[Silenced] = []

    def take(self, update: CheckUpdate) -> None:
        if update.task is not None and self._task is None:
            self._task, self._started = update.task, time.monotonic()
        if update.activity:
            self._on_activity(update.activity)
        if update.result is not None:
            self._results.append(update.result)
            self._on_result(update.result)
        if update.finding is not None:
            self._findings.append(update.finding)
        self._picture_seconds = max(self._picture_seconds, update.picture_seconds)
        if update.silenced is not None:
            self._silenced.append(update.silenced)

    def report(self, began: float, stopped: bool, ignored: tuple[str, ...]) -> CheckReport:
        # Stopped before the task was imported: nothing is known of it.
        task = self._task or CheckedTask("", "", None)
        results = [*self._results, *core_results(self._findings, self._silenced, self._degrees)]
        by_rule: dict[str, list[RuleResult]] = {}
        for result in results:
            by_rule.setdefault(result.rule, []).append(result)
        ordered = tuple(merged(by_rule[rule]) for rule in RULES if rule in by_rule)
        now = time.monotonic()
        started = (self._started or now) - began
        comments = comments_without_effect(task.source, ordered, task.class_name, task.others)
        return CheckReport(
            task, ordered, now - began, started, self._picture_seconds, stopped, ignored, tuple(comments)
        )


def merged(results: Iterable[RuleResult]) -> RuleResult:
    """One result of those that one rule has in several processes. The same breach counts once: they look at the same seeds."""
    results = sorted(results, key=lambda result: _ORDER.index(result.state))
    first = results[0]
    findings: dict[object, Finding] = {}
    for finding in (finding for result in results for finding in result.findings):
        known = findings.setdefault(finding.key, finding)
        if finding.count > known.count:
            findings[finding.key] = finding
    silenced = {(one.finding.key, one.line): one for result in results for one in result.silenced}
    return replace(
        first,
        findings=tuple(findings.values()),
        silenced=tuple(silenced.values()),
        notes=tuple(dict.fromkeys(note for result in results for note in result.notes)),
        seconds=sum(result.seconds for result in results),
    )


# --- one process -----------------------------------------------------------------------------------------


class _Stopped(Exception):
    """No result is needed any more."""


def _check_groups(what: CheckOptions, queue: ItemQueue) -> None:
    """Check the groups that one process gets. Raises as `check`."""
    torch.set_num_threads(1)  # see workbench.session.worker.loop.work
    degrees = degree_of_each(what.select, what.ignore, solve=what.solve)
    groups = groups_of(degrees)
    number = -1

    def keep_going() -> None:
        if queue.limit() <= number:
            raise _Stopped

    here = CurrentFolder()  # the task may change it
    with here.again(), ExitStack() as stack:
        if "render_backend" not in what.options.env_kwargs and (renderer := find_renderer()) is not None:
            # SAPIEN refuses it while a material of a build that failed is alive.
            keep_render_device(renderer.render_backend)
        runs, _ = find_actions(what.actions, what.task)
        opening = Opening(lambda activity: queue.send_update(CheckUpdate(activity=activity)))
        loaded = import_task(what.task, what.options, None, opening)
        stack.callback(undo_load, loaded)
        checkup = Checkup(
            loaded,
            what.options.env_kwargs,
            num_envs=what.options.num_envs,
            seeds=what.seeds,
            first_seed=what.options.seed,
            actors=[] if what.actions == "random" else [_Given(what, loaded, runs, here)],
            keep_going=keep_going,
        )
        stack.callback(checkup.close)
        _require_assets(loaded, what)
        queue.send_update(CheckUpdate(task=_described(loaded)))
        with suppress(_Stopped):
            while (chunk := queue.next()) is not None:
                (number,) = chunk.numbers
                queue.send_update(CheckUpdate(activity=groups[number].name))
                _check_group(groups[number], checkup, degrees, queue)
                queue.send_update(CheckUpdate(picture_seconds=checkup.picture_seconds))
                queue.send_result(number, None)


def _check_group(group: Group, checkup: Checkup, degrees: Mapping[str, Degree], queue: ItemQueue) -> None:
    known, silenced = len(checkup.findings), len(checkup.silenced)
    run = run_core if group.name == CORE_GROUP else run_group
    for result in run(group, checkup, degrees):
        queue.send_update(CheckUpdate(result=result))
    for finding in checkup.findings[known:]:
        queue.send_update(CheckUpdate(finding=finding))
    for one in checkup.silenced[silenced:]:
        queue.send_update(CheckUpdate(silenced=one))


def _require_assets(loaded: LoadedTask, what: CheckOptions) -> None:
    """Raise TaskError for a download that is missing: no line of the task is at fault."""
    given = given_arguments(loaded.cls, what.options.env_kwargs, loaded.default_kwargs)
    with blamed("build", loaded):
        require_assets(loaded.cls.__name__, loaded.asset_ids, robots_of(loaded.cls, given))


def _described(loaded: LoadedTask) -> CheckedTask:
    file = None if loaded.file is None else str(loaded.file)
    others = loaded.others if loaded.followed else ()
    notices = loaded.notices if loaded.followed else ()
    return CheckedTask(loaded.env_id, loaded.chosen, file, others, notices, loaded.source)


class _Given:
    """Acts as ``--actions`` says: a policy in an episode of each seed, or the episodes of a file."""

    kind = "given"

    def __init__(
        self, what: CheckOptions, loaded: LoadedTask, runs: Sequence[RecordedRun], here: CurrentFolder
    ) -> None:
        """
        Args:
            runs: of the file, as `find_actions` gives them.
            here: where a policy is found.

        Raises:
            TaskError: the policy cannot be imported.
        """
        self._loaded = loaded
        first = what.options.seed
        if runs:
            # Actions that belong to no start are tried from each seed.
            from_seeds = len(runs) == 1 and runs[0].seed < 0 and not runs[0].env_states
            count = what.seeds if from_seeds else min(len(runs), what.seeds)
            chosen = [runs[k % len(runs)] for k in range(count)]
            self._runs = [
                run if run.seed >= 0 else replace(run, seed=first + k) for k, run in enumerate(chosen)
            ]
            self.seeds, self.lengths = [run.seed for run in self._runs], [run.length for run in self._runs]
            self._chooser = RecordActionChooser(None)
        else:
            self._runs: list[RecordedRun] = []
            self.seeds = list(range(first, first + what.seeds))
            self.lengths = [loaded.max_episode_steps or STEPS_WITHOUT_LIMIT] * what.seeds
            self._chooser = RecordActionChooser(plain_chooser(what.actions, what.task, first, here))
        self._begun: list[int] = []

    def begin(self, task: TaskEnv, episodes: Sequence[int]) -> StepResult:
        self._begun = list(episodes)
        runs = {env: self._runs[k] for env, k in enumerate(episodes) if self._runs}
        for env, k in enumerate(episodes):
            self._chooser.begin(env, self.seeds[k], runs.get(env))
        if not runs:
            with blamed("reset", self._loaded, task):
                return task.reset([self.seeds[k] for k in episodes])
        begin_run(self._loaded, task, runs)
        with blamed("restore", self._loaded, task):
            return task.rescore()

    def next_action(self, task: TaskEnv, step: int) -> NDArray[np.float32]:
        running = {env: step for env, k in enumerate(self._begun) if step < self.lengths[k]}
        try:
            return self._chooser.next_action(task, running)
        except ValueError as error:
            raise TaskError(Problem("policy", str(error), None, None, None, "")) from error
