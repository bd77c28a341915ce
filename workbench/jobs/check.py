"""Checks a task against the rules of `workbench check`, in one process or several."""

from __future__ import annotations

import os
import random
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
    RULES_OVER_SEEDS,
    Group,
    core_results,
    over_seeds,
    run_core,
    run_group,
)
from workbench.checks.comments import Comment, comments_without_effect
from workbench.checks.evidence.checkup import Checkup
from workbench.checks.results import RuleResult, Silenced, State
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
    needed_by,
    plain_chooser,
)
from workbench.jobs.open_task import Opening, import_task
from workbench.jobs.pool.deal import Chunk, Deal, Executor, ItemQueue, ThisProcess, Work
from workbench.jobs.pool.processes import Processes
from workbench.jobs.replay import begin_run
from workbench.jobs.task import TaskOptions
from workbench.machine.folders import CurrentFolder

SEEDS_OF_PART = 32
"""Seeds that are looked at together, in one set of envs."""
_TRIES = 3
"""How often groups of rules are begun whose workers die."""
_ORDER: tuple[State, ...] = ("broken", "silenced", "failed", "kept", "skipped")
"""Of the states that one rule has in several groups or parts of the seeds, the first counts."""


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
    """Processes, if no executor is given; None for as many as cores and chunks allow."""
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
    """To be shown as it comes: it comes again with its group."""


@dataclass(frozen=True)
class GroupOutcome:
    """What a group of rules came to for one part of the seeds."""

    results: tuple[RuleResult, ...]
    findings: tuple[Finding, ...] = ()
    """Of rules of GPU simulation."""
    silenced: tuple[Silenced, ...] = ()
    """Likewise, with a comment that silences it."""
    picture_seconds: float = 0.0
    """For the first pictures of a process."""
    task: CheckedTask | None = None
    """With the first group of each chunk."""


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
    missing: int = 0
    """Groups of rules, counted for each part of the seeds, that were not looked at."""

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


@dataclass(frozen=True)
class _Plan:
    """The items of a check: groups of rules on parts of the seeds. Those that do not depend on the seeds are looked at in the
    first part alone."""

    groups: list[Group]
    over_seeds: frozenset[str]
    """Rules that are checked in every part."""
    part: int
    """Seeds of a part. What compares whole batches takes one for each env."""
    parts: int

    @property
    def numbers(self) -> list[int]:
        """Group g of part k is item ``k * len(groups) + g``."""
        count = len(self.groups)
        further = [g for g, group in enumerate(self.groups) if not self.over_seeds.isdisjoint(group.checks)]
        return [*range(count), *(k * count + g for k in range(1, self.parts) for g in further)]

    @property
    def chunk(self) -> int:
        """Items of a chunk. Of one part each group is one; of several all groups of a part, which look at the same episodes."""
        return 1 if self.parts == 1 else len(self.groups)

    @property
    def chunks(self) -> int:
        return len(self.groups) if self.parts == 1 else self.parts

    def of(self, number: int) -> tuple[int, Group]:
        """Part and group of an item."""
        part, group = divmod(number, len(self.groups))
        return part, self.groups[group]

    def episodes(self, part: int, seeds: int) -> range:
        """Which of so many seeds are in a part, from 0 on."""
        return range(part * self.part, min((part + 1) * self.part, seeds))


