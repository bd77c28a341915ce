"""Requests plans in the worker that plays, and makes plans in the planning process."""

from __future__ import annotations

import pickle
from collections import deque
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from workbench.envs import action_vector as actions
from workbench.envs.hot_swap import put_class
from workbench.envs.maniskill_private import objects_of, tool_of
from workbench.envs.scene.scene_index import scene_index
from workbench.envs.snapshots.snapshot import Snapshot
from workbench.envs.step_result import StepResult
from workbench.envs.task_env import TaskEnv, given_arguments
from workbench.live.messages import (
    SCENE_KEPT,
    CannotAnswer,
    FollowPlan,
    PlanDropped,
    PlanWanted,
    ReloadLevel,
    Settings,
)
from workbench.planning.options import PlanOptions
from workbench.planning.rollouts import (
    NotAlike,
    NothingToPlan,
    Plan,
    RolloutPlanner,
    bodies_of,
    make_rollout_env,
    require_plannable,
)
from workbench.solve.questions import PlanActions, Planned, PlannedEnv
from workbench.task.blame import blamed
from workbench.task.open import OpenedTask

MAX_PATHS = 24
"""Maximum number of rollouts whose path is sent to the page."""


class FollowedPlan:
    """Planned actions in the worker that plays. While a plan is awaited, the worker continues its loop."""

    def __init__(self, send: Callable[[PlanWanted | PlanDropped], None]) -> None:
        """
        Args:
            send: sends an event to the server.
        """
        self._send = send
        self._asked: int | None = None
        self._told = False
        """Whether a request for a plan was sent to the server and has not been dropped since."""
        self._at = -1
        """`Stepped.number` of the moment at which the first of `_actions` is due."""
        self._actions: deque[NDArray[np.float32]] = deque()
        self._env_idx: tuple[int, ...] = ()

    @property
    def awaited(self) -> bool:
        """Whether a plan was requested and has not arrived."""
        return self._asked is not None and not self._actions

    def ready(self, opened: OpenedTask, moment: int, envs: Sequence[int]) -> bool:
        """Whether there is an action for this moment; if not, request a plan, once.

        Args:
            moment: `Stepped.number`.
            envs: envs to plan for.
        """
        if self._actions and self._at == moment:
            return True
        self._actions.clear()
        if self._asked != moment:
            self._asked, self._told = moment, True
            self._send(_wanted(opened, moment, tuple(envs)))
        return False

    def take(self, plan: FollowPlan) -> None:
        """Use a plan that arrived, unless another one has been requested since."""
        if plan.number == self._asked:
            self._at, self._env_idx, self._actions = plan.number, plan.env_idx, deque(plan.actions)

    def next_action(self, task: TaskEnv, moment: int) -> NDArray[np.float32]:
        """(N, A) action for this moment, for which `ready` was True."""
        action = actions.hold_action(task.parts, task.num_envs)
        planned = self._actions.popleft()
        self._at, self._asked = moment + 1, None
        # Just after a reload, a plan of the old version may arrive, for a robot with other joints.
        if planned.shape[1] == action.shape[1] and max(self._env_idx, default=-1) < len(action):
            action[list(self._env_idx)] = planned
        return action

    def forget(self) -> None:
        """Drop plans, also a requested one, because something else moves the envs now."""
        self._asked = None
        self._actions.clear()
        if self._told:
            # Tell the server: the request for a plan may reach it after it has sent the pause, and it would
            # plan in vain.
            self._told = False
            self._send(PlanDropped())


def envs_to_plan(settings: Settings, task: TaskEnv, last: StepResult) -> list[int]:
    """The selected env; with `solve_all`, the envs that have not succeeded, or all envs if each has
    succeeded."""
    if not settings.solve_all:
        return [min(settings.selected_env, task.num_envs - 1)]
    done = succeeded(last)
    unsolved = [env for env in range(task.num_envs) if not done[env]]
    return unsolved or list(range(task.num_envs))


def succeeded(step: StepResult) -> NDArray[np.bool_]:
    """(N,) whether each env has succeeded; all False for a task without success."""
    success = step.evaluate.get("success", np.zeros(len(step.reward)))
    return np.array([bool(np.all(one)) for one in success])


def _wanted(opened: OpenedTask, moment: int, envs: tuple[int, ...]) -> PlanWanted:
    try:
        snapshot = pickle.dumps(opened.env.snapshot(list(envs)))
    except Exception as error:
        # A task may keep an object that cannot be copied. That must not stop the task, here or in the history
        # (`step_events`).
        return PlanWanted(
            moment, envs, why_not=f"the task's state cannot be copied: {type(error).__name__}: {error}"
        )
    bodies = bodies_of(opened.env.env)
    return PlanWanted(moment, envs, snapshot, tuple(bodies[env] for env in envs))


