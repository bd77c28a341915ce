"""Solves the open task from many seeds in separate processes, as ``workbench solve`` does, and keeps every episode."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from workbench.authoring.problem import Problem, TaskError
from workbench.jobs.pool.deal import Deal, ItemQueue, PoolError, Work
from workbench.jobs.pool.processes import Processes
from workbench.jobs.task import TaskOptions
from workbench.planning.options import PlanOptions
from workbench.planning.report import SolveReport, underway_text
from workbench.session.loop import Aside, on_loop, post
from workbench.session.process.jobs import Job, JobFailed, Jobs
from workbench.session.protocol.messages import Load

_NICENESS = 10
"""Niceness of the solving processes: the worker that plays comes first."""
SeedsState = Literal["none", "starting", "solving", "done", "stopped", "failed"]
RUNNING: tuple[SeedsState, ...] = ("starting", "solving")


@dataclass(frozen=True)
class SeedsView:
    """Results of the seeds so far."""

    state: SeedsState = "none"
    serial: int = 0
    """Grows with every change."""
    report: SolveReport | None = None
    """Report on the finished seeds; of an earlier version if `stale`."""
    total: int = 0
    """Seeds that were asked for."""
    done: float = 0.0
    """Finished seeds; a seed under way counts in part."""
    activity: str = ""
    """What is being done: the preparation before the first seed, or which seed is at which step."""
    stale: bool = False
    """Whether another version runs since."""
    why: str = ""
    """Why solving failed, as text."""
    problem: Problem | None = None
    """What the author's code raised."""


@dataclass(frozen=True)
class _Update:
    """An update from the other process."""

    activity: str = ""
    """New value of `SeedsView.activity`."""
    done: float | None = None
    """New value of `SeedsView.done`; None before the first seed."""
    report: SolveReport | None = None


@dataclass(frozen=True)
class _Setup:
    """What to solve, as fields of `jobs.solve.SolveOptions`, whose module the server cannot import."""

    task: str
    out: Path
    seeds: int
    workers: int
    plan: PlanOptions
    options: TaskOptions


class SeedsSolver:
    """Solves seeds 0 to N - 1 of the task's file as it is saved. All methods but `close` return at once."""

    def __init__(self, on_change: Callable[[], None], recordings: Path) -> None:
        """
        Args:
            on_change: called when `view` has changed.
            recordings: the folder for the episodes.
        """
        self._recordings, self._on_change = recordings.absolute(), on_change
        self.view = SeedsView()
        self._jobs = Jobs(on_change, self._failed)
        self._aside = Aside("solve-seeds")

    @on_loop
    def solve(self, load: Load, seeds: int, plan: PlanOptions) -> None:
        """Solve so many seeds; a running job ends, and keeps what is done.

        Args:
            load: loads the running version.
        """
        if not isinstance(load.task, str):
            # Only the texts of a recording's task were cleared, not the file that bears its name.
            self._set(state="failed", why="this task comes from a recording: open its file to solve it")
            return
        workers = max(1, min(seeds, len(os.sched_getaffinity(0)) // 2))
        setup = _Setup(load.task, self._recordings, seeds, workers, plan, replace(load.options, seed=0))
        self._jobs.start("solving seeds", lambda job: self._solve(job, setup))
        self._set(
            state="starting",
            report=None,
            total=seeds,
            done=0.0,
            activity="",
            stale=False,
            why="",
            problem=None,
        )

    @on_loop
    def loaded(self) -> None:
        """Another version runs: mark the results as those of an earlier version."""
        if self.view.report is not None:
            self._set(stale=True)

    @on_loop
    def stop(self) -> None:
        """End the job; finished seeds stay, with their recordings."""
        self._jobs.stop()
        if self.view.state in RUNNING:
            self._set(state="stopped", activity="")

    def close(self) -> None:
        """Stop; returns when the processes have ended. Called on another thread than the loop."""
        self.stop()
        self._aside.close()

    # --- the job -------------------------------------------------------------------------------------

    async def _solve(self, job: Job, setup: _Setup) -> None:
        await self._aside.run(lambda: self._run(job, setup))
        self._set(state="done", activity="")

    def _run(self, job: Job, setup: _Setup) -> None:
        """Run the job on its own thread."""
        if job.stopped:
            return
        work = Work(_run, setup, SolveReport, _Update, "that solves")

        def tell(news: _Update) -> None:
            post(lambda: job.stopped or self._take(news))

        deal: Deal[SolveReport, _Update] = Deal(
            range(1), lambda number, report: tell(_Update(report=report)), tell, lambda: job.stopped
        )
        try:
            Processes(1).run(work, deal)
        except TaskError as error:
            raise JobFailed("the task failed", error.problem) from error
        except OSError as error:
            raise JobFailed(f"no process could be started: {error}") from error
        except PoolError as error:
            raise JobFailed(str(error)) from error

    def _take(self, news: _Update) -> None:
        if news.report is not None:
            self._set(state="solving", report=news.report)
        elif news.done is not None:
            self._set(state="solving", done=news.done, activity=news.activity)
        else:
            self._set(activity=news.activity)

    def _failed(self, failure: JobFailed) -> None:
        self._set(state="failed", why=str(failure), problem=failure.problem, activity="")

    def _set(self, **values: Any) -> None:
        self.view = replace(self.view, serial=self.view.serial + 1, **values)
        self._on_change()


def _run(setup: _Setup, queue: ItemQueue) -> None:
    """Entry point of the other process, which starts the workers."""
    from workbench.jobs.record.solve import SolveOptions, solve

    if queue.next() is None:
        return
    os.nice(_NICENESS)
    # One seed at a time: a person looks at each as it is done.
    options = replace(setup.options, num_envs=1)
    what = SolveOptions(setup.task, setup.out, setup.seeds, setup.workers, plan=setup.plan, options=options)
    report = solve(
        what,
        on_activity=lambda activity: queue.send_update(_Update(activity)),
        on_progress=lambda now: queue.send_update(
            _Update(underway_text(now.by_seed(0), now.limit), now.done)
        ),
        stop=lambda: queue.limit() == 0,
        on_finding=lambda finding: None,
        on_report=lambda report: queue.send_update(_Update(report=report)),
    )
    queue.send_result(0, report)
