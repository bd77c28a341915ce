"""Plans the actions of the live envs in a separate process, for the source of actions *solve*."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from workbench.authoring.problem import Problem
from workbench.core.env.step_result import StepResult
from workbench.jobs.task import Stepped
from workbench.session.checks.checks import load_version
from workbench.session.loop import on_loop
from workbench.session.process.askers import Background
from workbench.session.process.jobs import Job, JobFailed, Jobs
from workbench.session.protocol.messages import FollowPlan, Load, PlanWanted, Request, Settings
from workbench.session.protocol.questions import PlanActions, Planned, PlannedEnv

_NICENESS = 5
"""Niceness of the planning process: between the worker that plays and work that nobody waits for."""
_NOTHING = np.zeros(0, np.float32)
SolveState = Literal["none", "starting", "planning", "failed"]


@dataclass(frozen=True)
class SolveView:
    """The plans of one env, and how its episode went so far."""

    state: SolveState = "none"
    """``starting`` the envs of the rollouts; ``failed``: see `why`."""
    serial: int = 0
    """Grows with every change."""
    activity: str = ""
    """What is being started."""
    why: str = ""
    """Why there is no plan, as text."""
    problem: Problem | None = None
    """What the author's code raised in a rollout."""
    plan: PlannedEnv | None = None
    """The last plan of the env."""
    plan_step: int = 0
    """Control step of the episode that the plan was made for, from 0 on."""
    predicted: NDArray[np.float32] = field(default_factory=lambda: _NOTHING)
    """(T,) predicted reward a step of the best rollout from each step of the episode on; NaN where nothing was planned."""
    achieved: NDArray[np.float32] = field(default_factory=lambda: _NOTHING)
    """(T,) achieved reward a step, over the horizon from each step on, as far as the horizon is over."""
    begins: int = 0
    """The control step of the episode that `predicted` and `achieved` begin with."""
    solved_at: int = 0
    """The step of the episode's first success, from 1 on; 0 without one."""
    solved: tuple[tuple[int, int], ...] = ()
    """Env and step of every env whose episode is solved."""
    steps_per_second: float = 0.0
    """Env-steps of rollouts that the last plan made a second, restoring and planning included."""


@dataclass
class _Episode:
    """What is known of the running episode of an env."""

    begins: int = 0
    """Control steps of the env's episode before the first one that is kept here."""
    rewards: list[float] = field(default_factory=list)
    predicted: dict[int, float] = field(default_factory=dict)
    """Predicted reward a step, by index into `rewards`."""
    horizon: int = 1
    plan: PlannedEnv | None = None
    plan_step: int = 0
    solved_at: int = 0
    rate: float = 0.0


