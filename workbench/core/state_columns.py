"""What a recording keeps of every env beside its poses: the simulation's state and the state observation, as columns.

A dataset is asked for both: the observation is what a policy is trained on, and the state is what puts an episode back
(``env.set_state_dict``). ManiSkill has them as nested dicts of tensors; what crosses a pipe and lands in a file is
flat and numpy. So here they become one dict of arrays with names: ``state/actors/cube`` (N, 13),
``state/articulations/panda`` (N, 13 + 2 * joints), both as ``get_state_dict`` lays them out, and ``obs/agent/qpos`` (N, ...)
by the names that the task gave them.

Three things are not as they are in ManiSkill. What only some envs have is NaN in the others (there the tensor has
fewer rows than envs, and ``RecordEpisode`` records no state at all). A flattened observation (``obs_mode="state"``) is
taken apart by the names that it was flattened from, where they can be told; else it is one array, ``obs/``. And
pictures are left out: a recording has its own, of all cameras, encoded.

On a GPU each tensor that is fetched by itself waits for the device; so all of them go in one copy.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from workbench.core import seams
from workbench.core.inspect_env import names_of_flat
from workbench.core.state_names import OBS, STATE
from workbench.core.task_env import TaskEnv, flat_entries, to_numpy

_PICTURES = ("sensor_data", "sensor_param", "pointcloud")
"""Parts of an observation that are made of pictures."""


def read_state_columns(task: TaskEnv) -> dict[str, NDArray]:
    """The columns of the present moment, (N, ...) each; copies. About 0.3 ms for 16 PickCube envs.

    Raises:
        Exception: whatever a ``get_state_dict`` of the author's own raises.
    """
    return {**_fetched(task, _env_states(task)), **_fetched(task, _observation(task))}


def _env_states(task: TaskEnv) -> Iterator[tuple[str, torch.Tensor]]:
    env = task.env
    state: Any = env.get_state_dict()
    registry = env.scene.state_dict_registry
    structs = {"actors": registry.actors, "articulations": registry.articulations}
    for name, value in flat_entries(state):
        if not isinstance(value, torch.Tensor):
            continue
        if len(value) != task.num_envs:
            group, _, own = name.partition("/")
            struct = structs.get(group, {}).get(own)
            if struct is None:
                continue
            rows = torch.as_tensor(seams.envs_of(struct), device=value.device)
            if len(rows) != len(value) or len(torch.unique(rows)) != len(rows):
                continue
            whole = value.new_full((task.num_envs, *value.shape[1:]), torch.nan)
            whole[rows] = value
            value = whole
        yield STATE + name, value


def _observation(task: TaskEnv) -> Iterator[tuple[str, Any]]:
    obs = task.obs
    if obs is None:
        return
    if not isinstance(obs, Mapping):
        obs = {"": obs}
    for name, value in flat_entries({k: v for k, v in obs.items() if k not in _PICTURES}):
        if len(getattr(value, "shape", ())) < 1 or len(value) != task.num_envs:
            continue
        parts = names_of_flat(task, value) if name in ("", "state") else None
        if parts is None:
            yield OBS + name, value
            continue
        at = 0
        for part, shape, _ in parts:
            width = int(np.prod(shape, dtype=int))
            yield OBS + part, value[:, at : at + width].reshape(task.num_envs, *shape)
            at += width


def _fetched(task: TaskEnv, named: Iterator[tuple[str, Any]]) -> dict[str, NDArray]:
    values = dict(named)
    if task.env.device.type == "cpu":
        return {name: np.array(to_numpy(value)) for name, value in values.items()}
    columns: dict[str, NDArray] = {}
    by_type: dict[torch.dtype, list[str]] = {}
    for name, value in values.items():
        columns[name] = np.empty(0)  # keeps the order
        if isinstance(value, torch.Tensor):
            by_type.setdefault(value.dtype, []).append(name)
        else:
            columns[name] = np.array(value)
    for names in by_type.values():
        rows = [values[name].reshape(task.num_envs, -1) for name in names]
        together = torch.cat(rows, dim=1).cpu().numpy()
        ends = np.cumsum([row.shape[1] for row in rows])[:-1]
        for name, column in zip(names, np.split(together, ends, axis=1), strict=True):
            columns[name] = np.ascontiguousarray(column).reshape(tuple(values[name].shape))
    return columns
