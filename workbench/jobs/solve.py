"""Solves a task from many seeds by planning, and says what that tells of its reward."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median

from workbench.core.broken_rule import warn_of
from workbench.core.rules import Finding
from workbench.jobs.actions import SOLVE
from workbench.jobs.pool import Executor
from workbench.jobs.record import RecordOptions, RecordProgress, record
from workbench.jobs.task import TaskOptions
from workbench.planning.episodes import PlannedEpisode
from workbench.planning.options import PlanOptions
from workbench.planning.verdicts import Verdict, in_the_way, of_episodes

_AFTER_SUCCESS = 5
"""Control steps that an episode goes on after its success: does it stay solved?"""


@dataclass(frozen=True)
class SolveOptions:
    """What to solve, and how."""

    task: str
    """As `RecordArguments.task`."""
    out: Path = Path("recordings")
    seeds: int = 32
    """How many, from ``options.seed`` on."""
    workers: int = 1
    """Processes, each with a live env; the result is the same with any number."""
    pictures: bool = False
    max_steps: int | None = None
    """As `RecordArguments.max_steps`."""
    plan: PlanOptions = PlanOptions()
    options: TaskOptions = field(default_factory=TaskOptions)
    """Its number of envs counts for nothing: each process has one."""

    def recording(self) -> RecordOptions:
        """The recording that solves it."""
        return RecordOptions(
            self.task,
            self.out,
            episodes=self.seeds,
            actions=SOLVE,
            pictures=self.pictures,
            max_steps=self.max_steps,
            workers=self.workers,
            options=TaskOptions(**{**vars(self.options), "num_envs": self.workers}),
            plan=self.plan,
            after_success=_AFTER_SUCCESS,
        )


@dataclass(frozen=True)
class SolvedSeed:
    """What came of one seed."""

    seed: int
    solved_at: int
    """The control step of its success, from 1 on; 0 without one."""
    steps: int
    total_reward: float
    """Over all steps, those after its success too."""
    seconds: float
    """Wall time of its plans."""
    in_the_way: str
    """Why it was not solved; empty if it was."""
    path: Path
    """Its recording."""


@dataclass(frozen=True)
class SolveReport:
    """What came of all seeds that were tried to the end."""

    seeds: tuple[SolvedSeed, ...]
    verdicts: tuple[Verdict, ...]
    seconds: float
    """Wall time, opening the task included."""
    stopped: bool
    """It was stopped before all seeds were tried."""

    @property
    def solved(self) -> tuple[SolvedSeed, ...]:
        return tuple(one for one in self.seeds if one.solved_at)

    @property
    def median_steps(self) -> float | None:
        """Of the solved seeds, to their success; None without one."""
        return median(one.solved_at for one in self.solved) if self.solved else None

    @property
    def fails(self) -> bool:
        """Whether the reward breaks a rule, or no seed was solved."""
        return bool(self.verdicts) or not self.solved


def solve(
    what: SolveOptions,
    on_activity: Callable[[str], None] = lambda activity: None,
    on_progress: Callable[[RecordProgress], None] = lambda progress: None,
    stop: Callable[[], bool] = lambda: False,
    on_finding: Callable[[Finding], None] = warn_of,
    executor: Executor | None = None,
) -> SolveReport:
    """Solve, recording every episode; arguments and errors as of `record`."""
    began = time.monotonic()
    recorded = record(what.recording(), on_activity, on_progress, stop, on_finding, executor)
    planned: list[PlannedEpisode] = []
    for written in recorded.written:
        assert written.planned is not None
        planned.append(written.planned)
    rows = [
        SolvedSeed(
            written.seed,
            episode.solved_at,
            written.steps,
            written.total_reward,
            episode.plan_seconds,
            in_the_way(episode, planned),
            written.path,
        )
        for written, episode in zip(recorded.written, planned, strict=True)
    ]
    return SolveReport(tuple(rows), tuple(of_episodes(planned)), time.monotonic() - began, recorded.stopped)
