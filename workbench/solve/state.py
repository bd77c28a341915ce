"""Plans the actions of the live envs in a separate process, for the source of actions *solve*."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from workbench.checks.state import load_version
from workbench.envs.step_result import StepResult
from workbench.live.commands import PauseRun
from workbench.live.effects import Asked, Then
from workbench.live.events import FileSaved, Send, SettingsChanged, WorkerDied
from workbench.live.messages import FollowPlan, Load, PlanDropped, PlanWanted
from workbench.live.process.ask import Background
from workbench.live.process.background_jobs import Job, JobFailed, Jobs
from workbench.live.run import Run, movable_bodies
from workbench.machine.loop import do
from workbench.page.command import Command, Refused
from workbench.planning.options import PlanOptions
from workbench.solve.commands import (
    ChooseMethod,
    ChoosePlannedEnvs,
    FollowBody,
    SetHorizon,
    SetNoise,
    SetPlanEvery,
    SetRollouts,
    SetTemperature,
)
from workbench.solve.questions import PlanActions, Planned, PlannedEnv
from workbench.task.description import Stepped
from workbench.task.problem import Problem

_NICENESS = 5
"""Niceness of the planning process: between the worker that plays and background work."""
_NOTHING = np.zeros(0, np.float32)
_NEW_PLAN = ChooseMethod, SetRollouts, SetHorizon, SetNoise, SetTemperature, SetPlanEvery
DOES: frozenset[type[Command]] = frozenset({ChoosePlannedEnvs, FollowBody, *_NEW_PLAN})
"""Commands that `apply` handles."""


SolveState = Literal["none", "starting", "planning", "failed"]


@dataclass(frozen=True)
class SolveView:
    """The plans of one env, and the course of its episode so far."""

    state: SolveState = "none"
    """``starting``: the envs of the rollouts are being built; ``failed``: see `why`."""
    serial: int = 0
    """Increases with every change."""
    activity: str = ""
    """Text: current work while starting."""
    why: str = ""
    """Why there is no plan, as text."""
    problem: Problem | None = None
    """The error that the author's code raised in a rollout."""
    plan: PlannedEnv | None = None
    """The last plan of the env."""
    plan_step: int = 0
    """Control step of the episode for which the plan was made, from 0."""
    predicted: NDArray[np.float32] = field(default_factory=lambda: _NOTHING)
    """(T,) For each step of the episode: mean reward per step over the horizon that begins there, as the best rollout
    predicted it; NaN where nothing was planned."""
    achieved: NDArray[np.float32] = field(default_factory=lambda: _NOTHING)
    """(T,) For each step: achieved mean reward per step over the same horizon, or over the part of it that
    has passed; NaN for steps to come."""
    begins: int = 0
    """Control step of the episode at which `predicted` and `achieved` begin."""
    solved_at: int = 0
    """Step of the episode's first success, from 1; 0 without success."""
    solved: tuple[tuple[int, int], ...] = ()
    """Env and step of every env whose episode is solved."""
    steps_per_second: float = 0.0
    """Env-steps of rollouts per second in the last plan, including restoring and planning."""


@dataclass(frozen=True)
class RunningEpisode:
    """The running episode of an env."""

    begins: int = 0
    """Number of control steps of the env's episode before the first one that is kept here."""
    rewards: tuple[float, ...] = ()
    predicted: Mapping[int, float] = field(default_factory=dict)
    """Predicted mean reward per step over the horizon that begins at a step, by the index of the step in
    `rewards`."""
    horizon: int = 1
    plan: PlannedEnv | None = None
    plan_step: int = 0
    solved_at: int = 0
    rate: float = 0.0


@dataclass(frozen=True)
class Solving:
    """State of planning."""

    shared: SolveView = SolveView()
    """The view without the fields of a single env."""
    episodes: Mapping[int, RunningEpisode] = field(default_factory=dict)
    """Running episodes by env."""

    @property
    def solved(self) -> tuple[int, ...]:
        """Envs whose episode is solved."""
        return tuple(env for env, episode in sorted(self.episodes.items()) if episode.solved_at)

    def view(self, env: int) -> SolveView:
        """The view of this env."""
        episode = self.episodes.get(env, RunningEpisode())
        predicted, achieved = _curves(episode)
        return replace(
            self.shared,
            plan=episode.plan,
            plan_step=episode.plan_step,
            predicted=predicted,
            achieved=achieved,
            begins=episode.begins,
            solved_at=episode.solved_at,
            solved=tuple((e, self.episodes[e].solved_at) for e in self.solved),
            steps_per_second=episode.rate,
        )


