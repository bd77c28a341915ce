"""The rules of the running version, checked a group at a time in the background process."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

from workbench.checks.commands import CheckAfterSave, CheckNow, StopChecks
from workbench.checks.questions import CheckedGroup, CheckGroup, RuleProgress
from workbench.checks.results import RuleResult, by_rule, failed
from workbench.checks.rule_table import degree_of_each, gpu_rules_of
from workbench.envs.gpu_rules import Finding
from workbench.live.effects import Asked
from workbench.live.events import FileSaved, LoadDone, VersionLoaded
from workbench.live.messages import Load
from workbench.live.process.ask import WAITING, Background, Priority
from workbench.live.process.background_jobs import Job, JobFailed, Jobs, ProcessDied, StoppedBy
from workbench.live.run import Run
from workbench.machine.loop import do
from workbench.page.command import Command, Refused
from workbench.task.problem import Problem

AHEAD_SECONDS = 2.0
"""Seconds of checking at low priority. After that, the priority is the lowest: a person needs the rescored
history sooner than the results of the last rules."""
MAX_DEATHS = 5
"""Maximum number of processes that may die in one check. If one dies, the running rule fails and a new
process checks the remaining rules."""
ChecksState = Literal["none", "off", "loading", "checking", "done", "stopped", "failed"]
RUNNING: tuple[ChecksState, ...] = ("loading", "checking")
DOES: frozenset[type[Command]] = frozenset({CheckNow, StopChecks, CheckAfterSave})
"""Commands that `apply` handles."""


@dataclass(frozen=True)
class ChecksView:
    """Results of the rules so far."""

    state: ChecksState = "none"
    """``loading``: the version is being loaded in the background process; ``off``: every rule is off."""
    serial: int = 0
    """Grows with every change."""
    results: tuple[RuleResult, ...] = ()
    """One result for each rule, in the order in which they came."""
    before: tuple[Finding, ...] = ()
    """Findings of an earlier version, for rules that have not been checked again."""
    total: int = 0
    """Number of rules to check; 0 while unknown."""
    looks_at: str = ""
    """What the running group looks at."""
    waits: bool = False
    """Whether another job is using the background process."""
    stopped_by: StoppedBy | None = None
    why: str = ""
    """Why the check stopped or failed, as text."""
    problem: Problem | None = None
    """The error that the author's code raised when it was loaded."""
    seconds: float = 0.0
    """Seconds since the version was loaded in the background process."""
    after_each_save: bool = True

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings of the running version."""
        return tuple(finding for result in self.results for finding in result.findings)


@dataclass(frozen=True)
class Checks:
    """State of the checks."""

    view: ChecksView = ChecksView()
    version: object = None
    """The version that `view` belongs to."""


# --- events and effects -----------------------------------------------------------------------------


@dataclass(frozen=True)
class CheckWaits:
    """Another job began or stopped using the background process."""

    waits: bool


@dataclass(frozen=True)
class GroupBegan:
    """The version is loaded in the background process; the check of a group of rules begins."""


@dataclass(frozen=True)
class RuleChecked:
    """A rule has its result."""

    result: RuleResult
    seconds: float
    """Seconds since the version was loaded in the background process."""
    total: int | None = None
    """Number of rules to check; None for a rule that failed because its process died."""


@dataclass(frozen=True)
class GroupChecked:
    """All rules of a group have their results."""

    total: int
    """Number of rules to check."""
    looks_at: str
    """What the next group of rules checks, as text."""


@dataclass(frozen=True)
class CheckDone:
    """All rules have their results."""


@dataclass(frozen=True)
class CheckFailed:
    """The job failed."""

    why: str
    problem: Problem | None


@dataclass(frozen=True)
class BeginCheck:
    """Check this version; a running check is cancelled."""

    load: Load


@dataclass(frozen=True)
class EndCheck:
    """Stop the job."""


@dataclass(frozen=True)
class KeepCheckAfterSave:
    """Store, for the next run of the workbench, whether each version that loads is checked."""

    wanted: bool


CheckEvent = CheckWaits | GroupBegan | RuleChecked | GroupChecked | CheckDone | CheckFailed
CheckEffect = BeginCheck | EndCheck
Change = tuple[Checks, list[CheckEffect | KeepCheckAfterSave]]
"""The checks after an event, and the effects to perform."""


def apply(checks: Checks, event: object, before: Run, run: Run) -> Change:
    """The checks after an event, and the effects to perform. A finding of an earlier version is kept until
    its rule has been checked again.

    Args:
        before: the run before the event.
        run: the run after it.

    Raises:
        Refused: the command makes no sense now.
    """
    match event:
        case Asked(command=CheckNow()):
            if (load := run.running_load()) is None:
                raise Refused("No task is loaded yet.")
            return _check(checks, load)
        case Asked(command=StopChecks()):
            return _stop(checks, StoppedBy.USER)
        case FileSaved():
            return _stop(checks, StoppedBy.SAVE)
        case Asked(command=CheckAfterSave(on=wanted)):
            effects: list[CheckEffect | KeepCheckAfterSave] = [KeepCheckAfterSave(wanted)]
            checks = _changed(checks, after_each_save=wanted)
            if wanted and checks.view.state == "none" and (load := run.running_load()) is not None:
                checks, begun = _check(checks, load)
                effects += begun
            return checks, effects
        case VersionLoaded() if _task_id(before) != _task_id(run):
            return _changed(checks, before=(), results=()), []
        # The check begins here, later than rescoring, which begins at `VersionLoaded`: of two jobs of the
        # same priority, the one that begins later runs first.
        case LoadDone() if (load := run.running_load()) is not None:
            return _check_loaded(checks, load)
        case _ if checks.view.state in RUNNING:
            return _take(checks, event), []
    return checks, []


def _check_loaded(checks: Checks, load: Load) -> Change:
    """Handle a version that now runs in the worker that plays: check it, or show that it is not checked."""
    if checks.version == _version(load) and checks.view.state in ("done", "off"):
        return checks, []
    if checks.view.after_each_save:
        return _check(checks, load)
    return _begin(checks, load, "none"), [EndCheck()]


def _check(checks: Checks, load: Load) -> Change:
    """Check this version; a running check is cancelled."""
    if all(degree == "off" for degree in degree_of_each(choice=load.options.rules).values()):
        return _begin(checks, load, "off"), [EndCheck()]
    return _begin(checks, load, "loading"), [BeginCheck(load)]


def _begin(checks: Checks, load: Load, state: ChecksState) -> Checks:
    """Begin the view of a version whose results are not known; findings of earlier versions move to
    `ChecksView.before`."""
    view = checks.view
    before = {
        finding.key: finding
        for finding in (*view.before, *view.findings)
        if _still_there(finding, load.source)
    }
    begun = ChecksView(
        state,
        serial=view.serial + 1,
        before=() if state == "off" else tuple(before.values()),
        total=view.total,
        after_each_save=view.after_each_save,
    )
    return Checks(begun, _version(load))


def _stop(checks: Checks, why: StoppedBy) -> Change:
    """End the check; results so far stay."""
    if checks.view.state not in RUNNING:
        return checks, []
    stopped = _changed(checks, state="stopped", stopped_by=why, why=why.value, looks_at="", waits=False)
    return stopped, [EndCheck()]


def _take(checks: Checks, event: object) -> Checks:
    """Apply an event of the running check."""
    view = checks.view
    match event:
        case CheckWaits(waits=waits) if waits != view.waits:
            return _changed(checks, waits=waits)
        case GroupBegan():
            return _changed(checks, state="checking", waits=False)
        case RuleChecked(result=result, seconds=seconds, total=total):
            results = tuple(by_rule((*view.results, result)).values())
            before = tuple(finding for finding in view.before if finding.rule != result.rule)
            total = view.total if total is None else total
            return _changed(checks, results=results, before=before, total=total, seconds=seconds)
        case GroupChecked(total=total, looks_at=looks_at):
            return _changed(checks, total=total, looks_at=looks_at)
        case CheckDone():
            return _changed(checks, state="done", before=(), looks_at="", waits=False)
        case CheckFailed(why=why, problem=problem):
            return _changed(checks, state="failed", why=why, problem=problem, looks_at="", waits=False)
    return checks


def _changed(checks: Checks, **values: Any) -> Checks:
    return replace(checks, view=replace(checks.view, serial=checks.view.serial + 1, **values))


class CheckJobs:
    """Performs the effects: one check at a time. Used on the loop, except `close`.

    The checks run in `process`, never in the worker that plays. They yield to jobs that a person waits for; a group that
    was interrupted is requested again without the rules that already have a result.
    """

    def __init__(self, process: Background, dispatch: Callable[[CheckEvent], object]) -> None:
        """
        Args:
            process: where the checks run; other jobs come first.
            dispatch: handles the events of the check.
        """
        self._process, self._dispatch = process, dispatch
        self._jobs = Jobs(self._on_progress, self._failed)

    def perform(self, effect: CheckEffect) -> None:
        match effect:
            case BeginCheck(load=load):
                self._jobs.start("checks", lambda job: self._check(job, load))
            case EndCheck():
                self._jobs.stop()

    def close(self) -> None:
        """Stop, and check nothing more. Called on any thread."""
        do(self._jobs.close)

    async def _check(self, job: Job, load: Load) -> None:
        degrees = degree_of_each(choice=load.options.rules)
        began: float | None = None
        done: set[str] = set()
        under_way: str | None = None
        deaths = 0

        def checked(result: RuleResult, total: int | None = None) -> None:
            done.add(result.rule)
            seconds = time.monotonic() - (began or time.monotonic())
            self._dispatch(RuleChecked(result, seconds, total))

        async def ask(group: int) -> CheckedGroup:
            nonlocal began
            await load_version(self._process, job, load)
            began = began or time.monotonic()
            self._dispatch(GroupBegan())
            return await self._process.ask(CheckGroup(group, degrees, tuple(done)), on_progress)

        def on_progress(count: int, total: int, now: RuleProgress) -> None:
            nonlocal under_way
            under_way = now.rule if now.result is None else None
            if now.result is not None:
                checked(now.result, total)

        group, groups = 0, 1
        while group < groups:
            ahead = began is None or time.monotonic() - began < AHEAD_SECONDS
            priority: Priority = "low" if ahead else "lowest"
            try:
                answer = await self._process.in_turns(job, partial(ask, group), priority)
            except ProcessDied as died:
                deaths += 1
                if began is None or deaths > MAX_DEATHS:
                    raise
                # The running rule fails, and another process checks the rest.
                problem = Problem("worker", str(died), None, None, None, "")
                rules = gpu_rules_of(degrees) if under_way == "" else filter(None, [under_way])
                for rule in rules:
                    checked(failed(rule, problem))
                group += under_way == ""  # GPU simulation is the last group
                under_way = None
                continue
            group, groups = group + 1, answer.groups
            self._dispatch(GroupChecked(answer.rules, answer.next))
        self._dispatch(CheckDone())

    def _on_progress(self) -> None:
        progress = self._jobs.progress
        self._dispatch(CheckWaits(progress is not None and progress.what == WAITING))

    def _failed(self, failure: JobFailed) -> None:
        self._dispatch(CheckFailed(str(failure), failure.problem))


async def load_version(process: Background, job: Job, load: Load) -> None:
    """Load a version in the background process, unless it is loaded already.

    Raises:
        JobFailed: the version cannot be loaded there.
    """
    try:
        # The new code may raise in the state in which an earlier job left the env: then the env is rebuilt.
        await process.ensure(job, load, or_else=replace(load, level="rebuilt"))
    except JobFailed as failure:
        if failure.problem is None:
            raise
        raise JobFailed(
            "the version could not be loaded in the background process", failure.problem
        ) from failure


def _still_there(finding: Finding, source: Mapping[str, str] | None) -> bool:
    """Whether this version still contains the finding's line of code; True if the line or the text of its
    file is not known."""
    if source is None or finding.file is None or not finding.code:
        return True
    text = source.get(finding.file)
    return text is None or any(line.strip() == finding.code for line in text.splitlines())


def _task_id(run: Run) -> str | None:
    return None if run.task is None else run.task.env_id


def _version(load: Load) -> object:
    """The part of a load that results depend on."""
    return str(load.task), load.source, load.options.env_kwargs, load.options.rules
