"""Solves the open task from many seeds in separate processes, like ``workbench solve``, and keeps every episode."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from workbench.checks.commands import ChooseSeeds, SolveSeeds, StopSolving
from workbench.jobs.local_processes import Processes
from workbench.jobs.scheduler import ItemQueue, PoolError, Scheduler, Work
from workbench.live.effects import Asked
from workbench.live.events import VersionLoaded
from workbench.live.process.background_jobs import Job, JobFailed, Jobs
from workbench.live.run import Run
from workbench.machine.loop import BlockingPool, do, post
from workbench.page.command import Command, Refused
from workbench.planning.options import PlanOptions
from workbench.planning.seeds_report import SolveReport, underway_text
from workbench.planning.verdicts import MIN_SEEDS
from workbench.task.description import TaskOptions
from workbench.task.problem import Problem, TaskError

_NICENESS = 10
"""Niceness of the solving processes: the worker that plays has priority."""
DOES: frozenset[type[Command]] = frozenset({ChooseSeeds, SolveSeeds, StopSolving})
"""Commands that `apply` handles."""
SeedsState = Literal["none", "starting", "solving", "done", "stopped", "failed"]
RUNNING: tuple[SeedsState, ...] = ("starting", "solving")


@dataclass(frozen=True)
class SeedsView:
    """Results of the seeds so far."""

    state: SeedsState = "none"
    serial: int = 0
    """Increases with every change."""
    report: SolveReport | None = None
    """Report on the finished seeds; of an earlier version if `stale`."""
    total: int = 0
    """Number of requested seeds."""
    done: float = 0.0
    """Number of finished seeds; a running seed counts in part."""
    activity: str = ""
    """Text: the preparation before the first seed, or the current seed and step."""
    stale: bool = False
    """Whether another version has been loaded since."""
    why: str = ""
    """Why solving failed, as text."""
    problem: Problem | None = None
    """The error that the author's code raised."""
    chosen: int = MIN_SEEDS
    """Number of seeds that the user chose to solve next."""


# --- events and effects -----------------------------------------------------------------------------


@dataclass(frozen=True)
class SeedsUpdate:
    """An update from the solving process."""

    activity: str = ""
    """New value of `SeedsView.activity`."""
    done: float | None = None
    """New value of `SeedsView.done`; None before the first seed."""
    report: SolveReport | None = None


@dataclass(frozen=True)
class SeedsDone:
    """All seeds were tried."""


@dataclass(frozen=True)
class SeedsFailed:
    """The job failed."""

    why: str
    problem: Problem | None


@dataclass(frozen=True)
class BeginSeeds:
    """Solve seeds 0 to `seeds` - 1; a running job is stopped."""

    task: str
    options: TaskOptions
    seeds: int
    plan: PlanOptions


@dataclass(frozen=True)
class EndSeeds:
    """Stop the job."""


SeedsEvent = SeedsUpdate | SeedsDone | SeedsFailed
SeedsEffect = BeginSeeds | EndSeeds
Change = tuple[SeedsView, list[SeedsEffect]]
"""The results after an event, and the effects to perform."""


def apply(view: SeedsView, event: object, run: Run) -> Change:
    """The results after an event, and the effects to perform.

    Args:
        run: the run after the event.

    Raises:
        Refused: the command makes no sense now.
    """
    running = view.state in RUNNING
    match event:
        case Asked(command=ChooseSeeds(seeds=seeds)):
            return _changed(view, chosen=seeds), []
        case Asked(command=SolveSeeds()):
            return _solve(view, run)
        case Asked(command=StopSolving()) if running:
            return _changed(view, state="stopped", activity=""), [EndSeeds()]
        case VersionLoaded() if view.report is not None:
            return _changed(view, stale=True), []
        case SeedsUpdate() if running:
            return _take(view, event), []
        case SeedsDone() if running:
            return _changed(view, state="done", activity=""), []
        case SeedsFailed(why=why, problem=problem) if running:
            return _changed(view, state="failed", why=why, problem=problem, activity=""), []
    return view, []


