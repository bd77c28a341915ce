"""The rules of the running version, checked a group at a time in the background process."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

from workbench.authoring.problem import Problem
from workbench.checks.results import RuleResult, by_rule, failed
from workbench.checks.rules import core_rules_of, degree_of_each
from workbench.core.rules import Finding
from workbench.session.loop import on_loop
from workbench.session.process.askers import WAITING, Background, Priority
from workbench.session.process.jobs import Job, JobFailed, Jobs, ProcessDied
from workbench.session.protocol.messages import Load
from workbench.session.protocol.questions import CheckedGroup, CheckGroup, RuleProgress
from workbench.session.rescore.background import StoppedBy

AHEAD = 2.0
"""Seconds of checking at low priority; then at the lowest, since a person waits more for the rescored history than
for the last rule."""
MOST_DEATHS = 5
"""Most processes that may die in one check; the rule that was running fails, and the next process checks the others."""
ChecksState = Literal["none", "off", "loading", "checking", "done", "stopped", "failed"]
RUNNING: tuple[ChecksState, ...] = ("loading", "checking")


@dataclass(frozen=True)
class ChecksView:
    """Results of the rules so far."""

    state: ChecksState = "none"
    """``loading``: the version is loaded in the background process; ``off``: every rule is off."""
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
    """Whether another job has the background process."""
    stopped_by: StoppedBy | None = None
    why: str = ""
    """Why the check stopped or failed, as text."""
    problem: Problem | None = None
    """What the code raised when it was loaded."""
    seconds: float = 0.0
    """Seconds since the version was loaded in the background process."""
    after_each_save: bool = True

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings of the running version."""
        return tuple(finding for result in self.results for finding in result.findings)


