"""``get_state_dict`` of a batch, flat and in a few calls.

ManiSkill asks every actor and articulation in turn for pose and velocities, 75 us for the four of PickCube, and a
recording asks at every step. All of it lies in three tensors, so which row belongs to whom is found once a scene. The
numbers are those of ``get_state_dict``, to the last bit (tested). A task that has a ``get_state_dict`` of its own is asked itself, and so is
an object that only some envs have; in the envs without it the row is NaN.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from mani_skill.envs.sapien_env import BaseEnv

from workbench.core import seams
from workbench.core.scene_index import in_every_env, once_a_scene, scene_index
from workbench.core.task_env import flat_entries


@dataclass
class _Plan:
    """Where the states lie."""

    bodies: list[str]
    """Names, in the order of `rows`; actors first."""
    actors: int
    """How many of these are actors."""
    rows: Any
    """(N * bodies,) rows of ``cuda_rigid_body_data``, env by env."""
    still: list[int]
    """Which of `bodies` are moved by the task and have no velocity."""
    joints: list[tuple[Any, int]]
    """Of each articulation: its rows (N,) in the tensors of joints, and how many joints it has."""
    others: list[str]
    """Actors and articulations that not every env has."""


def env_states(env: BaseEnv) -> dict[str, Any]:
    """(N, D) by name: ``actors/cube``, ``articulations/panda``, and ``controller/...`` where a controller has a state.

    Tensors, or on the CPU arrays; copies of the simulation's own."""
    if type(env).get_state_dict is not BaseEnv.get_state_dict or not env.scene.gpu_sim_enabled:
        whole: Any = env.get_state_dict()
        known = scene_index(env).states
        return {name: in_every_env(env, known.get(name), value) for name, value in flat_entries(whole)}
    plan, structs = _planned(env), scene_index(env).states
    scene: Any = env.scene
    data, qpos, qvel = (
        # numpy's calls on a few hundred numbers take a quarter of torch's.
        tensor.numpy() if tensor.device.type == "cpu" else tensor
        for tensor in (
            scene.px.cuda_rigid_body_data.torch(),
            scene.px.cuda_articulation_qpos.torch(),
            scene.px.cuda_articulation_qvel.torch(),
        )
    )
    data = data[plan.rows].reshape(env.num_envs, -1, 13)
    if plan.still:
        data[:, plan.still, 7:] = 0.0
    states: dict[str, Any] = {}
    for k, name in enumerate(plan.bodies[: plan.actors]):
        states[name] = structs[name].get_state() if structs[name].hidden else data[:, k]
    for k, (rows, dof) in enumerate(plan.joints, plan.actors):
        parts = [data[:, k], qpos[rows, :dof], qvel[rows, :dof]]
        states[plan.bodies[k]] = (
            np.concatenate(parts, axis=1) if isinstance(data, np.ndarray) else torch.cat(parts, dim=1)
        )
    for name in plan.others:
        states[name] = in_every_env(env, structs[name], structs[name].get_state())
    if env.agent is not None:
        controllers: Any = env.agent.get_controller_state()
        states.update(flat_entries(controllers, "controller/"))
    return states


@once_a_scene
def _planned(env: BaseEnv) -> _Plan:
    plan = _Plan([], 0, None, [], [], [])
    every = list(range(env.num_envs))
    rows: list[torch.Tensor] = []
    for name, struct in scene_index(env).states.items():
        if list(seams.envs_of(struct)) != every:
            plan.others.append(name)
        elif name.startswith("actors/"):
            if struct.px_body_type != "dynamic":
                plan.still.append(len(rows))
            rows.append(seams.data_rows_of(struct))
            plan.bodies.append(name)
            plan.actors += 1
        else:
            rows.append(seams.data_rows_of(struct.root))
            plan.bodies.append(name)
            of_joints = _index(seams.data_rows_of_articulation(struct))
            plan.joints.append((of_joints, int(struct.max_dof)))
    none = torch.zeros(0, dtype=torch.long, device=env.device)
    plan.rows = _index(torch.stack([row.long() for row in rows], dim=1).reshape(-1) if rows else none)
    return plan


def _index(rows: torch.Tensor) -> Any:
    return rows.long().numpy() if rows.device.type == "cpu" else rows.long()
