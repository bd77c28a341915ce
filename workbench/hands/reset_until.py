"""Searches the seeds for a first state that meets a condition, in the background process."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

from workbench.checks.state import load_version
from workbench.hands.commands import ResetUntil, StopResetUntil
from workbench.hands.resets import show_reset
from workbench.live.commands import MAX_SEED, PauseRun
from workbench.live.effects import Asked, Then
from workbench.live.events import VersionLoaded
from workbench.live.history.curves import Group, columns_by_label
from workbench.live.messages import Load, Reset
from workbench.live.pause_when import PauseWhen
from workbench.live.process.ask import Background
from workbench.live.process.background_jobs import Job, JobFailed, Jobs
from workbench.live.run import Run
from workbench.machine.loop import do
from workbench.page.command import Command, Refused
from workbench.task.problem import Problem

DOES: frozenset[type[Command]] = frozenset({ResetUntil, StopResetUntil})
"""Commands that `apply` handles."""
MAX_RESETS = 1000
"""Maximum number of resets of the whole batch."""


@dataclass(frozen=True)
class ResetSearch:
    """The search. Also the view of this feature."""

    state: Literal["none", "running", "found", "not found", "stopped", "failed"] = "none"
    condition: PauseWhen = PauseWhen()
    tried: int = 0
    """Number of first states that were tried, over all envs."""
    total: int = 0
    """Number of first states that are tried at most."""
    seed: int = 0
    """Seed of the last reset of the whole batch."""
    env: int = 0
    """The env that meets the condition, if one was found."""
    why: str = ""
    """Why the search failed, as text."""
    problem: Problem | None = None
    """The error that the author's code raised."""


@dataclass(frozen=True)
class ResetTried:
    """A reset of the whole batch."""

    seed: int
    num_envs: int
    met: tuple[int, ...]
    """The envs whose first state meets the condition."""


@dataclass(frozen=True)
class SearchFailed:
    """The job failed."""

    why: str
    problem: Problem | None


@dataclass(frozen=True)
class BeginSearch:
    """Reset this version with these seeds until a first state meets the condition; a running job is stopped."""

    load: Load
    seeds: range
    condition: PauseWhen
    joints: tuple[str, ...]


@dataclass(frozen=True)
class EndSearch:
    """Stop the job."""


SearchEvent = ResetTried | SearchFailed
SearchEffect = BeginSearch | EndSearch | Then
Change = tuple[ResetSearch, list[SearchEffect]]


def apply(search: ResetSearch, event: object, run: Run) -> Change:
    """The search after an event, and the effects to perform. A new version ends the search.

    Raises:
        Refused: the command makes no sense now.
    """
    running = search.state == "running"
    match event:
        case Asked(command=ResetUntil()):
            return _begin(search, run)
        case Asked(command=StopResetUntil()) | VersionLoaded() if running:
            return replace(search, state="stopped"), [EndSearch()]
        case VersionLoaded() if search.state != "none":
            return ResetSearch(), []
        case ResetTried() if running:
            return _tried(search, event, run)
        case SearchFailed(why=why, problem=problem) if running:
            return replace(search, state="failed", why=why, problem=problem), []
    return search, []


def _begin(search: ResetSearch, run: Run) -> Change:
    load, condition = run.running_load(), run.pause_when
    if load is None or run.task is None or run.step is None:
        raise Refused("No task is loaded yet.")
    if not condition.entry:
        raise Refused("Choose the condition first: Pause when, on the Run tab.")
    column = columns_by_label(run.step, run.task.joints).get(condition.entry)
    if column is not None and column.group in (Group.REWARD, Group.TERM):
        raise Refused(
            "A first state has no reward, because only a step computes it. Choose an entry of evaluate."
        )
    if column is not None and column.group is Group.FORCE:
        raise Refused(
            "A first state has no contact forces, because only a step finds contacts. Choose an entry of evaluate."
        )
    goes_on = search.condition == condition and search.state in ("stopped", "not found")
    last = search.seed if goes_on else run.seed
    seeds = range(last, MAX_SEED, run.num_envs)[1 : 1 + MAX_RESETS]
    if not seeds:
        raise Refused(f"No seed is left after {last}. Choose a smaller one.")
    search = ResetSearch("running", condition, total=len(seeds) * run.num_envs, seed=last)
    return search, [BeginSearch(load, seeds, condition, run.task.joints)]


def _tried(search: ResetSearch, event: ResetTried, run: Run) -> Change:
    search = replace(search, tried=search.tried + event.num_envs, seed=event.seed)
    if event.met:
        env = run.env if run.env in event.met else event.met[0]
        # Paused, or the first state would be gone before a person sees it.
        pause = [Then(Asked(PauseRun()))] if run.playing else []
        return replace(search, state="found", env=env), [*pause, *show_reset(run, event.seed, env)]
    return (replace(search, state="not found") if search.tried >= search.total else search), []


class SearchJobs:
    """Performs the effects: one job at a time, at the priority of jobs that a person waits for. Used on the
    loop, except `close`."""

    def __init__(self, process: Background, dispatch: Callable[[SearchEvent], object]) -> None:
        """
        Args:
            process: the background process in which a job runs.
            dispatch: handles the events of a job.
        """
        self._process, self._dispatch = process, dispatch
        self._jobs = Jobs(lambda: None, self._failed)

    def perform(self, effect: BeginSearch | EndSearch) -> None:
        match effect:
            case BeginSearch():
                self._jobs.start("reset until", partial(self._search, effect))
            case EndSearch():
                self._jobs.stop()

    def close(self) -> None:
        """Stop, and begin no more jobs. May be called on any thread."""
        do(self._jobs.close)

    async def _search(self, wanted: BeginSearch, job: Job) -> None:
        for seed in wanted.seeds:

            async def ask(seed: int = seed) -> tuple[int, tuple[int, ...]]:
                await load_version(self._process, job, wanted.load)
                step = await self._process.ask(Reset(None, seed))
                if wanted.condition.entry not in columns_by_label(step, wanted.joints):
                    raise JobFailed(f"a first state has no number {wanted.condition.entry}")
                envs = range(len(step.reward))
                return len(envs), tuple(
                    env for env in envs if wanted.condition.is_met(step, env, wanted.joints)
                )

            num_envs, met = await self._process.in_turns(job, ask)
            self._dispatch(ResetTried(seed, num_envs, met))
            if met:
                return

    def _failed(self, failure: JobFailed) -> None:
        self._dispatch(SearchFailed(str(failure), failure.problem))
