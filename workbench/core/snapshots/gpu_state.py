"""Simulation state of chosen envs of ManiSkill's GPU simulation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from workbench.core import maniskill_private
from workbench.core.scene.scene_index import in_every_env, present_states, scene_index
from workbench.core.simulation.state_layout import BODY

_JOINT_TENSORS = ("qf", "target_qpos", "target_qvel")
"""Of an articulation, in addition to ``get_state()``: ``px.cuda_articulation_NAME``."""


@dataclass(frozen=True)
class GpuState:
    """The simulation state of n envs: the tensors that ManiSkill reads and writes, by name.

    What PhysX keeps on the device besides them (contacts, sleep) is out of reach.
    """

    states: dict[str, NDArray[np.float32]]
    """(n, 13) of each actor: position, quaternion wxyz, linear and angular velocity; (n, 13 + 5 D) of each articulation:
    the same of the root, then qpos, qvel, and `_JOINT_TENSORS`. By the names of `SceneIndex.states`; NaN where an env
    lacks it."""


def read_gpu_state(env: Any, env_idx: list[int]) -> GpuState:
    """The simulation state of the envs in `env_idx`."""
    states, structs = present_states(env), scene_index(env).states
    for name, state in states.items():
        width = maniskill_private.joints_of(structs[name])
        tensors = _joint_tensors(env) if width else ()
        rows = [t[maniskill_private.data_rows_of_articulation(structs[name]).long(), :width] for t in tensors]
        every = [torch.as_tensor(state), *(in_every_env(env, structs[name], row) for row in rows)]
        states[name] = torch.hstack(every).cpu().numpy()[env_idx]
    return GpuState(states)


def write_gpu_state(
    env: Any, env_idx: list[int], state: GpuState, positions: list[int]
) -> tuple[dict[str, None], dict[str, str]]:
    """Put env ``positions[j]`` of `state` into env ``env_idx[j]``, apply and fetch; returns as `write_cpu_state`."""
    carried: dict[str, None] = {}
    missed: dict[str, str] = {}
    position, structs = dict(zip(env_idx, positions, strict=True)), scene_index(env).states
    for name, rows in state.states.items():
        if name not in structs and not np.isnan(rows[positions]).all():
            missed[_plain_name(name)] = "this env has none of this name"
    for name, struct in structs.items():
        width = maniskill_private.joints_of(struct)
        kept = state.states.get(name, np.zeros((0, 0), np.float32))
        # Lowest env first, the order of rows in ManiSkill's setters.
        targets = [i for i in maniskill_private.envs_of(struct).tolist() if i in position]
        fits = kept.shape[1] == BODY + (2 + len(_JOINT_TENSORS)) * width
        fitting = [i for i in targets if fits and not np.isnan(kept[position[i]]).any()]
        if len(fitting) < len(targets):
            missed[_plain_name(name)] = "the snapshot has none of this name and shape: left as it is"
        if not fitting:
            continue
        carried[_plain_name(name)] = None
        values = torch.from_numpy(kept[[position[i] for i in fitting]]).to(env.device)
        struct.set_state(values[:, : BODY + 2 * width], torch.tensor(fitting, device=env.device))
        if width:
            own = np.flatnonzero(np.isin(maniskill_private.envs_of(struct), fitting)).tolist()
            index = maniskill_private.data_rows_of_articulation(struct).long()[own]
            parts = values[:, BODY + 2 * width :].split(width, dim=1)
            for tensor, part in zip(_joint_tensors(env), parts, strict=True):
                tensor[index, :width] = part
    maniskill_private.apply_and_fetch(env)
    return carried, missed


def _plain_name(name: str) -> str:
    kind, _, own = name.partition("/")
    return f"{kind.removesuffix('s')} {own}"


def _joint_tensors(env: Any) -> list[torch.Tensor]:
    return [getattr(env.scene.px, f"cuda_articulation_{name}").torch() for name in _JOINT_TENSORS]