def _solve(view: SeedsView, run: Run) -> Change:
    if (load := run.running_load()) is None:
        raise Refused("No task is loaded yet.")
    if not isinstance(load.task, str):
        # The user allowed the recorded source of this task to run, not the file of the same name.
        why = "This task comes from a recording. To solve seeds, open the task's file."
        return _changed(view, state="failed", why=why), [EndSeeds()] if view.state in RUNNING else []
    begun = SeedsView("starting", view.serial + 1, total=view.chosen, chosen=view.chosen)
    return begun, [BeginSeeds(load.task, load.options, view.chosen, run.settings.plan)]


def _take(view: SeedsView, update: SeedsUpdate) -> SeedsView:
    if update.report is not None:
        return _changed(view, state="solving", report=update.report)
    if update.done is not None:
        return _changed(view, state="solving", done=update.done, activity=update.activity)
    return _changed(view, activity=update.activity)


def _changed(view: SeedsView, **values: Any) -> SeedsView:
    return replace(view, serial=view.serial + 1, **values)


@dataclass(frozen=True)
class _Setup:
    """Some fields of `solve.job.SolveOptions`, whose module the server cannot import."""

    task: str
    out: Path
    seeds: int
    workers: int
    plan: PlanOptions
    options: TaskOptions


class SeedsJobs:
    """Performs the effects: one job at a time. Used on the loop, except `close`."""

    def __init__(self, recordings: Path, dispatch: Callable[[SeedsEvent], object]) -> None:
        """
        Args:
            recordings: the folder for the episodes.
            dispatch: handles the resulting events.
        """
        self._recordings, self._dispatch = recordings.absolute(), dispatch
        self._jobs = Jobs(lambda: None, self._failed)
        self._aside = BlockingPool("solve-seeds")

    def perform(self, effect: SeedsEffect) -> None:
        match effect:
            case BeginSeeds(task=task, options=options, seeds=seeds, plan=plan):
                workers = max(1, min(seeds, len(os.sched_getaffinity(0)) // 2))
                setup = _Setup(task, self._recordings, seeds, workers, plan, replace(options, seed=0))
                self._jobs.start("solving seeds", lambda job: self._solve(job, setup))
            case EndSeeds():
                self._jobs.stop()

    def close(self) -> None:
        """Stop; returns when the processes have ended. Called on another thread than the loop."""
        do(self._jobs.stop)
        self._aside.close()

    async def _solve(self, job: Job, setup: _Setup) -> None:
        await self._aside.run(lambda: self._run(job, setup))
        self._dispatch(SeedsDone())

    def _run(self, job: Job, setup: _Setup) -> None:
        """Run the job on its own thread."""
        if job.stopped:
            return
        work = Work(_run, setup, SolveReport, SeedsUpdate, "that solves")

        def send_update(update: SeedsUpdate) -> None:
            post(lambda: job.stopped or self._dispatch(update))

        deal: Scheduler[SolveReport, SeedsUpdate] = Scheduler(
            range(1),
            lambda number, report: send_update(SeedsUpdate(report=report)),
            send_update,
            lambda: job.stopped,
        )
        try:
            Processes(1).run(work, deal)
        except TaskError as error:
            raise JobFailed("the task failed", error.problem) from error
        except OSError as error:
            raise JobFailed(f"no process could be started: {error}") from error
        except PoolError as error:
            raise JobFailed(str(error)) from error

    def _failed(self, failure: JobFailed) -> None:
        self._dispatch(SeedsFailed(str(failure), failure.problem))


def _run(setup: _Setup, queue: ItemQueue) -> None:
    """Entry point of the solving process, which starts the workers."""
    from workbench.solve.job import SolveOptions, solve

    if queue.next() is None:
        return
    os.nice(_NICENESS)
    # Each worker solves one seed at a time, so that each result is shown as soon as possible.
    options = replace(setup.options, num_envs=1)
    what = SolveOptions(setup.task, setup.out, setup.seeds, setup.workers, plan=setup.plan, options=options)
    report = solve(
        what,
        on_activity=lambda activity: queue.send_update(SeedsUpdate(activity)),
        on_progress=lambda now: queue.send_update(
            SeedsUpdate(underway_text(now.by_seed(0), now.limit), now.done)
        ),
        stop=lambda: queue.limit() == 0,
        on_finding=lambda finding: None,
        on_report=lambda report: queue.send_update(SeedsUpdate(report=report)),
    )
    queue.send_result(0, report)
