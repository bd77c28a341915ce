"""State that a task keeps between steps in its own attributes and those of its robots and controllers."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import torch
from mani_skill.envs.sapien_env import BaseEnv
from numpy.typing import NDArray

from workbench.envs.scene.scene_index import once_a_scene
from workbench.envs.snapshots.task_attributes import PLAIN, TaskValue, walk_task_values

_MAX_BATCH_ELEMENTS = 1 << 16
"""Size limit of a tensor that holds for the whole batch; a larger one is data, not state."""


class Buffer(NamedTuple):
    """A copy of one value."""

    values: Any
    """Rows of the chosen envs (numpy array or list of plain values), or the value for the whole batch."""
    per_env: bool
    dtype: torch.dtype | None
    """dtype of a tensor; None for other values."""

    def is_as(self, other: Buffer) -> bool:
        """Whether both are equal to the last bit."""
        kind = self.per_env, self.dtype
        return kind == (other.per_env, other.dtype) and _equal(self.values, other.values)


class TaskState(NamedTuple):
    """State that a task, its robots and their controllers keep, and that ManiSkill's ``get_state_dict`` lacks.

    *Rows*: a tensor, array or list of plain values whose first dimension is N has a row per env, and the rows
    of chosen envs are copied. Everything else (a counter, a threshold) holds for the whole batch, and is
    restored only when all envs are restored.

    *State or scene*: ``self.peg_half_sizes`` has a row per env too, but describes pegs that were built. What
    has not changed since the scene was built (`note_scene`) belongs to the scene: it is not copied, and a
    restore sets it to the value that it had then. In GPU simulation nothing is noted, and everything counts
    as state.

    *New tensors*: a value is restored as a new tensor, since something else may use the old one (a
    controller's target is often the caller's action). Two attributes that shared one tensor still share one.
    Values that cannot be carried are listed with the reason.
    """

    buffers: dict[str, Buffer]
    """Values written since the scene was built, by path: ``best_distance``, ``stages['reach']``,
    ``agent.controllers['pd_ee_delta_pos'].controllers['arm']._target_qpos``."""
    built: frozenset[str]
    """Paths that existed when the scene was built."""
    omitted: dict[str, str]
    """State that could not be copied: path and reason."""


@dataclass(frozen=True)
class _BuiltValue:
    """A value at the time when the scene was built."""

    value: Any
    """The object, for comparison by identity."""
    version: int
    """torch's count of writes to a tensor."""
    kept: Buffer
    """Copy of the value's content."""


@dataclass
class _Scene:
    """Values of the task when its scene was built."""

    values: dict[str, _BuiltValue] = field(default_factory=dict)
    paths: frozenset[str] = frozenset()

    def add(self, env: BaseEnv, leaves: list[TaskValue]) -> None:
        for leaf in leaves:
            version = version_of(leaf.value) if isinstance(leaf.value, torch.Tensor) else 0
            self.values[leaf.path] = _BuiltValue(leaf.value, version, _kept(leaf.value, env.num_envs))
        self.paths = frozenset(self.values)


@once_a_scene
def _scene_of(env: BaseEnv) -> _Scene:
    return _Scene()


def note_scene(env: BaseEnv) -> None:
    """Mark the task's present values, right after its scene was built, as part of the scene."""
    _scene_of(env).add(env, walk_task_values(env).leaves)


def note_constructed(env: BaseEnv) -> None:
    """Mark the plain values that the task's ``__init__`` set after ``BaseEnv.__init__`` as part of the scene.

    Without this, a restore into an env of the edited file would write the old file's ``self.threshold = 0.02``.
    """
    plain = [leaf for leaf in walk_task_values(env).leaves if isinstance(leaf.value, (*PLAIN, tuple))]
    _scene_of(env).add(env, plain)


def read_task_state(env: BaseEnv, env_idx: list[int]) -> TaskState:
    """Copies of the task's state: rows of the envs in `env_idx`, and values that hold for the whole batch."""
    walk = walk_task_values(env)
    scene = _scene_of(env)
    buffers: dict[str, Buffer] = {}
    omitted = dict(walk.omitted)
    chosen = None if env_idx == list(range(env.num_envs)) else np.array(env_idx, np.int64)
    for leaf in walk.leaves:
        value = leaf.value
        if not _changed(value, scene.values.get(leaf.path)):
            continue
        whole = isinstance(value, torch.Tensor) and not is_per_env(value, env.num_envs)
        if whole and value.numel() > _MAX_BATCH_ELEMENTS:
            omitted[leaf.path] = f"a tensor {tuple(value.shape)} that has no row for each env"
        else:
            buffers[leaf.path] = _kept(value, env.num_envs, chosen)
    return TaskState(buffers, scene.paths, omitted)


def _kept(value: Any, num_envs: int, env_idx: NDArray[np.int64] | None = None) -> Buffer:
    """A copy of a value, or of its rows of `env_idx` (None: all) if it has a row for each env."""
    per_env, dtype = is_per_env(value, num_envs), None
    if per_env and env_idx is not None:
        value = [value[i] for i in env_idx] if isinstance(value, list) else value[env_idx]
    if isinstance(value, torch.Tensor):
        value, dtype = value.detach(), value.dtype
        value = (value.float() if dtype == torch.bfloat16 else value).cpu().numpy()
    return Buffer(value.copy() if isinstance(value, (np.ndarray, list)) else value, per_env, dtype)