def _plan(what: CheckOptions, degrees: Mapping[str, Degree]) -> _Plan:
    part = max(SEEDS_OF_PART, what.options.num_envs)
    over_seeds = frozenset(rule for rule in RULES_OVER_SEEDS if degrees[rule] != "off")
    return _Plan(groups_of(degrees), over_seeds, part, -(-what.seeds // part))


def count_chunks(what: CheckOptions) -> int:
    """Chunks of the job. Raises ValueError for a request that is invalid."""
    return _plan(what, degrees_of_request(what)).chunks


def count_groups(what: CheckOptions, chunks: range) -> int:
    """Groups of rules in these chunks, counted for each part of the seeds."""
    plan = _plan(what, degrees_of_request(what))
    return sum(number // plan.chunk in chunks for number in plan.numbers)


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
        on_activity: gets what is being looked at, for a status line.
        on_result: gets the result of each rule as it comes; of a rule that several processes look at, several. Of several
            parts of the seeds, only those that no further part changes.
        stop: called between steps; after True the rules that are not done are missing in the report.
        executor: None for this process, or for spawned processes with several workers.
        began: when the work began, by ``time.monotonic()``; None for now.
        on_progress: where there are several parts of the seeds, gets how many groups of rules are done.

    Raises:
        TaskError: the task or the policy cannot be imported, or the task lacks assets.
        PoolError: a process that checks failed, or processes die again and again.
        FileNotFoundError, ValueError: the request is invalid.
    """
    began = time.monotonic() if began is None else began
    degrees = degrees_of_request(what)
    _, env_kwargs = find_actions(what.actions, what.task)
    made = replace(what.options, env_kwargs={**env_kwargs, **what.options.env_kwargs})
    what = replace(what, options=made)
    plan = _plan(what, degrees)
    if executor is None:
        cores = len(os.sched_getaffinity(0))
        workers = min(cores if what.workers is None else what.workers, plan.chunks)
        executor = ThisProcess() if workers == 1 else Processes(workers)
    found = _Results(what, on_activity, on_result, on_progress)
    deal: Deal[GroupOutcome, CheckUpdate] = Deal(
        plan.numbers, found.take, found.hear, stop, chunk=plan.chunk, tries=_TRIES
    )
    needed = needed_by(what.task, what.actions, what.options.imports)
    work = Work(
        _check_groups,
        what,
        result=GroupOutcome,
        update=CheckUpdate,
        name="that checks",
        folders=needed.folders,
        files=needed.files,
    )
    executor.run(work, deal)
    return found.report(began, stop())


def report_of(what: CheckOptions, known: Mapping[int, GroupOutcome]) -> CheckReport:
    """The report of a check of which these items are known. Runs nothing. Raises ValueError as `degrees_of_request`."""
    found = _Results(what)
    for number in sorted(known):
        found.take(number, known[number])
    return found.report(None, stopped=False)


class _Results:
    """Collects what all processes give."""

    def __init__(
        self,
        what: CheckOptions,
        on_activity: Callable[[str], None] = lambda activity: None,
        on_result: Callable[[RuleResult], None] = lambda result: None,
        on_progress: Callable[[int], None] = lambda done: None,
    ) -> None:
        self._what, self._degrees = what, degrees_of_request(what)
        self._plan = _plan(what, self._degrees)
        self._on_activity, self._on_result, self._on_progress = on_activity, on_result, on_progress
        self._task: CheckedTask | None = None
        self._started = 0.0
        self._shown: set[tuple[str, float]] = set()
        """Results that were told already, by rule and seconds."""
        self._groups: dict[int, GroupOutcome] = {}

    def hear(self, update: CheckUpdate) -> None:
        if update.task is not None:
            self._see_task(update.task)
        if update.activity:
            self._on_activity(update.activity)
        if update.result is not None:
            self._show(update.result)

    def take(self, number: int, group: GroupOutcome) -> None:
        if group.task is not None:
            self._see_task(group.task)
        self._groups[number] = group
        for result in group.results:
            self._show(result)
        if self._plan.parts > 1:
            self._on_progress(len(self._groups))

    def _see_task(self, task: CheckedTask) -> None:
        if self._task is None:
            self._task, self._started = task, time.monotonic()

    def _show(self, result: RuleResult) -> None:
        known = result.rule, result.seconds
        if known in self._shown or (self._plan.parts > 1 and result.rule in RULES_OVER_SEEDS):
            return
        self._shown.add(known)
        self._on_result(result)

    def report(self, began: float | None, stopped: bool) -> CheckReport:
        # Stopped before the task was imported: nothing is known of it.
        task = self._task or CheckedTask("", "", None)
        by_part: dict[int, list[GroupOutcome]] = {}
        for number in sorted(self._groups):
            by_part.setdefault(self._plan.of(number)[0], []).append(self._groups[number])
        by_rule: dict[str, list[RuleResult]] = {}
        for groups in by_part.values():
            for rule, result in self._of_part(groups).items():
                by_rule.setdefault(rule, []).append(result)
        ordered = tuple(self._over_parts(by_rule[rule]) for rule in RULES if rule in by_rule)
        now = time.monotonic()
        seconds, started = (0.0, 0.0) if began is None else (now - began, (self._started or now) - began)
        missing = len(self._plan.numbers) - len(self._groups)
        # Of what is not looked at yet nobody knows what it silences.
        decided = () if missing else ordered
        return CheckReport(
            task,
            ordered,
            seconds,
            started,
            max((group.picture_seconds for group in self._groups.values()), default=0.0),
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

    def _of_part(self, groups: Sequence[GroupOutcome]) -> dict[str, RuleResult]:
        """The result of each rule for one part of the seeds."""
        earliest: dict[object, Finding] = {}
        for finding in (finding for group in groups for finding in group.findings):
            known = earliest.setdefault(finding.key, finding)
            # Which one each process meets first depends on what it does.
            if (finding.first_step, finding.message) < (known.first_step, known.message):
                earliest[finding.key] = finding
        found = sorted(earliest.values(), key=lambda one: (one.file or "", one.line or 0, one.message))
        silenced = [one for group in groups for one in group.silenced]
        by_rule: dict[str, list[RuleResult]] = {}
        for result in (
            *(result for group in groups for result in group.results),
            *core_results(found, silenced, self._degrees),
        ):
            by_rule.setdefault(result.rule, []).append(result)
        return {rule: merged(results) for rule, results in by_rule.items()}

    def _over_parts(self, results: Sequence[RuleResult]) -> RuleResult:
        rule = results[0].rule
        if len(results) == 1:
            whole = results[0]
        elif rule in RULES_OVER_SEEDS:
            whole = over_seeds(results, self._degrees[rule])
        else:
            whole = merged(results, other_seeds=True)
        return replace(whole, seen=())


def merged(results: Iterable[RuleResult], other_seeds: bool = False) -> RuleResult:
    """One result of those that one rule has.

    Args:
        other_seeds: each is of other seeds: the breaches of all are counted. Else they are of several groups, which look at
            the same seeds, and the same breach counts once.
    """
    results = sorted(results, key=lambda result: _ORDER.index(result.state))
    first = results[0]
    findings: dict[object, Finding] = {}
    for finding in (finding for result in results for finding in result.findings):
        known = findings.setdefault(finding.key, finding)
        if known is not finding and other_seeds:
            findings[finding.key] = replace(known, count=known.count + finding.count)
        elif finding.count > known.count:
            findings[finding.key] = finding
    silenced = {(one.finding.key, one.line): one for result in results for one in result.silenced}
    return replace(
        first,
        findings=tuple(findings.values()),
        silenced=tuple(silenced.values()),
        notes=tuple(dict.fromkeys(note for result in results for note in result.notes)),
        seconds=sum(result.seconds for result in results),
        seen=tuple(row for result in results for row in result.seen),
    )


# --- one process -----------------------------------------------------------------------------------------


class _Stopped(Exception):
    """No result is needed any more."""


def _check_groups(what: CheckOptions, queue: ItemQueue) -> None:
    """Check the chunks that one process gets. Raises as `check`."""
    torch.set_num_threads(1)  # see workbench.session.worker.loop.work
    here = CurrentFolder()  # the task may change it
    with here.again(), ExitStack() as stack:
        if "render_backend" not in what.options.env_kwargs and (renderer := find_renderer()) is not None:
            # SAPIEN refuses it while a material of a build that failed is alive.
            keep_render_device(renderer.render_backend)
        runs, _ = find_actions(what.actions, what.task)
        opening = Opening(lambda activity: queue.send_update(CheckUpdate(activity=activity)))
        loaded = import_task(what.task, what.options, None, opening)
        stack.callback(undo_load, loaded)
        _require_assets(loaded, what)
        worker = _Worker(what, loaded, runs, here, queue)
        queue.send_update(CheckUpdate(task=worker.task))
        stack.callback(worker.close)
        with suppress(_Stopped):
            while (chunk := queue.next()) is not None:
                worker.check(chunk)


class _Worker:
    """Checks groups of rules, with one `Checkup` for each part of the seeds."""

    def __init__(
        self,
        what: CheckOptions,
        loaded: LoadedTask,
        runs: Sequence[RecordedRun],
        here: CurrentFolder,
        queue: ItemQueue,
    ) -> None:
        """
        Args:
            runs: as `find_actions` gives them.
            here: where a policy is found.
        """
        self._what, self._loaded, self._runs, self._here, self._queue = what, loaded, runs, here, queue
        self._degrees = degree_of_each(what.select, what.ignore, solve=what.solve)
        self._plan = _plan(what, self._degrees)
        self._number = -1
        self._part = -1
        self._checkup: Checkup | None = None
        self.task = _described(loaded)

    def close(self) -> None:
        if self._checkup is not None:
            self._checkup.close()

    def check(self, chunk: Chunk) -> None:
        for number in sorted(chunk.wanted):
            self._number = number
            self._keep_going()
            part, group = self._plan.of(number)
            checkup = self._checkup_of(part)
            count = self._plan.parts
            self._queue.send_update(
                CheckUpdate(
                    activity=group.name if count == 1 else f"seeds, part {part + 1} of {count}: {group.name}"
                )
            )
            task = self.task if number == chunk.numbers[0] else None
            self._queue.send_result(number, self._checked(group, checkup, task))

    def _keep_going(self) -> None:
        if self._queue.limit() <= self._number:
            raise _Stopped

    def _checkup_of(self, part: int) -> Checkup:
        if self._checkup is not None and part == self._part:
            return self._checkup
        self.close()
        # What the task draws outside of resets must not depend on what this process did before.
        random.seed(0)
        np.random.seed(0)
        torch.manual_seed(0)
        what, episodes = self._what, self._plan.episodes(part, self._what.seeds)
        given = (
            _Given(what, self._loaded, self._runs, self._here, episodes) if what.actions != "random" else None
        )
        self._part = part
        self._checkup = Checkup(
            self._loaded,
            what.options.env_kwargs,
            num_envs=what.options.num_envs,
            seeds=len(episodes),
            first_seed=what.options.seed + episodes.start,
            actors=[given] if given is not None and given.seeds else [],
            keep_going=self._keep_going,
        )
        return self._checkup

    def _checked(self, group: Group, checkup: Checkup, task: CheckedTask | None) -> GroupOutcome:
        known, silenced = len(checkup.findings), len(checkup.silenced)
        if self._part > 0:
            checks = {rule: check for rule, check in group.checks.items() if rule in RULES_OVER_SEEDS}
            group = replace(group, checks=checks)
        run = run_core if group.name == CORE_GROUP else run_group
        results: list[RuleResult] = []
        for result in run(group, checkup, self._degrees):
            results.append(result)
            self._queue.send_update(CheckUpdate(result=replace(result, seen=())))
        return GroupOutcome(
            tuple(results),
            tuple(checkup.findings[known:]),
            tuple(checkup.silenced[silenced:]),
            checkup.picture_seconds,
            task,
        )


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
        self,
        what: CheckOptions,
        loaded: LoadedTask,
        runs: Sequence[RecordedRun],
        here: CurrentFolder,
        episodes: range,
    ) -> None:
        """
        Args:
            runs: of the file, as `find_actions` gives them.
            here: where a policy is found.
            episodes: which of those of the whole check.

        Raises:
            TaskError: the policy cannot be imported.
        """
        self._loaded = loaded
        first = what.options.seed
        if runs:
            # Actions that belong to no start are tried from each seed.
            from_seeds = len(runs) == 1 and runs[0].seed < 0 and not runs[0].env_states
            count = what.seeds if from_seeds else min(len(runs), what.seeds)
            chosen = {k: runs[k % len(runs)] for k in episodes if k < count}
            self._runs = [run if run.seed >= 0 else replace(run, seed=first + k) for k, run in chosen.items()]
            self.seeds, self.lengths = [run.seed for run in self._runs], [run.length for run in self._runs]
            self._chooser = RecordActionChooser(None)
        else:
            self._runs: list[RecordedRun] = []
            self.seeds = [first + k for k in episodes]
            self.lengths = [loaded.max_episode_steps or STEPS_WITHOUT_LIMIT] * len(episodes)
            chooser = plain_chooser(what.actions, what.task, first + episodes.start, here)
            self._chooser = RecordActionChooser(chooser)
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