class Checks:
    """Checks the running version, and keeps the findings of the version before until each rule has been checked again.

    Nothing of it runs in the worker that plays. The process gives way to whatever a person waits for; a group that was cut
    short is asked again without the rules that are known. Methods return at once.
    """

    def __init__(self, on_change: Callable[[], None], process: Background, after_each_save: bool) -> None:
        """
        Args:
            on_change: called when `view` has changed.
            process: where it runs; other jobs come first.
            after_each_save: whether `loaded` begins to check.
        """
        self._process, self._on_change = process, on_change
        self._view = ChecksView(after_each_save=after_each_save)
        self._of: object = None
        """The version that `view` belongs to."""
        self._jobs = Jobs(on_change, self._failed)

    @property
    def view(self) -> ChecksView:
        progress = self._jobs.progress
        return replace(self._view, waits=progress is not None and progress.what == WAITING)

    @on_loop
    def loaded(self, load: Load, same_task: bool) -> None:
        """A version runs in the worker that plays.

        Args:
            load: loads it.
            same_task: whether it is another version of the task that ran.
        """
        if not same_task:
            self._set(before=(), results=())
        if self._of == _version(load) and self._view.state in ("done", "off"):
            return
        if self._view.after_each_save:
            self.check(load)
        else:
            self._jobs.stop()
            self._begin(load, "none")

    @on_loop
    def check(self, load: Load) -> None:
        """Check this version; a running check is cancelled."""
        if all(degree == "off" for degree in degree_of_each(choice=load.options.rules).values()):
            self._jobs.stop()
            self._begin(load, "off")
            return
        self._jobs.start("checks", lambda job: self._check(job, load))
        self._begin(load, "loading")

    @on_loop
    def check_after_each_save(self, wanted: bool) -> None:
        """Set whether `loaded` begins a check."""
        self._set(after_each_save=wanted)

    @on_loop
    def stop(self, why: StoppedBy = StoppedBy.HAND) -> None:
        """End the check; results so far stay."""
        self._jobs.stop()
        if self._view.state in RUNNING:
            self._set(state="stopped", stopped_by=why, why=why.value, looks_at="")

    @on_loop
    def close(self) -> None:
        """Stop, and check nothing more."""
        self.stop(StoppedBy.CLOSING)
        self._jobs.close()

    # --- the job -------------------------------------------------------------------------------------

    async def _check(self, job: Job, load: Load) -> None:
        degrees = degree_of_each(choice=load.options.rules)
        began: float | None = None
        done: set[str] = set()
        under_way: str | None = None
        deaths = 0

        async def ask(group: int) -> CheckedGroup:
            nonlocal began
            await load_version(self._process, job, load)
            began = began or time.monotonic()
            self._set(state="checking")
            return await self._process.ask(CheckGroup(group, degrees, tuple(done)), hear)

        def hear(count: int, total: int, now: RuleProgress) -> None:
            nonlocal under_way
            under_way = now.rule if now.result is None else None
            if now.result is not None:
                done.add(now.rule)
                self._take(began, total, now.result)

        group, groups = 0, 1
        while group < groups:
            ahead = began is None or time.monotonic() - began < AHEAD
            priority: Priority = "low" if ahead else "lowest"
            try:
                answer = await self._process.in_turns(job, partial(ask, group), priority)
            except ProcessDied as died:
                deaths += 1
                if began is None or deaths > MOST_DEATHS:
                    raise
                # What it was at fails, and the rest is asked of another process.
                problem = Problem("worker", str(died), None, None, None, "")
                rules = core_rules_of(degrees) if under_way == "" else filter(None, [under_way])
                for rule in rules:
                    done.add(rule)
                    self._take(began, self._view.total, failed(rule, problem))
                group += under_way == ""  # that is the last one
                under_way = None
                continue
            group, groups = group + 1, answer.groups
            self._set(total=answer.rules, looks_at=answer.next)
        self._set(state="done", before=(), looks_at="")

    def _take(self, began: float | None, total: int, result: RuleResult) -> None:
        results = by_rule((*self._view.results, result))
        before = tuple(finding for finding in self._view.before if finding.rule != result.rule)
        seconds = time.monotonic() - (began or time.monotonic())
        self._set(results=tuple(results.values()), before=before, total=total, seconds=seconds)

    def _failed(self, failure: JobFailed) -> None:
        self._set(state="failed", why=str(failure), problem=failure.problem, looks_at="")

    # --- the view ------------------------------------------------------------------------------------

    def _set(self, **values: Any) -> None:
        self._view = replace(self._view, serial=self._view.serial + 1, **values)
        self._on_change()

    def _begin(self, load: Load, state: ChecksState) -> None:
        """Begin the view of a version whose results are not known; findings of earlier versions move to
        `ChecksView.before`."""
        self._of, view = _version(load), self._view
        before = {
            finding.key: finding
            for finding in (*view.before, *view.findings)
            if _still_there(finding, load.source)
        }
        self._view = ChecksView(
            state,
            serial=view.serial + 1,
            before=() if state == "off" else tuple(before.values()),
            total=view.total,
            after_each_save=view.after_each_save,
        )
        self._on_change()


async def load_version(process: Background, job: Job, load: Load) -> None:
    """Load a version in the background process, if it is not loaded.

    Raises:
        JobFailed: it cannot be loaded there.
    """
    try:
        # The new code may raise at the moment where an earlier job has left the process: then the env is rebuilt.
        await process.ensure(job, load, or_else=replace(load, level="rebuilt"))
    except JobFailed as failure:
        if failure.problem is None:
            raise
        raise JobFailed("the version could not be loaded to be checked", failure.problem) from failure


def _still_there(finding: Finding, source: Mapping[str, str] | None) -> bool:
    """Whether the line that it is about stands in this version; true where it is about none."""
    if source is None or finding.file is None or not finding.code:
        return True
    text = source.get(finding.file)
    return text is None or any(line.strip() == finding.code for line in text.splitlines())


def _version(load: Load) -> object:
    """The part of a load that results depend on."""
    return str(load.task), load.source, load.options.env_kwargs, load.options.rules