def write_task_state(
    env: BaseEnv, state: TaskState, env_idx: list[int], positions: list[int]
) -> tuple[dict[str, None], dict[str, str]]:
    """Put row ``positions[k]`` of every buffer into env ``env_idx[k]``.

    A value that holds for the whole batch is restored only if all envs are restored.

    Returns:
        Paths that were carried, and paths that were not carried, with the reason.
    """
    walk = walk_task_values(env)
    scene = _scene_of(env)
    carried: dict[str, None] = {}
    missed = dict(state.omitted)
    all_envs = sorted(env_idx) == list(range(env.num_envs))
    replaced: dict[int, Any] = {}
    here = set()
    for leaf in walk.leaves:
        here.add(leaf.path)
        kept, value, chosen = state.buffers.get(leaf.path), leaf.value, positions
        if kept is None:
            built = scene.values.get(leaf.path)
            if not _changed(value, built):
                continue
            if built is None or leaf.path not in state.built:
                # A controller's start and step exist only after its first action.
                if is_per_env(value, env.num_envs) and not leaf.path.startswith("agent."):
                    missed[leaf.path] = "it is not in the snapshot; left unchanged"
                continue
            kept, chosen = built.kept, env_idx
        if id(value) in replaced and isinstance(value, (torch.Tensor, np.ndarray)):
            leaf.put(replaced[id(value)][1])
            carried[leaf.path] = None
            continue
        if not kept.per_env:
            if (
                isinstance(value, (torch.Tensor, np.ndarray))
                and is_per_env(value, env.num_envs)
                and np.ndim(kept.values)
            ):
                missed[leaf.path] = "it had no row for each env, and has one now"
            elif all_envs:
                leaf.put(_whole_value(kept, env))
                carried[leaf.path] = None
            elif not kept.is_as(_kept(value, env.num_envs)):
                missed[leaf.path] = "it holds for the whole batch, and not all envs were restored"
            continue
        new = _with_rows(value, kept, env, env_idx, chosen, all_envs)
        if isinstance(new, str):
            missed[leaf.path] = new
            continue
        # Keep the old value alive, since a new tensor could get its id.
        replaced[id(value)] = value, new
        leaf.put(new)
        carried[leaf.path] = None
    for path, kept in state.buffers.items():
        if path in here:
            continue
        owner, _, name = path.rpartition(".")
        # A default on the class (controllers have None) means that the attribute is not set yet.
        if owner in walk.owners and hasattr(type(walk.owners[owner]), name) and all_envs:
            value = (
                _with_rows(None, kept, env, env_idx, positions, True)
                if kept.per_env
                else _whole_value(kept, env)
            )
            object.__setattr__(walk.owners[owner], name, value)
            carried[path] = None
        else:
            missed[path] = "the task no longer has an attribute of this name"
    return carried, missed


def _with_rows(
    value: Any, kept: Buffer, env: BaseEnv, env_idx: list[int], positions: list[int], all_envs: bool
) -> Any:
    """A copy of `value` with the rows written, or the reason why they cannot be written."""
    listed = isinstance(kept.values, list)
    rows: Any = [kept.values[k] for k in positions] if listed else kept.values[positions]
    kind: Any = list if listed else np.ndarray if kept.dtype is None else torch.Tensor
    shape = (env.num_envs, *np.shape(kept.values)[1:])
    fits = isinstance(value, kind) and is_per_env(value, env.num_envs) and (listed or value.shape == shape)
    # If all envs are restored, the value may be replaced, unless it is a tensor of another shape.
    if not fits and (not all_envs or (kind is torch.Tensor and isinstance(value, kind))):
        if listed:
            return "it is not a list with an entry for each env any more"
        return f"it had shape ({', '.join(['N', *map(str, shape[1:])])}) and has another shape or type now"
    if listed:
        new: Any = list(value) if fits else [None] * env.num_envs
        for i, row in zip(env_idx, rows, strict=True):
            new[i] = row
    elif kept.dtype is None:
        new = value.copy() if fits else np.empty(shape, dtype=rows.dtype)
        new[env_idx] = rows
    else:
        new = value.detach().clone(memory_format=torch.contiguous_format) if fits else None
        new = torch.empty(shape, dtype=kept.dtype, device=env.device) if new is None else new
        new[torch.tensor(env_idx, device=new.device)] = torch.from_numpy(rows).to(new)
    return new


def _whole_value(kept: Buffer, env: BaseEnv) -> Any:
    if kept.dtype is not None:
        return torch.from_numpy(kept.values.copy()).to(device=env.device, dtype=kept.dtype)
    return kept.values.copy() if isinstance(kept.values, (np.ndarray, list)) else kept.values


# --- comparing -------------------------------------------------------------------------------------


def is_per_env(value: Any, num_envs: int) -> bool:
    if isinstance(value, (torch.Tensor, np.ndarray)):
        return value.ndim > 0 and value.shape[0] == num_envs
    return isinstance(value, list) and len(value) == num_envs


def _changed(value: Any, built: _BuiltValue | None) -> bool:
    """Whether a value was written since the scene was built; True if it did not exist then."""
    if built is None:
        return True
    if value is built.value and isinstance(value, PLAIN):
        return False
    if isinstance(value, torch.Tensor):
        return value is not built.value or version_of(value) != built.version
    return type(value) is not type(built.value) or not _equal(value, built.kept.values)


def version_of(tensor: torch.Tensor) -> int:
    """torch's count of writes; negative if torch does not count."""
    return -1 if tensor.is_inference() else tensor._version


def _equal(a: Any, b: Any) -> bool:
    if type(a) is not type(b):
        return False
    if isinstance(a, np.ndarray):
        return (a.shape, a.dtype) == (b.shape, b.dtype) and a.tobytes() == b.tobytes()
    return a is b or a == b
