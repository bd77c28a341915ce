"""Leads arms to poses in the worker's env."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from workbench.envs import maniskill_private
from workbench.envs.arms import Arm, ArmPose, find_arms, solve, steer
from workbench.envs.scene.scene_index import scene_index
from workbench.envs.step_result import StepResult
from workbench.envs.task_env import TaskEnv
from workbench.hands.worker import put_joints
from workbench.live.messages import Reached, ReachPose
from workbench.task.description import Restored

_BASE_MOVED = 2e-3
"""Change of the root or of a joint outside the arm, in rad or m, above which the arm's goal is computed
again."""


@dataclass(frozen=True)
class _Target:
    request: ReachPose
    goal: ArmPose | None = None
    """None until the next control step."""
    base: NDArray[np.float64] | None = None
    """Value of `_base` for which `goal` was computed."""


class LedArms:
    """The arms that follow a target while the envs step, and the newest ``try`` request.

    Args:
        send: sends an event to the server.
    """

    def __init__(self, send: Callable[[Reached], object]) -> None:
        self._send = send
        self._targets: dict[tuple[int, str], _Target] = {}
        self._asked: ReachPose | None = None

    def take(self, request: ReachPose) -> None:
        """Follow the target, or keep a ``try`` request for `answer`; without an arm, let go of the env's
        arms."""
        if not request.arm:
            self.forget((request.env,))
        elif request.how == "follow":
            self._targets[request.env, request.arm] = _Target(request)
        else:
            self._asked = request

    def forget(self, env_idx: Collection[int] | None = None) -> None:
        """Let go of the arms of these envs; of all if None."""
        self._targets = {
            key: one for key, one in self._targets.items() if env_idx is not None and key[0] not in env_idx
        }
        if env_idx is None or (self._asked is not None and self._asked.env in env_idx):
            self._asked = None

    @property
    def is_asked(self) -> bool:
        """Whether a ``try`` request waits. Only the newest is kept, since a drag sends them faster than they
        are answered."""
        return self._asked is not None

    def answer(self, task: TaskEnv) -> None:
        """Answer the waiting ``try`` request."""
        request, self._asked = self._asked, None
        if request is None or (arm := _arm(task.env, request)) is None:
            return
        goal = solve(arm, request.env, np.asarray(request.pose, np.float64))
        self._send(_reached(task.env, arm, request, goal, with_links=True))

    def lead(self, task: TaskEnv, action: NDArray[np.float32]) -> NDArray[np.float32]:
        """The action (N, A) with the numbers set for the arms that follow handles; `action` itself is not changed."""
        if not self._targets:
            return action
        action = action.copy()
        for key, target in list(self._targets.items()):
            request, arm = target.request, _arm(task.env, target.request)
            if arm is None:
                del self._targets[key]
                continue
            base = _base(arm, request.env)
            if target.base is None or np.abs(base - target.base).max() > _BASE_MOVED:
                goal = solve(arm, request.env, np.asarray(request.pose, np.float64))
                moves = steer(task.env, arm, request.env, goal, action[request.env])
                is_new, target = target.goal is None, _Target(request, goal, base)
                self._targets[key] = target
                reached = _reached(task.env, arm, request, goal)
                if not moves:
                    reached = replace(
                        reached, why=f"the control mode {task.env.control_mode} does not move this arm"
                    )
                if is_new or reached.why:
                    self._send(reached)
            elif target.goal is not None:
                steer(task.env, arm, request.env, target.goal, action[request.env])
        return action


def set_arm(task: TaskEnv, request: ReachPose) -> tuple[StepResult, Restored, Reached] | None:
    """Put an arm at the joint positions nearest to a pose, at rest; None if the env has no such arm."""
    env, of = task.env, request.env
    arm = _arm(env, request)
    if arm is None:
        return None
    goal = solve(arm, of, np.asarray(request.pose, np.float64))
    agent = next(agent for agent in maniskill_private.agents(env) if agent.robot is arm.articulation)
    qpos = torch.as_tensor(goal.qpos, dtype=torch.float32, device=env.device)[None]
    step = put_joints(task, agent, [of], qpos)
    reached = _reached(env, arm, request, goal)
    how = f"{request.arm} was moved by hand."
    return step, Restored((of,), (of,), request.origin, None, {}, how=how, moved=request.arm), reached


def _arm(env: Any, request: ReachPose) -> Arm | None:
    """The arm of a request; None if the env lacks it, for example because the request is from before a
    reload."""
    found = next((arm for arm in find_arms(env) if arm.name == request.arm), None)
    return None if found is None or found.row(request.env) is None else found


def _base(arm: Arm, env: int) -> NDArray[np.float64]:
    """The root's pose, and the positions of all joints outside the arm."""
    root = arm.articulation.pose.raw_pose[arm.row(env)].numpy(force=True)
    return np.concatenate([root, np.delete(arm.qpos(env), list(arm.joints))])


def _reached(env: Any, arm: Arm, request: ReachPose, goal: ArmPose, with_links: bool = False) -> Reached:
    links, poses = (), np.zeros((0, 7), np.float32)
    if with_links:
        row, index = arm.row(request.env), scene_index(env)
        assert row is not None, "`_arm` found it"
        bodies = maniskill_private.objects_of(arm.articulation)[row].links
        links, poses = tuple(index.name_of(body) or "" for body in bodies), goal.poses
    how: Literal["follow", "try", "set"] = request.how
    return Reached(request.env, request.arm, how, goal.metres, goal.degrees, goal.why, links, poses)