# --- events and effects -----------------------------------------------------------------------------


@dataclass(frozen=True)
class RolloutsStart:
    """The planning process must first load the version and build the rollouts' envs."""


@dataclass(frozen=True)
class PlanActivity:
    """The current work of the job."""

    activity: str


@dataclass(frozen=True)
class PlanMade:
    """The job has its result."""

    wanted: PlanWanted
    envs: tuple[PlannedEnv, ...]
    steps_per_second: float
    """Env-steps of rollouts per second."""


@dataclass(frozen=True)
class PlanFailed:
    """The job failed."""

    why: str
    problem: Problem | None


@dataclass(frozen=True)
class BeginPlan:
    """Plan for this request; a running job is stopped."""

    wanted: PlanWanted
    load: Load
    """The load of the running version with one env."""
    options: PlanOptions
    traced: str
    """The body to trace."""


@dataclass(frozen=True)
class EndPlan:
    """Stop the job."""


SolverEvent = RolloutsStart | PlanActivity | PlanMade | PlanFailed
SolverEffect = BeginPlan | EndPlan
Change = tuple[Solving, list[SolverEffect | Then | Send]]
"""The plans after an event, and the effects to perform."""


def apply(solving: Solving, event: object, run: Run) -> Change:
    """The plans after an event, and the effects to perform. The last plan stays visible when planning ends.

    Args:
        run: the run after the event.
    """
    state = solving.shared.state
    runs = state in ("starting", "planning")
    match event:
        case PlanWanted() if (load := run.running_load()) is not None:
            if event.why_not:
                refused, asks = _refuse(solving, event.why_not, None)
                return refused, [EndPlan(), *asks] if runs else asks
            # One env of the task is enough to build the rollouts' envs, and its seed does not matter.
            alone = replace(load, options=replace(load.options, num_envs=1, seed=0))
            settings = run.settings
            begun = _changed(solving, state="planning", activity="", why="", problem=None)
            return begun, [BeginPlan(event, alone, settings.plan, settings.traced)]
        case PlanDropped() | FileSaved() | WorkerDied() if runs:
            return _changed(solving, state="none", activity=""), [EndPlan()]
        case Asked(command=ChoosePlannedEnvs(envs=chosen)):
            return solving, [_set(solve_all=chosen == "all")]
        case Asked(command=FollowBody(body=body)):
            if body and body not in movable_bodies(run.task):
                raise Refused("There is no movable body of this name.")
            return solving, [_set(traced=body)]
        case Asked(command=command) if isinstance(command, _NEW_PLAN):
            plan = replace(run.settings.plan, **msgspec.structs.asdict(command))
            return solving, [_set(plan=plan)]
        case Stepped():
            return _stepped(solving, event, run.settings.action_source == "solve"), []
        case RolloutsStart() if runs:
            return _changed(solving, state="starting"), []
        case PlanActivity(activity=activity) if state == "starting":
            return _changed(solving, activity=activity), []
        case PlanMade(wanted=wanted, envs=envs) if runs:
            follow = FollowPlan(wanted.number, wanted.env_idx, np.stack([one.actions for one in envs], 1))
            return _planned(solving, event), [Send(follow)]
        case PlanFailed(why=why, problem=problem) if runs:
            return _refuse(solving, why, problem)
    return solving, []


def _set(**settings: Any) -> Then:
    return Then(SettingsChanged(settings))


def _refuse(solving: Solving, why: str, problem: Problem | None) -> Change:
    """Pause the worker that plays, since there is no plan."""
    return _changed(solving, state="failed", activity="", why=why, problem=problem), [Then(Asked(PauseRun()))]