class WorkerPlans:
    """Makes plans with its own rollout envs, which are built at the first request.

    A plan continues the env's last plan if the snapshot is of the same episode, at the step at which the next
    plan was due; else a new plan begins.
    """

    def __init__(self, waits: Callable[[], bool]) -> None:
        """
        Args:
            waits: returns whether a request waits; if so, the planning ends.
        """
        self._waits = waits
        self._rolled: TaskEnv | None = None
        self._planner: RolloutPlanner | None = None
        self._options = PlanOptions()
        self._next: dict[int, tuple[int, int]] = {}
        """Seed of the episode, and the episode's control step at which the next plan is due, for each env
        that has a plan."""

    def answer(
        self,
        opened: OpenedTask,
        env_kwargs: dict[str, object],
        question: PlanActions,
        report: Callable[..., None],
    ) -> Planned:
        """
        Args:
            env_kwargs: keyword arguments with which the task was opened.
            report: called with the number of finished envs and the total.

        Raises:
            CannotAnswer: a request arrived, or the task cannot be planned for.
            TaskError: the task raised in a rollout or while the envs were built.
        """
        rolled, planner = self._made(opened, env_kwargs, PlanOptions(**vars(question.options)))
        try:
            for bodies in question.bodies:
                planner.require_bodies(bodies)
        except NotAlike as error:
            raise CannotAnswer(str(error)) from None
        snapshot: Snapshot = pickle.loads(question.snapshot)
        traced = _body_to_trace(rolled, question.traced)
        planned: list[PlannedEnv] = []
        for place, env in enumerate(snapshot.env_idx):
            if self._waits():
                raise CannotAnswer("another request came")
            report(place, len(snapshot.env_idx))
            memory = snapshot.memory
            seed, elapsed = int(memory.episode_seeds[place]), int(memory.elapsed_steps[place])
            if self._next.get(env) != (seed, elapsed):
                planner.begin(env, max(seed, 0))
            with blamed("step", opened.loaded, rolled):
                plan = planner.plan(snapshot, env, traced)
            self._next[env] = seed, elapsed + question.options.every
            name = "" if traced is None else scene_index(rolled.env).names[traced]
            planned.append(_for_page(env, plan, question.options.every, name))
        return Planned(tuple(planned))

    def loaded(self, opened: OpenedTask, level: ReloadLevel | None) -> None:
        """Handle a load in this process: keep the rollouts' envs if the scene is kept, else close them."""
        if self._rolled is not None and level in SCENE_KEPT:
            put_class(self._rolled.env, opened.loaded.cls)
        else:
            self.close()

    def close(self) -> None:
        """Close the rollouts' envs."""
        if self._rolled is not None:
            self._rolled.close()
        self._rolled = self._planner = None
        self._next = {}

    def _made(
        self, opened: OpenedTask, env_kwargs: dict[str, object], options: PlanOptions
    ) -> tuple[TaskEnv, RolloutPlanner]:
        if self._rolled is not None and self._rolled.num_envs != options.rollouts:
            self.close()
        if self._rolled is None:
            try:
                require_plannable(opened.env.env)
            except NothingToPlan as error:
                raise CannotAnswer(str(error)) from None
            loaded = opened.loaded
            made_with = given_arguments(loaded.cls, env_kwargs, loaded.default_kwargs)
            with blamed("build", loaded):
                self._rolled = TaskEnv(make_rollout_env(opened.env.env, made_with, options.rollouts))
        if self._planner is None or self._options != options:
            self._next = {}
            # Restore quickly, not exactly: differences in the last bit of a contact are not visible.
            self._planner, self._options = RolloutPlanner(self._rolled.env, options, exact=False), options
        return self._rolled, self._planner


def _for_page(env: int, plan: Plan, steps: int, traced: str) -> PlannedEnv:
    returns = plan.returns
    order = np.argsort(np.where(np.isfinite(returns), -returns, np.inf), kind="stable")
    # Spread evenly from the best to the worst: otherwise the page would show only paths similar to the best.
    drawn = np.unique(np.linspace(0, len(order) - 1, MAX_PATHS).astype(int))
    paths = np.zeros((0, 0, 3), np.float32) if plan.paths is None else plan.paths[order[drawn]]
    return PlannedEnv(
        env,
        plan.actions[:steps],
        plan.rewards.shape[1],
        returns[order],
        int(np.flatnonzero(order == 0)[0]),
        int(np.flatnonzero(order == 1)[0]),
        plan.success_at[order],
        paths,
        tuple(map(int, drawn)),
        traced,
        plan.seconds,
    )


def _body_to_trace(rolled: TaskEnv, name: str) -> int | None:
    """Index of the body of this name, else of the robot's tool, else of the scene's last link; None if there
    is none of these."""
    env = rolled.env
    names = scene_index(env).names
    if name in names:
        return names.index(name)
    tool = tool_of(env.agent)
    if tool is not None:
        found = scene_index(env).name_of(objects_of(tool)[0])
        if found is not None:
            return names.index(found)
    links = [place for place, kind in enumerate(scene_index(env).kinds) if kind == "link"]
    return links[-1] if links else None
