"""Simulation state and state observation of all envs, as named columns for a recording."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import torch
from mani_skill.envs.sapien_env import BaseEnv
from numpy.typing import NDArray

from workbench.envs import maniskill_private
from workbench.envs.evaluate_entries import flat_entries
from workbench.envs.recorded_run import OBS, STATE
from workbench.envs.scene.scene_index import StateRows, in_every_env, scene_index, state_rows
from workbench.envs.snapshots.snapshot import remembering
from workbench.envs.task_env import TaskEnv, to_numpy

_PICTURES = ("sensor_data", "sensor_param", "pointcloud")
"""Parts of an observation that consist of pictures."""


def read_state_columns(task: TaskEnv) -> dict[str, NDArray]:
    """The columns of the present moment, (N, ...) each; copies. About 0.1 ms for 16 PickCube envs.

    ``state/actors/cube`` (N, 13) and ``state/articulations/panda`` (N, 13 + 2 * joints) as ``get_state_dict``
    lays them out, ``obs/agent/qpos`` (N, ...) by the task's names. Unlike in ManiSkill, the row of a body
    that an env lacks is NaN (ManiSkill's tensor has fewer rows, and ``RecordEpisode`` then records no state).
    A flattened observation is split into its named parts; if their names are not known, it is one column
    ``obs/``. Pictures are left out: a recording stores them separately.

    Raises:
        Exception: raised by the task's own ``get_state_dict``.
    """
    return copy_states(task).columns()


@dataclass(frozen=True)
class StateReading:
    """Copies from which the columns of one moment are made."""

    rows: StateRows | None
    asked: dict[str, Any]
    """Columns that are not made from `rows`, and flattened observations."""
    flat: dict[str, Any]
    """Parts of each flattened observation, from `flat_names`."""
    num_envs: int
    device: torch.device

    def columns(self) -> dict[str, NDArray]:
        """Columns as `read_state_columns` returns them."""
        states = {} if self.rows is None else self.rows.states()
        values = {**{STATE + name: value for name, value in states.items()}, **self.asked}
        columns: dict[str, NDArray] = {}
        for name, column in _fetched(values, self.num_envs, self.device).items():
            parts = self.flat.get(name)
            if parts is None:
                columns[name] = column
            else:
                columns.update({OBS + part: numbers for part, numbers, _ in split_flat(parts, column)})
        return columns


def copy_states(task: TaskEnv) -> StateReading:
    """Copy the present moment; ``columns()`` then does the slow part. Raises like `read_state_columns`."""
    rows, asked = _read(task.env)
    values: dict[str, Any] = {STATE + name: value for name, value in asked.items()}
    values.update(_observed(task))
    flat = {name: flat_names(task, values[name]) for name in (OBS, OBS + "state") if name in values}
    for name, value in values.items():
        if isinstance(value, torch.Tensor):
            values[name] = to_numpy(value) if value.is_cpu else value.clone()
    return StateReading(rows, values, flat, task.num_envs, task.env.device)


def env_states(env: BaseEnv) -> dict[str, Any]:
    """(N, D) by name: ``actors/cube``, ``articulations/panda``, and ``controller/...`` where a controller has a state.

    Copies: tensors, or arrays on the CPU. ManiSkill's ``get_state_dict`` gives the same values to the last
    bit (tested), but reads each actor and articulation in turn (75 us for the four in PickCube). A task's own
    ``get_state_dict`` is called instead."""
    rows, asked = _read(env)
    return asked if rows is None else {**rows.states(), **asked}


def _read(env: BaseEnv) -> tuple[StateRows | None, dict[str, Any]]:
    """Rows of the simulation, and the values that `env_states` adds to them."""
    if type(env).get_state_dict is not BaseEnv.get_state_dict or not env.scene.gpu_sim_enabled:
        whole: Any = env.get_state_dict()
        known = scene_index(env).states
        return None, {n: in_every_env(env, known.get(n), value) for n, value in flat_entries(whole)}
    controllers: Any = {} if env.agent is None else env.agent.get_controller_state()
    return state_rows(env), dict(flat_entries(controllers, "controller"))


def _observed(task: TaskEnv) -> Iterator[tuple[str, Any]]:
    """Yield the name (``obs/...``) and the value (N, ...) of each entry of the last observation. Leaves out pictures, and
    entries without a row for each env."""
    for name, value in flat_entries(task.obs):
        shape = () if name.partition("/")[0] in _PICTURES else getattr(value, "shape", ())
        if len(shape) > 0 and shape[0] == task.num_envs:
            yield OBS + name, value


def _fetched(values: Mapping[str, Any], count: int, device: torch.device) -> dict[str, NDArray]:
    """Values on the host, in one copy per dtype: on a GPU each single fetch waits for the device."""
    if device.type == "cpu":
        # On the CPU, arrays are copies already.
        return {
            name: value if isinstance(value, np.ndarray) else to_numpy(value)
            for name, value in values.items()
        }
    columns: dict[str, NDArray] = {}
    by_type: dict[torch.dtype, list[str]] = {}
    for name, value in values.items():
        columns[name] = np.empty(0)  # keeps the order
        if isinstance(value, torch.Tensor):
            by_type.setdefault(value.dtype, []).append(name)
        else:
            columns[name] = np.array(value)
    for names in by_type.values():
        rows = [values[name].reshape(count, -1) for name in names]
        together = torch.cat(rows, dim=1).cpu().numpy()
        ends = np.cumsum([row.shape[1] for row in rows])[:-1]
        for name, column in zip(names, np.split(together, ends, axis=1), strict=True):
            columns[name] = np.ascontiguousarray(column).reshape(tuple(values[name].shape))
    return columns


# --- names of a flattened observation ----------------------------------------------------------------


_layouts: WeakKeyDictionary[Any, tuple[type, int, list[tuple[str, tuple[int, ...], str]] | None]] = (
    WeakKeyDictionary()
)


def flat_names(task: TaskEnv, flat: Any) -> list[tuple[str, tuple[int, ...], str]] | None:
    """Name, shape and dtype of each part of a flattened observation (N, D), or None if they are not known.

    ManiSkill drops the names, so the env is observed once more without flattening. That runs the author's
    hooks, which may draw random numbers or increase a counter. So the env is observed only once per version of the task,
    and the task's memory is restored afterwards.
    """
    env = task.env
    if not isinstance(flat, torch.Tensor) or flat.ndim != 2 or not env.obs_mode_struct.state:
        return None
    known = _layouts.get(env)
    # A reload may put another class on an env that stays.
    if known is None or known[:2] != (type(env), flat.shape[1]):
        known = (type(env), flat.shape[1], _find_names(task, flat.shape[1]))
        _layouts[env] = known
    return known[2]


def split_flat(
    names: list[tuple[str, tuple[int, ...], str]], numbers: NDArray
) -> Iterator[tuple[str, NDArray, str]]:
    """Split a flattened observation (..., D) by `names` from `flat_names`; yields name, numbers (..., *shape)
    and dtype."""
    at = 0
    for name, shape, dtype in names:
        width = math.prod(shape)
        yield name, numbers[..., at : at + width].reshape(*numbers.shape[:-1], *shape), dtype
        at += width


def _find_names(task: TaskEnv, width: int) -> list[tuple[str, tuple[int, ...], str]] | None:
    env = task.env
    if maniskill_private.why_not(maniskill_private.NAMED_STATE):
        return None
    with remembering(env):
        obs = maniskill_private.unflattened_state(env, env.get_info())
    parts = []
    for name, value in flat_entries(obs):
        if isinstance(value, torch.Tensor) and value.nelement():
            parts.append((name, tuple(value.shape[1:]) or (1,), _dtype(value)))
    # A task may flatten in its own way; wrong names would be worse than none.
    return parts if sum(int(np.prod(shape, dtype=int)) for _, shape, _ in parts) == width else None


def _dtype(value: torch.Tensor) -> str:
    return str(value.dtype).removeprefix("torch.")