class Solver:
    """Answers what the worker that plays wants planned, one plan at a time; a newer wish replaces the one before.

    A process of its own has the same version of the task with the envs of the rollouts. It is started with the first plan,
    and ends a while after the last. Used on the loop, but for `close`.
    """

    def __init__(
        self, on_change: Callable[[], None], send: Callable[[Request], None], pause: Callable[[], None]
    ) -> None:
        """
        Args:
            on_change: called when `view` has changed.
            send: sends to the worker that plays.
            pause: pauses it, where there is no plan to follow.
        """
        self._on_change, self._send, self._pause = on_change, send, pause
        self._process = Background(_NICENESS)
        self._state: SolveView = SolveView()
        """The view without the fields of a single env."""
        self._episodes: dict[int, _Episode] = {}
        self._jobs = Jobs(on_change, self._refuse)

    @property
    def solved(self) -> tuple[int, ...]:
        """Envs whose episode is solved."""
        return tuple(env for env, episode in sorted(self._episodes.items()) if episode.solved_at)

    def view(self, env: int) -> SolveView:
        """The view of this env."""
        progress, state, episode = self._jobs.progress, self._state, self._episodes.get(env, _Episode())
        solved = tuple((e, self._episodes[e].solved_at) for e in self.solved)
        predicted, achieved = _curves(episode)
        return replace(
            state,
            activity=progress.what if progress is not None and state.state == "starting" else "",
            plan=episode.plan,
            plan_step=episode.plan_step,
            predicted=predicted,
            achieved=achieved,
            begins=episode.begins,
            solved_at=episode.solved_at,
            solved=solved,
            steps_per_second=episode.rate,
        )

    def plan(self, wanted: PlanWanted, load: Load, settings: Settings) -> None:
        """Plan, and send the worker the actions to follow.

        Args:
            load: loads the running version.
            settings: how to plan.
        """
        if wanted.why_not:
            self._refuse(JobFailed(wanted.why_not))
            return
        # One env of the task is enough to make the rollouts' envs like it, and its seed decides nothing.
        alone = replace(load, options=replace(load.options, num_envs=1, seed=0))
        loaded = self._process.has_loaded(alone)
        self._set(state="planning" if loaded else "starting", why="", problem=None)
        self._jobs.start("planning", lambda job: self._plan(job, wanted, alone, settings))

    def stepped(self, event: Stepped, planned: bool) -> None:
        """Note what the worker that plays came to.

        Args:
            planned: the source of its actions is *solve*.
        """
        if not planned and not self._episodes:
            return
        for env in range(len(event.reset_mask)):
            if event.reset_mask[env] or not planned:
                self._episodes.pop(env, None)
            if planned:
                self._note(env, event.step, bool(event.reset_mask[env]))
        self._set()

    @on_loop
    def stop(self) -> None:
        """End the planning; the last plan stays visible."""
        self._jobs.stop()
        if self._state.state in ("starting", "planning"):
            self._set(state="none")
        self._on_change()

    def close(self) -> None:
        """Stop; returns when the process has ended. Called on another thread than the loop."""
        self.stop()
        self._process.close()

    # --- the job -------------------------------------------------------------------------------------

    async def _plan(self, job: Job, wanted: PlanWanted, load: Load, settings: Settings) -> None:
        began = time.monotonic()

        async def ask() -> Planned:
            await load_version(self._process, job, load)
            question = PlanActions(wanted.snapshot, wanted.bodies, settings.plan, settings.traced)
            return await self._process.ask(question, lambda done, total, part: job.report(done, total))

        planned = await self._process.in_turns(job, ask)
        actions = np.stack([one.actions for one in planned.envs], 1)
        seconds = time.monotonic() - began
        made = sum(len(one.returns) * one.horizon for one in planned.envs) * settings.plan.rounds
        for one in planned.envs:
            episode = self._episodes.setdefault(one.env, _Episode())
            episode.plan, episode.horizon = one, one.horizon
            episode.plan_step = episode.begins + len(episode.rewards)
            episode.predicted[len(episode.rewards)] = float(one.returns[0]) / one.horizon
            episode.rate = made / max(seconds, 1e-6)
        self._set(state="planning")
        self._send(FollowPlan(wanted.number, wanted.env_idx, actions))

    def _refuse(self, failure: JobFailed) -> None:
        self._set(state="failed", why=str(failure), problem=failure.problem)
        self._pause()
        self._on_change()

    # --- what is kept --------------------------------------------------------------------------------

    def _note(self, env: int, step: StepResult, begins: bool) -> None:
        elapsed = int(step.elapsed_steps[env])
        if begins or env not in self._episodes:
            self._episodes[env] = _Episode(elapsed)
            return
        episode = self._episodes[env]
        episode.rewards.append(float(step.reward[env]))
        success = step.evaluate.get("success")
        if success is not None and bool(np.all(success[env])) and not episode.solved_at:
            episode.solved_at = elapsed

    def _set(self, **values: Any) -> None:
        self._state = replace(self._state, serial=self._state.serial + 1, **values)


def _curves(episode: _Episode) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Predicted and achieved reward a step, from each step of the episode on."""
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
