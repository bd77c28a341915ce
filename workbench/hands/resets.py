"""Samples where resets put the bodies, in the background process."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from workbench.checks.state import load_version
from workbench.hands.commands import HideResets, SampleResets
from workbench.live.effects import Asked
from workbench.live.events import VersionLoaded
from workbench.live.messages import Load, Reset
from workbench.live.process.ask import Background
from workbench.live.process.background_jobs import Job, JobFailed, Jobs
from workbench.live.run import Run
from workbench.machine.loop import do
from workbench.page.command import Command, Refused
from workbench.task.problem import Problem

DOES: frozenset[type[Command]] = frozenset({SampleResets, HideResets})
"""Commands that `apply` handles."""
MIN_EPISODES = 128
"""Minimum number of sampled episodes, over all envs."""
MAX_BATCHES = 64
"""Maximum number of resets of the whole batch."""


@dataclass(frozen=True)
class ResetCloud:
    """First poses of the bodies after resets with different seeds. Also the view of this feature."""

    state: Literal["none", "running", "done", "failed"] = "none"
    serial: int = 0
    """Grows with every change."""
    seeds: tuple[int, ...] = ()
    """Seed of each reset of the whole batch so far."""
    poses: tuple[NDArray[np.float32], ...] = ()
    """(N, B, 7) after each of these resets, as in `StepResult.poses`."""
    total: int = 0
    """Number of resets when the job is done."""
    why: str = ""
    """Why the job failed, as text."""
    problem: Problem | None = None
    """The error that the author's code raised."""

    def of(self, body: int) -> NDArray[np.float32]:
        """(S, N, 7) poses of one body; NaN in envs that lack the body."""
        if not self.poses:
            return np.zeros((0, 0, 7), np.float32)
        return np.stack([poses[:, body] for poses in self.poses])


@dataclass(frozen=True)
class ResetSampled:
    """A reset of the whole batch."""

    seed: int
    poses: NDArray[np.float32]
    """(N, B, 7)"""


@dataclass(frozen=True)
class SamplingFailed:
    """The job failed."""

    why: str
    problem: Problem | None


@dataclass(frozen=True)
class BeginSampling:
    """Reset this version with these seeds; a running job is stopped."""

    load: Load
    seeds: tuple[int, ...]


@dataclass(frozen=True)
class EndSampling:
    """Stop the job."""


ResetsEvent = ResetSampled | SamplingFailed
ResetsEffect = BeginSampling | EndSampling
Change = tuple[ResetCloud, list[ResetsEffect]]


def apply(cloud: ResetCloud, event: object, run: Run) -> Change:
    """The cloud after an event, and the effects to perform. A new version is sampled again.

    Raises:
        Refused: the command makes no sense now.
    """
    match event:
        case Asked(command=SampleResets()):
            return _begin(cloud, run)
        case Asked(command=HideResets()):
            return ResetCloud(serial=cloud.serial + 1), [EndSampling()]
        case VersionLoaded() if cloud.state != "none":
            return _begin(cloud, run)
        case ResetSampled(seed=seed, poses=poses) if cloud.state == "running":
            seeds = (*cloud.seeds, seed)
            state = "done" if len(seeds) == cloud.total else "running"
            sampled = replace(cloud, state=state, seeds=seeds, poses=(*cloud.poses, poses))
            return replace(sampled, serial=cloud.serial + 1), []
        case SamplingFailed(why=why, problem=problem) if cloud.state == "running":
            return replace(cloud, state="failed", serial=cloud.serial + 1, why=why, problem=problem), []
    return cloud, []


def _begin(cloud: ResetCloud, run: Run) -> Change:
    load = run.running_load()
    if load is None:
        raise Refused("No task is loaded yet.")
    batches = min(MAX_BATCHES, math.ceil(MIN_EPISODES / run.num_envs))
    # A reset with one of these seeds repeats its episodes, so that a click on a point can show its reset.
    seeds = tuple(run.seed + batch * run.num_envs for batch in range(batches))
    return ResetCloud("running", cloud.serial + 1, total=batches), [BeginSampling(load, seeds)]


class ResetJobs:
    """Performs the effects: one job at a time, at the priority of jobs that a person waits for. Used on the
    loop, except `close`."""

    def __init__(self, process: Background, happen: Callable[[ResetsEvent], object]) -> None:
        """
        Args:
            process: the background process in which a job runs.
            happen: handles the events of a job.
        """
        self._process, self._happen = process, happen
        self._jobs = Jobs(lambda: None, self._failed)

    def perform(self, effect: ResetsEffect) -> None:
        match effect:
            case BeginSampling(load=load, seeds=seeds):
                self._jobs.start("resets", lambda job: self._sample(job, load, seeds))
            case EndSampling():
                self._jobs.stop()

    def close(self) -> None:
        """Stop, and begin no more jobs. May be called on any thread."""
        do(self._jobs.close)

    async def _sample(self, job: Job, load: Load, seeds: tuple[int, ...]) -> None:
        for seed in seeds:

            async def ask(seed: int = seed) -> NDArray[np.float32]:
                await load_version(self._process, job, load)
                return (await self._process.ask(Reset(None, seed))).poses

            self._happen(ResetSampled(seed, await self._process.in_turns(job, ask)))

    def _failed(self, failure: JobFailed) -> None:
        self._happen(SamplingFailed(str(failure), failure.problem))