def _planned(solving: Solving, made: PlanMade) -> Solving:
    episodes = dict(solving.episodes)
    for one in made.envs:
        episode = episodes.get(one.env, RunningEpisode())
        place = len(episode.rewards)
        episodes[one.env] = replace(
            episode,
            plan=one,
            horizon=one.horizon,
            plan_step=episode.begins + place,
            predicted={**episode.predicted, place: float(one.returns[0]) / one.horizon},
            rate=made.steps_per_second,
        )
    return _changed(replace(solving, episodes=episodes), state="planning", activity="")


def _stepped(solving: Solving, event: Stepped, planned: bool) -> Solving:
    """Record a step of the worker that plays.

    Args:
        planned: whether the source of its actions is *solve*.
    """
    if not planned and not solving.episodes:
        return solving
    episodes: dict[int, RunningEpisode] = {}
    for env, jumped in enumerate(event.reset_mask if planned else ()):
        known = None if jumped else solving.episodes.get(env)
        episodes[env] = _noted(known, env, event.step)
    return _changed(replace(solving, episodes=episodes))


def _noted(episode: RunningEpisode | None, env: int, step: StepResult) -> RunningEpisode:
    elapsed = int(step.elapsed_steps[env])
    if episode is None:
        return RunningEpisode(elapsed)
    solved_at, success = episode.solved_at, step.evaluate.get("success")
    if success is not None and bool(np.all(success[env])) and not solved_at:
        solved_at = elapsed
    return replace(episode, rewards=(*episode.rewards, float(step.reward[env])), solved_at=solved_at)


def _changed(solving: Solving, **values: Any) -> Solving:
    shared = solving.shared
    return replace(solving, shared=replace(shared, serial=shared.serial + 1, **values))


class PlanJobs:
    """Performs the effects: one plan at a time. Used on the loop, except `close`.

    A separate process loads the same version of the task and runs the rollouts on its own envs. The process
    is started with the first plan and ends some time after the last one.
    """

    def __init__(self, dispatch: Callable[[SolverEvent], object]) -> None:
        """
        Args:
            dispatch: handles the resulting events.
        """
        self._dispatch = dispatch
        self._process = Background(_NICENESS)
        self._jobs = Jobs(self._on_progress, self._failed)

    def perform(self, effect: SolverEffect) -> None:
        match effect:
            case BeginPlan():
                if not self._process.has_loaded(effect.load):
                    self._dispatch(RolloutsStart())
                self._jobs.start("planning", lambda job: self._plan(job, effect))
            case EndPlan():
                self._jobs.stop()

    def close(self) -> None:
        """Stop; returns when the process has ended. Called on another thread than the loop."""
        do(self._jobs.stop)
        self._process.close()

    async def _plan(self, job: Job, what: BeginPlan) -> None:
        began = time.monotonic()

        async def ask() -> Planned:
            await load_version(self._process, job, what.load)
            question = PlanActions(what.wanted.snapshot, what.wanted.bodies, what.options, what.traced)
            return await self._process.ask(question, lambda done, total, part: job.report(done, total))

        planned = await self._process.in_turns(job, ask)
        seconds = time.monotonic() - began
        made = sum(len(one.returns) * one.horizon for one in planned.envs) * what.options.rounds
        self._dispatch(PlanMade(what.wanted, planned.envs, made / max(seconds, 1e-6)))

    def _on_progress(self) -> None:
        if (progress := self._jobs.progress) is not None:
            self._dispatch(PlanActivity(progress.what))

    def _failed(self, failure: JobFailed) -> None:
        self._dispatch(PlanFailed(str(failure), failure.problem))


def _curves(episode: RunningEpisode) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Predicted and achieved reward, as in `SolveView`."""
    rewards = np.array(episode.rewards, np.float32)
    count = max(len(rewards), max(episode.predicted, default=-1) + 1)
    predicted = np.full(count, np.nan, np.float32)
    for place, value in episode.predicted.items():
        predicted[place] = value
    achieved = np.full(count, np.nan, np.float32)
    sums = np.concatenate([[0.0], np.cumsum(rewards, dtype=np.float64)])
    ends = np.minimum(np.arange(len(rewards)) + episode.horizon, len(rewards))
    begins = np.arange(len(rewards))
    achieved[: len(rewards)] = (sums[ends] - sums[begins]) / np.maximum(ends - begins, 1)
    return predicted, achieved
