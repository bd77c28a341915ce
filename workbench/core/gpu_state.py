"""The simulation state of chosen envs of ManiSkill's GPU simulation.

There is no packed state on the GPU, but the tensors that ManiSkill reads and writes are the state: poses and
velocities of bodies, qpos, qvel, joint forces and drive targets. They are copied by the names of actors and
articulations, and written through ManiSkill's own structs, which apply its reset mask. What PhysX keeps
beside them (contacts, sleep) is on the device and out of reach.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from workbench.core import seams

_JOINT_TENSORS = ("qf", "target_qpos", "target_qvel")
"""Of an articulation, beside what its ``get_state()`` has: ``px.cuda_articulation_NAME``."""


@dataclass(frozen=True)
class GpuEnvState:
    """The simulation state of one env."""

    actors: dict[str, NDArray[np.float32]]
    """(13,) each: position, quaternion wxyz, linear and angular velocity."""
    articulations: dict[str, NDArray[np.float32]]
    """The same of the root, then qpos and qvel."""
    joints: dict[str, NDArray[np.float32]]
    """(3, D) joint forces, target positions and target velocities of each articulation."""


def read_gpu_state(env: Any, env_idx: list[int]) -> list[GpuEnvState]:
    """The simulation state of the envs in `env_idx`, one each."""
    states = {i: GpuEnvState({}, {}, {}) for i in env_idx}
    for name, actor in env.scene.actors.items():
        if actor.px_body_type != "static":
            rows = actor.get_state().cpu().numpy()
            for i, row in zip(seams.envs_of(actor), rows, strict=True):
                if i in states:
                    states[i].actors[name] = row.copy()
    for name, articulation in env.scene.articulations.items():
        rows = articulation.get_state().cpu().numpy()
        joints = np.stack([t[articulation._data_index.long()].cpu().numpy() for t in _joint_tensors(env)], 1)
        for i, row, joint in zip(seams.envs_of(articulation), rows, joints, strict=True):
            if i in states:
                states[i].articulations[name] = row.copy()
                states[i].joints[name] = joint.copy()
    return [states[i] for i in env_idx]


def write_gpu_state(
    env: Any, env_idx: list[int], states: list[GpuEnvState]
) -> tuple[dict[str, None], dict[str, str]]:
    """Put ``states[k]`` into env ``env_idx[k]``; as `cpu_state.write_cpu_state`, but applied and fetched."""
    carried: dict[str, None] = {}
    missed: dict[str, str] = {}
    by_env = dict(zip(env_idx, states, strict=True))
    moving = {n: a for n, a in env.scene.actors.items() if a.px_body_type != "static"}
    for word, structs in (("actor", moving), ("articulation", env.scene.articulations)):
        kept = {name for state in states for name in getattr(state, f"{word}s")}
        missed |= {f"{word} {name}": "this env has none of this name" for name in kept - set(structs)}
        for name, struct in structs.items():
            targets = [int(i) for i in seams.envs_of(struct) if i in by_env]
            rows = {i: getattr(by_env[i], f"{word}s").get(name) for i in targets}
            width = struct.get_state().shape[1]
            fitting = [i for i in targets if rows[i] is not None and len(rows[i]) == width]
            if len(fitting) < len(targets):
                missed[f"{word} {name}"] = "the snapshot has none of this name and shape: left as it is"
            if not fitting:
                continue
            carried[f"{word} {name}"] = None
            state = torch.from_numpy(np.stack([rows[i] for i in fitting])).to(env.device)
            struct.set_state(state, torch.tensor(fitting, device=env.device))
            if word == "articulation":
                _write_joints(env, struct, name, fitting, by_env)
    seams.apply_and_fetch(env)
    return carried, missed


def _write_joints(
    env: Any, struct: Any, name: str, fitting: list[int], by_env: dict[int, GpuEnvState]
) -> None:
    row_of = dict(zip(seams.envs_of(struct).tolist(), struct._data_index.tolist(), strict=True))
    index = torch.tensor([row_of[i] for i in fitting], device=env.device)
    for k, tensor in enumerate(_joint_tensors(env)):
        rows = np.stack([by_env[i].joints[name][k] for i in fitting])
        width = min(rows.shape[1], tensor.shape[1])  # padded to the widest articulation of its scene
        tensor[index, :width] = torch.from_numpy(rows[:, :width]).to(env.device)


def _joint_tensors(env: Any) -> list[torch.Tensor]:
    return [getattr(env.scene.px, f"cuda_articulation_{name}").torch() for name in _JOINT_TENSORS]
