"""Reads where a reset put the bodies, in the worker's env."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from workbench.envs import maniskill_private
from workbench.envs.arms import Arm, find_arms, reaches
from workbench.envs.overlaps import first_substep, overlaps_to_report
from workbench.envs.scene.scene_index import scene_index
from workbench.envs.simulation.cpu_system import batched_system
from workbench.envs.task_env import TaskEnv
from workbench.hands.questions import FirstStates

MAX_BODIES = 16
"""Maximum number of bodies that are checked for reach: a body out of reach takes 40 ms in each env."""


def first_states(task: TaskEnv, poses: NDArray[np.float32]) -> FirstStates:
    """The first states, right after a reset. Makes a substep of physics.

    Args:
        poses: (N, B, 7) after the reset.
    """
    env, arms = task.env, find_arms(task.env)
    bodies = _bodies_to_reach(env)[:MAX_BODIES] if arms else ()
    beyond = np.zeros((task.num_envs, len(bodies)), bool)
    for of in range(task.num_envs):
        own = [arm for arm in arms if arm.row(of) is not None]
        if own:
            beyond[of] = _are_beyond(own, of, poses[of, list(bodies), :3].astype(np.float64))
    if batched_system(env.scene) is None:
        return FirstStates(poses, None, bodies, beyond)
    first_substep(env)
    return FirstStates(poses, overlaps_to_report(env), bodies, beyond)


def _are_beyond(arms: list[Arm], env: int, points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(K,) whether no arm reaches the point; False for NaN, which is a body that the env lacks."""
    beyond = np.asarray(np.isfinite(points).all(axis=1))
    for arm in arms:
        left = np.flatnonzero(beyond)
        beyond[left] = ~reaches(arm, env, points[left])
    return beyond


def _bodies_to_reach(env: Any) -> tuple[int, ...]:
    """Bodies that a reset may place, without the robots' own."""
    index = scene_index(env)
    robots = {str(agent.robot.name) for agent in maniskill_private.agents(env)}
    return tuple(
        body
        for body, (kind, owner) in enumerate(zip(index.kinds, index.owners, strict=True))
        if kind != "static" and owner not in robots
    )
