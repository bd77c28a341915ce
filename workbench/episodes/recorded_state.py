"""Writes a recorded state into a running env, and measures an env's distance from a recorded state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from workbench.envs import maniskill_private
from workbench.envs.evaluate_entries import flat_entries
from workbench.envs.partial_reset import active_controllers
from workbench.envs.recorded_run import pose_distances
from workbench.envs.scene.scene_index import present_states, scene_index
from workbench.envs.simulation.cpu_system import batched_system
from workbench.envs.simulation.state_layout import BODY
from workbench.envs.snapshots.cpu_state import renew_physics
from workbench.envs.task_env import to_numpy

_POSE = 7


def state_mismatches(env: Any, env_idx: int, state: Mapping[str, NDArray]) -> dict[str, str]:
    """Names of the parts of a recorded state that do not fit this env, and of the parts of the env that the
    state lacks, each with the reason.

    Args:
        env: an unwrapped ManiSkill env, batched.
        state: (D,) by name, as returned by `RecordedRun.state`.
    """
    missed: dict[str, str] = {}
    structs = scene_index(env).states
    for name, struct in structs.items():
        if env_idx not in maniskill_private.envs_of(struct):
            continue
        value, width = state.get(name), BODY + 2 * maniskill_private.joints_of(struct)
        if value is None or np.isnan(value).any():
            missed[name] = (
                "the recording has no state of this name; the env's part keeps its state from the reset"
            )
        elif value.shape != (width,):
            missed[name] = f"its state has {width} numbers now, and {value.shape[-1]} in the recording"
    for name, value in state.items():
        kind = name.partition("/")[0]
        if kind in ("actors", "articulations") and name not in structs and not np.isnan(value).all():
            missed[name] = "this env has nothing of this name"
    return missed


def write_states(env: Any, states: Mapping[int, Mapping[str, NDArray]]) -> None:
    """Write a recorded state into each of these envs, except its `state_mismatches`; the other envs are not touched.

    The env's code may differ (an actor removed, an arm with another joint), so states are matched by name and shape and
    written with ManiSkill's own setters. The state tensors are fetched before and after.
    """
    missed = {i: state_mismatches(env, i, state) for i, state in states.items()}
    px = batched_system(env.scene)
    maniskill_private.fetch(env)
    # Collect the values in the tensors, because applying the tensors writes only what differs: a root pose
    # that is set again reads back with a different rounding.
    with nullcontext() if px is None else px.holding_back():
        for name, struct in scene_index(env).states.items():
            fitting = [
                i for i in maniskill_private.envs_of(struct).tolist() if i in states and name not in missed[i]
            ]
            rows = {i: states[i][name] for i in fitting}
            if rows:
                values = torch.as_tensor(np.stack([*rows.values()]).astype(np.float32), device=env.device)
                struct.set_state(values, torch.tensor([*rows], device=env.device))
    maniskill_private.apply_and_fetch(env)
    _write_controllers(env, states)


def settle_robot(env: Any, env_idx: Sequence[int], robot: Any = None) -> None:
    """Set controllers and drive targets of these envs' robots to the current joint positions.

    ``get_state_dict`` includes controllers only if they keep their own target. Without this function, the
    other controllers would drive a restored robot back to its old position.

    Args:
        robot: the agent of a robot; None for all robots of the envs.
    """
    chosen = [int(i) for i in env_idx]
    robots = maniskill_private.agents(env) if robot is None else [robot]
    if not robots or not chosen:
        return
    with maniskill_private.setting_only(env, chosen):
        for controller in active_controllers(env, robots):
            controller.reset()
    targets = env.scene.px.cuda_articulation_target_qpos.torch()
    velocities = env.scene.px.cuda_articulation_target_qvel.torch()
    for agent in robots:
        qpos = agent.robot.get_qpos()
        rows = maniskill_private.data_rows_of_articulation(agent.robot)[chosen].long()
        targets[rows, : qpos.shape[1]] = qpos[chosen]
        velocities[rows] = 0.0
    maniskill_private.apply_and_fetch(env)


def new_physics(env: Any, env_idx: Sequence[int]) -> None:
    """Give these envs a fresh PhysX scene (`renew_physics`); does nothing on a GPU, where that is impossible."""
    if batched_system(env.scene) is not None:
        renew_physics(env.scene, [int(i) for i in env_idx])


def read_states(env: Any) -> dict[str, NDArray[np.float32]]:
    """(N, D) state of each actor and articulation, by its name in recordings; NaN in envs that lack it."""
    return {name: to_numpy(state) for name, state in present_states(env).items()}


def state_distance(now: Mapping[str, NDArray], was: Mapping[str, NDArray]) -> tuple[float, float]:
    """Distance of one env's state from a recorded one: the distance in metres of the farthest body, and the
    largest rotation in radians of a body or joint. The displacement of a sliding joint, in metres, counts as
    a rotation. Ignores entries that only one of the two states has.

    Args:
        now, was: (D,) by name.
    """
    both = [
        (value, was[name])
        for name, value in now.items()
        # A controller's state is not a pose.
        if name.startswith(("actors/", "articulations/"))
        and name in was
        and was[name].shape == value.shape
        # An env that lacks the body has only NaN.
        and not np.isnan(value).all()
        and not np.isnan(was[name]).all()
    ]
    if not both:
        return 0.0, 0.0
    metres, radians = pose_distances(*(np.stack([pair[k][:_POSE] for pair in both]) for k in (0, 1)))
    joints = [
        np.abs(np.subtract(*pair, dtype=np.float64)[BODY : (BODY + len(pair[0])) // 2]) for pair in both
    ]
    turned = np.concatenate([radians, *joints]).max()
    return float(metres.max()), float(turned) if np.isfinite(turned) else float("inf")


def same_state(now: Mapping[str, NDArray], was: Mapping[str, NDArray]) -> bool:
    """Whether all entries that both states have are exactly equal, including velocities."""
    both = [name for name in was if name in now and now[name].shape == was[name].shape]
    return all(np.array_equal(now[name], was[name], equal_nan=True) for name in both)


def _write_controllers(env: Any, states: Mapping[int, Mapping[str, NDArray]]) -> None:
    """Write the targets that controllers keep, if they were recorded (``controller/arm/target_qpos``)."""
    if env.agent is None:
        return
    for name, value in flat_entries(env.agent.get_controller_state(), "controller"):
        for i, state in states.items():
            recorded = state.get(name)
            if recorded is not None and recorded.shape == tuple(value.shape[1:]):
                value[i] = torch.as_tensor(recorded, dtype=value.dtype, device=value.device)
