"""A control step as the few arrays that all of it can be told from later.

A recording keeps forty arrays of a step: poses, states, observations, what ``evaluate`` said. Made one by one while the
envs wait that takes 0.2 ms and more, in code that the processor's caches have just lost to the physics. Nearly all of
it is picked out of a few tensors that the simulation and the task hold anyway. So while stepping only those are asked for, by
reference, for the caller to copy in one go; and the columns are made later, of hundreds of steps in one call each
(`StepRows.columns`), on a thread that has time. They are those of `TaskEnv.result_of` and `read_state_columns`, to the last bit (tested).

What cannot be told later has to be read at once, as those two do: tasks with a ``get_state_dict`` of their own, objects
that only some envs have, simulation on a GPU, where each of these tensors would be a copy of its own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from workbench.core import seams
from workbench.core.entries import split_entries
from workbench.core.env_states import actors_with_states, states_of_steps, told_by_rows
from workbench.core.scene_index import scene_index
from workbench.core.state_columns import observed, parts_of, taken_apart
from workbench.core.state_names import STATE
from workbench.core.step import OtherEntry
from workbench.core.task_env import TaskEnv, flat_entries

ELAPSED = "elapsed"
"""(K, N) the number of each step in its episode: the source that is no column."""
_BODIES, _QPOS, _QVEL, _HIDDEN, _OBS = "bodies", "qpos", "qvel", "hidden/", "obs/"
_EVALUATE, _BATCH, _CONTROLLER = "evaluate/", "batch/", "controller/"


class StepRows:
    """Of one scene of one task. `read` and `learn` belong to the thread that steps; `columns` to any."""

    def __init__(self, task: TaskEnv) -> None:
        """Raises ValueError where the task's steps cannot be told later."""
        self._task, self._table = task, scene_index(task.env)
        if not told_by_rows(task.env) or self._table.rows is None:
            raise ValueError("the states of this task have to be read at once")
        self._rows: NDArray[np.int64] = self._table.rows.numpy()
        self._named = {id(actor): name for name, actor in actors_with_states(task.env).items()}
        if not self._named.keys() <= {id(actor) for actor, _ in self._table.actors}:
            raise ValueError("an actor with a state is not among the bodies")
        self._parts: dict[tuple[str, int], Any] = {}
        self.others: Mapping[str, OtherEntry] = {}
        """Of the step that was read last: what `StepResult.others` would be."""

    def read(
        self, reward: Any, terminated: Any, truncated: Any, info: Mapping[str, Any], action: NDArray
    ) -> list[tuple[str, NDArray]]:
        """The step that was just made, `action` (N, A) included: names, and arrays that are good until the next one."""
        task = self._task
        env = task.env
        px: Any = env.scene.px
        task.obs = obs = seams.last_observation(env)
        count = env.num_envs
        found: list[tuple[str, NDArray]] = [
            (_BODIES, px.cuda_rigid_body_data.torch().numpy()),
            (_QPOS, px.cuda_articulation_qpos.torch().numpy()),
            (_QVEL, px.cuda_articulation_qvel.torch().numpy()),
            (ELAPSED, env.elapsed_steps.numpy()),
            ("action", action),
            ("reward", _batch(reward, count)),
            ("terminated", _batch(terminated, count)),
            ("truncated", _batch(truncated, count)),
        ]
        entries, self.others = split_entries(info, count, copy=False)
        found += [(_EVALUATE + name, values) for name, values in entries.items()]
        found += [
            (_BATCH + name, entry.numbers) for name, entry in self.others.items() if entry.numbers is not None
        ]
        for index, (actor, _) in enumerate(self._table.actors):
            if actor.hidden and (kept := seams.pose_before_hiding(actor)) is not None:
                found.append((f"{_HIDDEN}{index}", _array(kept)))
        if env.agent is not None:
            controllers: Any = env.agent.get_controller_state()
            if controllers:
                found += [
                    (name, _batch(value, count)) for name, value in flat_entries(controllers, _CONTROLLER)
                ]
        if isinstance(obs, torch.Tensor) and obs.ndim == 2:
            found.append((_OBS, _array(obs)))
        else:
            found += [(name, _array(value)) for name, value in observed(task)]
        return found

    def learn(self, found: Sequence[tuple[str, NDArray]]) -> None:
        """Find out whatever `columns` will have to know of steps like `found`, which was read just now. Runs the author's
        hooks, the first time."""
        for name, value in observed(self._task):
            self._parts[name, value.shape[-1]] = parts_of(self._task, name, value)

    def columns(self, held: Mapping[str, NDArray]) -> dict[str, NDArray]:
        """(K, N, ...) of every column of K steps, from what `read` gave, each (K, ...); in the order of `batch_columns`."""
        table, bodies = self._table, held[_BODIES]
        steps = len(bodies)
        shape = (steps, len(table.entities))
        poses = np.repeat(table.fixed[None], steps, axis=0)
        flat = poses.reshape(steps, -1, 7)
        flat[:, table.slots] = bodies[:, self._rows, :7]
        hidden: dict[str, NDArray] = {}
        for name, kept in held.items():
            if name.startswith(_HIDDEN):
                index = int(name[len(_HIDDEN) :])
                actor, slots = table.actors[index]
                true = np.broadcast_to(kept.reshape(steps, -1, 7), (steps, len(slots), 7))
                flat[:, slots[slots >= 0]] = true[:, slots >= 0]
                if id(actor) in self._named:
                    hidden[self._named[id(actor)]] = true
        columns: dict[str, NDArray] = {
            "poses": poses,
            "action": held["action"].reshape(*shape, -1),
            "reward": held["reward"].astype(np.float32),
            "terminated": held["terminated"].astype(np.bool_),
            "truncated": held["truncated"].astype(np.bool_),
        }
        for name, values in held.items():
            if name.startswith(_EVALUATE):
                columns[name] = values
        for name, values in held.items():
            if name.startswith(_BATCH):
                columns[name] = np.broadcast_to(values[:, None], (*shape, *values.shape[1:]))
        states = states_of_steps(self._task.env, bodies, held[_QPOS], held[_QVEL], hidden)
        columns.update((STATE + name, values) for name, values in states.items())
        for name, values in held.items():
            if name.startswith(_CONTROLLER):
                columns[STATE + name] = values
        for name, values in held.items():
            if name.startswith(_OBS):
                columns.update(taken_apart(name, values, self._parts.get((name, values.shape[-1]))))
        return columns


def _batch(value: Any, count: int) -> NDArray:
    array = _array(value)
    # One value for all envs, as some tasks give, is repeated for each.
    return array if array.ndim and len(array) == count else np.broadcast_to(array, (count, *array.shape))


def _array(value: Any) -> NDArray:
    if isinstance(value, torch.Tensor):
        return value.detach().numpy() if value.requires_grad else value.numpy()
    return np.asarray(value)
