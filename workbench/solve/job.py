"""Solves a task from many seeds by planning, and reports what the results show about its reward."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from workbench.actions.choose import SOLVE
from workbench.envs.broken_rule import warn_of
from workbench.envs.gpu_rules import Finding
from workbench.jobs.scheduler import Executor, Failure
from workbench.planning.options import PlanOptions
from workbench.planning.planned_episodes import PlannedEpisode
from workbench.planning.seeds_report import SolvedSeed, SolveReport
from workbench.planning.verdicts import in_the_way, of_episodes
from workbench.record.job import Recorded, RecordProgress, record
from workbench.record.job_worker import RecordOptions, Written
from workbench.task.description import TaskOptions

_STEPS_AFTER_SUCCESS = 5
"""Number of control steps that an episode continues after its success, to check that it stays solved."""


@dataclass(frozen=True)
class SolveOptions:
    """Options of solving a task."""

    task: str
    """Reference of the task; see `RecordArguments.task`."""
    out: Path = Path("recordings")
    seeds: int = 32
    """Number of seeds, from ``options.seed`` on."""
    workers: int = 1
    """Number of processes, each with a live env, if no executor is given; it does not change the result."""
    pictures: bool = False
    max_steps: int | None = None
    """Maximum number of control steps of an episode; see `RecordArguments.max_steps`."""
    plan: PlanOptions = PlanOptions()
    options: TaskOptions = field(default_factory=lambda: TaskOptions(num_envs=1))
    """Options of the task. The number of envs is the number of seeds that each process solves at once; a seed's result does
    not depend on it."""
    seconds_per_seed: float | None = None
    """Wall time in seconds after which an episode ends at its next step; see `RecordArguments.seconds_per_seed`."""
    upload: str = ""
    """Address to which episodes are uploaded; see `RecordArguments.upload`."""

    def recording(self) -> RecordOptions:
        """Options of the recording that solves the task."""
        return RecordOptions(
            self.task,
            self.out,
            episodes=self.seeds,
            actions=SOLVE,
            pictures=self.pictures,
            max_steps=self.max_steps,
            seconds_per_seed=self.seconds_per_seed,
            upload=self.upload,
            workers=self.workers,
            options=self.options,
            plan=self.plan,
            after_success=_STEPS_AFTER_SUCCESS,
        )


def solve(
    what: SolveOptions,
    on_activity: Callable[[str], None] = lambda activity: None,
    on_progress: Callable[[RecordProgress], None] = lambda progress: None,
    stop: Callable[[], bool] = lambda: False,
    on_finding: Callable[[Finding], None] = warn_of,
    executor: Executor | None = None,
    on_report: Callable[[SolveReport], None] = lambda report: None,
    run: str = "",
    on_failures: Callable[[Sequence[Failure]], None] = lambda failures: None,
    on_notice: Callable[[str], None] = lambda notice: None,
) -> SolveReport:
    """Solve the task from each seed and record every episode.

    For other arguments and errors see `record`.

    Args:
        on_report: called after each seed with the report so far.
        on_failures: called at the end with the seeds without a result, if there are any.
    """
    began = time.monotonic()
    done: dict[int, Written] = {}

    def noted(progress: RecordProgress) -> None:
        on_progress(progress)
        if progress.over is not None and progress.over[1] is not None:
            done[progress.over[0]] = progress.over[1]
            so_far = [done[number] for number in sorted(done)]
            on_report(_report(what, so_far, time.monotonic() - began, stopped=False))

    recorded = record(what.recording(), on_activity, noted, stop, on_finding, executor, run, on_notice)
    if recorded.failures:
        on_failures(recorded.failures)
    return report_of(what, recorded, time.monotonic() - began)


def report_of(what: SolveOptions, recorded: Recorded, seconds: float) -> SolveReport:
    """Report of a recording of planned episodes."""
    return _report(what, recorded.written, seconds, recorded.stopped)


def _report(what: SolveOptions, recorded: Sequence[Written], seconds: float, stopped: bool) -> SolveReport:
    planned: list[PlannedEpisode] = []
    for written in recorded:
        assert written.planned is not None
        planned.append(written.planned)
    totals = [total for written in recorded if (total := written.total_reward) is not None]
    rows = [
        SolvedSeed(
            written.seed,
            episode.solved_at,
            written.steps,
            total,
            episode.plan_seconds,
            in_the_way(episode, planned),
            written.path,
            episode.cut_off,
        )
        for written, episode, total in zip(recorded, planned, totals, strict=True)
    ]
    report = SolveReport(tuple(rows), (), seconds, stopped, what.seeds)
    return replace(report, verdicts=tuple(of_episodes(planned))) if report.has_enough_seeds else report
