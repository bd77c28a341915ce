"""Samples where resets put the bodies, in the background process."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from workbench.checks.state import load_version
from workbench.hands.commands import HideResets, SampleResets, ShowReset
from workbench.hands.questions import FirstStates, SampleReset
from workbench.live.commands import SetSeed
from workbench.live.effects import Asked, Then
from workbench.live.env_commands import SelectEnv
from workbench.live.events import VersionLoaded
from workbench.live.messages import Load
from workbench.live.process.ask import Background
from workbench.live.process.background_jobs import Job, JobFailed, Jobs
from workbench.live.run import Run
from workbench.machine.loop import do
from workbench.page.command import Command, Refused
from workbench.task.problem import Problem

DOES: frozenset[type[Command]] = frozenset({SampleResets, HideResets, ShowReset})
"""Commands that `apply` handles."""
MIN_EPISODES = 128
"""Minimum number of sampled episodes, over all envs."""
MAX_BATCHES = 64
"""Maximum number of resets of the whole batch."""


@dataclass(frozen=True)
class ResetCloud:
    """First states after resets with different seeds. Also the view of this feature."""

    state: Literal["none", "running", "done", "failed"] = "none"
    serial: int = 0
    """Grows with every change."""
    seeds: tuple[int, ...] = ()
    """Seed of each reset of the whole batch so far."""
    states: tuple[FirstStates, ...] = ()
    """The states after each of these resets."""
    total: int = 0
    """Number of resets when the job is done."""
    why: str = ""
    """Why the job failed, as text."""
    problem: Problem | None = None
    """The error that the author's code raised."""

    def of(self, body: int) -> NDArray[np.float32]:
        """(S, N, 7) poses of one body; NaN in envs that lack the body."""
        if not self.states:
            return np.zeros((0, 0, 7), np.float32)
        return np.stack([states.poses[:, body] for states in self.states])

    def knows_overlaps(self) -> bool:
        return all(states.overlaps is not None for states in self.states)

    def overlaps(self, body: str) -> dict[str, NDArray[np.float64]]:
        """Depths (S, N) in metres to which each other body is inside this one, by name, the most frequent one first; 0
        where they do not overlap."""
        found: dict[str, NDArray[np.float64]] = {}
        for batch, states in enumerate(self.states):
            for env, overlaps in enumerate(states.overlaps or ()):
                for overlap in overlaps:
                    if body in overlap.bodies:
                        first, second = overlap.bodies
                        shape = len(self.states), len(states.poses)
                        other = second if body == first else first
                        found.setdefault(other, np.zeros(shape))[batch, env] = overlap.depth
        return dict(sorted(found.items(), key=lambda item: -np.count_nonzero(item[1])))

    def out_of_reach(self, body: int) -> NDArray[np.bool_] | None:
        """(S, N) whether no arm reaches the body; None if that is not known of this body."""
        rows = [
            states.out_of_reach[:, states.reach_of.index(body)]
            for states in self.states
            if states.out_of_reach is not None and body in states.reach_of
        ]
        return np.stack(rows) if rows else None


@dataclass(frozen=True)
class ResetSampled:
    """A reset of the whole batch."""

    seed: int
    states: FirstStates


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
ResetsEffect = BeginSampling | EndSampling | Then
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
        case Asked(command=ShowReset(seed=seed, env=env)):
            return cloud, [*show_reset(run, seed, env)]
        case VersionLoaded() if cloud.state != "none":
            return _begin(cloud, run)
        case ResetSampled(seed=seed, states=states) if cloud.state == "running":
            seeds = (*cloud.seeds, seed)
            stage = "done" if len(seeds) == cloud.total else "running"
            sampled = replace(cloud, state=stage, seeds=seeds, states=(*cloud.states, states))
            return replace(sampled, serial=cloud.serial + 1), []
        case SamplingFailed(why=why, problem=problem) if cloud.state == "running":
            return replace(cloud, state="failed", serial=cloud.serial + 1, why=why, problem=problem), []
    return cloud, []


def show_reset(run: Run, seed: int, env: int) -> list[Then]:
    """Effects that select an env and reset all envs with this seed. Raises `Refused` if there is no such env."""
    if env >= run.num_envs:
        raise Refused(f"There is no env {env}: the envs are 0 to {run.num_envs - 1}.")
    return [Then(Asked(SelectEnv(env=env))), Then(Asked(SetSeed(seed=seed)))]


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

    def __init__(self, process: Background, dispatch: Callable[[ResetsEvent], object]) -> None:
        """
        Args:
            process: the background process in which a job runs.
            dispatch: handles the events of a job.
        """
        self._process, self._dispatch = process, dispatch
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

            async def ask(seed: int = seed) -> FirstStates:
                await load_version(self._process, job, load)
                return await self._process.ask(SampleReset(seed))

            self._dispatch(ResetSampled(seed, await self._process.in_turns(job, ask)))

    def _failed(self, failure: JobFailed) -> None:
        self._dispatch(SamplingFailed(str(failure), failure.problem))
