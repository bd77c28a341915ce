"""What a task remembers between steps, on itself, its robots and their controllers; found, read, put back.

A simulator's state is not a task's. The best distance so far, the stage of each env, a target pose that
a controller goes after: tasks keep these as attributes, and ManiSkill's ``get_state_dict`` knows nothing of them.
Nobody declares them either, so they are found: every attribute of the env, of its agents and of their
controllers is looked at, through dicts, lists, tuples, dataclasses, ManiSkill's Poses and objects of classes that
the author wrote beside the task. What belongs to ManiSkill, SAPIEN, gymnasium or torch (scenes, actors,
sensors, spaces) is not entered, and neither are BaseEnv's own members.

*Rows.* A tensor, an array or a list of plain values whose first dimension is the number of envs has one row
an env, and the rows of chosen envs are copied. Anything else (a counter, a threshold) holds for the whole
batch, so it is put back only when the whole batch is.

*State or scene?* ``self.peg_half_sizes`` has a row an env too, but it describes pegs that were built, and
copying env 3's row to env 7 would not change env 7's peg. The difference is when it was written: what has not
changed since the scene was built (`note_scene`, called by the batched env) belongs to the scene. It is not
copied, and if it has changed by the time of the restore, it gets back the value that it was built with.
Where nobody noted that (GPU simulation), everything counts as state.

*New tensors.* A value is put back as a new tensor, never written into the old one, which may be somebody
else's: a controller's target is often the caller's action array itself. Two attributes that were one tensor
stay one. What cannot be carried is named, with the reason.
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import textwrap
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import torch
from mani_skill.agents.base_agent import BaseAgent
from mani_skill.agents.controllers.base_controller import BaseController
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils.structs.pose import Pose

PLAIN = (bool, int, float, complex, str, bytes, type(None), np.generic)
"""Values that cannot change, so that keeping them is a copy."""
_ENTERED = (
    *PLAIN,
    *(torch.Tensor, np.ndarray, Pose, dict, list, tuple),
    *(torch.nn.Module, torch.Generator, np.random.Generator, np.random.RandomState, set, bytearray),
)
"""What may hold state, whoever made it; those of the last row cannot be kept, and are named instead."""
_NOT_ENTERED = (
    *("mani_skill", "sapien", "gymnasium", "torch", "numpy", "trimesh", "transforms3d", "builtins"),
    *("_thread", "weakref", "functools", "pathlib", "workbench"),
)
"""Packages whose objects belong to the simulation or hold no state of an episode."""
_LARGEST_OF_BATCH = 1 << 16
"""Elements of a tensor that holds for the whole batch; more than that is data, which nobody rewinds."""
_DEEPEST = 8
_SIMULATION_TENSORS = (
    "cuda_rigid_body_data",
    "cuda_articulation_qpos",
    "cuda_articulation_qvel",
    "cuda_articulation_qf",
    "cuda_articulation_target_qpos",
    "cuda_articulation_target_qvel",
)


@dataclass(frozen=True)
class Buffer:
    """One value that was found, as it was."""

    values: Any
    """Rows of the chosen envs (numpy array, or list of plain values), or the value for the whole batch."""
    per_env: bool
    dtype: torch.dtype | None
    """Of a tensor; None for what is none."""


@dataclass(frozen=True)
class TaskState:
    """What a task, its robots and their controllers remembered."""

    buffers: dict[str, Buffer]
    """What was written since the scene was built, by path: ``best_distance``, ``agent.controllers['pd_ee_delta_pos'].controllers['arm']._target_qpos``, ``stages['reach']``."""
    built: frozenset[str]
    """Paths of what was there when the scene was built."""
    omitted: dict[str, str]
    """Path and reason of what could not be kept."""


@dataclass
class _Found:
    """A value at the end of a path, and how to put another in its place."""

    path: str
    value: Any
    put: Callable[[Any], None]


@dataclass
class _Walk:
    """One look over everything that a task remembers."""

    env: BaseEnv
    author: str
    """Module of the task's class: what is defined beside it is entered."""
    leaves: list[_Found] = field(default_factory=list)
    omitted: dict[str, str] = field(default_factory=dict)
    entered: dict[int, Any] = field(default_factory=dict)
    """Objects that were met, by ``id``: held, and not entered a second time."""
    owners: dict[str, Any] = field(default_factory=dict)
    """Objects whose attributes were looked at, by path."""
    built: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Plain attributes that need no look if they are still the same, by the path of their owner."""
    simulation: frozenset[int] = frozenset()
    """Where the simulation's own tensors lie: an attribute that is a view of one is no memory."""


@dataclass(frozen=True)
class _Mark:
    """A value as it was when the scene was built."""

    value: Any
    """The tensor or the plain value itself, a copy of an array or list."""
    version: int
    """How often the tensor had been written, as torch counts."""
    copy: torch.Tensor | None
    """What was in the tensor."""


@dataclass
class _Scene:
    """What was there when a scene was built."""

    marks: dict[str, _Mark] = field(default_factory=dict)
    paths: frozenset[str] = frozenset()
    plain: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Plain attributes, by the path of their owner and their name."""

    def add(self, leaves: list[_Found]) -> None:
        for leaf in leaves:
            self.marks[leaf.path] = _mark(leaf.value)
            owner, _, name = leaf.path.rpartition(".")
            if isinstance(leaf.value, PLAIN) and name.isidentifier():
                self.plain.setdefault(owner, {})[name] = leaf.value
        self.paths = frozenset(self.marks)


_scenes: WeakKeyDictionary[Any, _Scene] = WeakKeyDictionary()


def note_scene(env: BaseEnv) -> None:
    """Remember what the task holds now, right after its scene was built, as belonging to the scene."""
    _scenes[env.scene] = scene = _Scene()
    scene.add(_look_over(env).leaves)


def note_constructed(env: BaseEnv) -> None:
    """Remember the plain values that the task's ``__init__`` set after BaseEnv's, as belonging to the scene.

    An env made of the edited file would otherwise be given the old file's ``self.threshold = 0.02``.
    """
    scene = _scenes.setdefault(env.scene, _Scene())
    scene.add([leaf for leaf in _look_over(env).leaves if isinstance(leaf.value, (*PLAIN, tuple))])


def read_task_state(env: BaseEnv, env_idx: list[int]) -> TaskState:
    """Copies of what the task remembers about the envs in `env_idx`, and of what holds for the batch."""
    walk = _look_over(env)
    scene = _scenes.get(env.scene, _Scene())
    chosen = np.array(env_idx, dtype=np.int64)
    rows: Any = slice(None) if env_idx == list(range(env.num_envs)) else torch.from_numpy(chosen)
    buffers: dict[str, Buffer] = {}
    omitted = dict(walk.omitted)
    for leaf in walk.leaves:
        value = leaf.value
        if not _changed(value, scene.marks.get(leaf.path)):
            continue
        per_env = _is_per_env(value, env.num_envs)
        if isinstance(value, torch.Tensor):
            if per_env:
                kept = value.detach()[rows]
            elif value.numel() <= _LARGEST_OF_BATCH:
                kept = value.detach()
            else:
                omitted[leaf.path] = f"a tensor {tuple(value.shape)} that has no row for each env"
                continue
            kept = kept.float() if kept.dtype == torch.bfloat16 else kept
            # Always a copy: `rows` may be a slice, and `.cpu()` gives the tensor itself when it is there.
            buffers[leaf.path] = Buffer(kept.cpu().numpy().copy(), per_env, value.dtype)
        elif isinstance(value, np.ndarray):
            buffers[leaf.path] = Buffer(value[chosen] if per_env else value.copy(), per_env, None)
        elif isinstance(value, list):
            buffers[leaf.path] = Buffer(
                [value[i] for i in env_idx] if per_env else value.copy(), per_env, None
            )
        else:
            buffers[leaf.path] = Buffer(value, False, None)
    return TaskState(buffers, scene.paths, omitted)


def write_task_state(
    env: BaseEnv, state: TaskState, env_idx: list[int], positions: list[int], whole: bool
) -> tuple[dict[str, None], dict[str, str]]:
    """Put row ``positions[k]`` of every buffer into env ``env_idx[k]``.

    Args:
        whole: all envs are put back where they were: what holds for the whole batch is put back too.

    Returns:
        Paths that were carried, and paths that were not with the reason.
    """
    walk = _look_over(env, state.buffers)
    scene = _scenes.get(env.scene, _Scene())
    carried: dict[str, None] = {}
    missed = dict(state.omitted)
    all_envs = sorted(env_idx) == list(range(env.num_envs))
    replaced: dict[int, Any] = {}
    here = set()
    for leaf in walk.leaves:
        here.add(leaf.path)
        kept, value, chosen = state.buffers.get(leaf.path), leaf.value, positions
        if kept is None:
            mark = scene.marks.get(leaf.path)
            if not _changed(value, mark):
                continue
            if mark is None or leaf.path not in state.built:
                # A controller's start and step exist from its first action on, and mean nothing before it.
                if _is_per_env(value, env.num_envs) and not leaf.path.startswith("agent."):
                    missed[leaf.path] = "the snapshot has none of this name: left as it is"
                continue
            kept, chosen = _as_built(mark, env.num_envs), env_idx
        if id(value) in replaced and isinstance(value, (torch.Tensor, np.ndarray)):
            leaf.put(replaced[id(value)][1])
            carried[leaf.path] = None
            continue
        if not kept.per_env:
            if whole:
                leaf.put(_as_found(kept, env))
                carried[leaf.path] = None
            elif not _equal(kept.values, value):
                missed[leaf.path] = "it holds for the whole batch, and not all envs were put back"
            continue
        new = _with_rows(value, kept, env, env_idx, chosen, all_envs)
        if isinstance(new, str):
            missed[leaf.path] = new
            continue
        # The old value is held, or its id could be the id of a new tensor.
        replaced[id(value)] = value, new
        leaf.put(new)
        carried[leaf.path] = None
    for path, kept in state.buffers.items():
        if path in here:
            continue
        owner, _, name = path.rpartition(".")
        # A class's default (controllers have None) shows that the attribute is only not set yet.
        if owner in walk.owners and hasattr(type(walk.owners[owner]), name) and all_envs:
            value = (
                _with_rows(None, kept, env, env_idx, positions, True)
                if kept.per_env
                else _as_found(kept, env)
            )
            object.__setattr__(walk.owners[owner], name, value)
            carried[path] = None
        else:
            missed[path] = "the task has none of this name now"
    return carried, missed


def _with_rows(
    value: Any, kept: Buffer, env: BaseEnv, env_idx: list[int], positions: list[int], all_envs: bool
) -> Any:
    """A copy of `value` with the rows put in, or a sentence that says why there is none."""
    if isinstance(kept.values, list):
        rows = [kept.values[k] for k in positions]
        if isinstance(value, list) and len(value) == env.num_envs:
            new: Any = list(value)
        elif all_envs:
            new = [None] * env.num_envs
        else:
            return "it is no list with an entry for each env now"
        for i, row in zip(env_idx, rows, strict=True):
            new[i] = row
        return new
    array = kept.values[positions]
    if kept.dtype is None:
        if (
            isinstance(value, np.ndarray)
            and value.shape[1:] == array.shape[1:]
            and len(value) == env.num_envs
        ):
            new = value.copy()
        elif all_envs:
            new = np.empty((env.num_envs, *array.shape[1:]), dtype=array.dtype)
        else:
            return f"it had shape (N, {_shape(array)}) and is another thing now"
        new[env_idx] = array
        return new
    if isinstance(value, torch.Tensor) and value.shape == (env.num_envs, *array.shape[1:]):
        new = value.detach().clone(memory_format=torch.contiguous_format)
    elif all_envs and not isinstance(value, torch.Tensor):
        new = torch.empty((env.num_envs, *array.shape[1:]), dtype=kept.dtype, device=env.device)
    else:
        return f"it had shape (N, {_shape(array)}) and is another thing now"
    index = torch.tensor(env_idx, device=new.device)
    new[index] = torch.from_numpy(array).to(device=new.device, dtype=new.dtype)
    return new


def _shape(rows: np.ndarray) -> str:
    return ", ".join(map(str, rows.shape[1:]))


def _as_found(kept: Buffer, env: BaseEnv) -> Any:
    if kept.dtype is not None:
        return torch.from_numpy(kept.values.copy()).to(device=env.device, dtype=kept.dtype)
    return kept.values.copy() if isinstance(kept.values, (np.ndarray, list)) else kept.values


def _as_built(mark: _Mark, num_envs: int) -> Buffer:
    if mark.copy is not None:
        return Buffer(mark.copy.cpu().numpy(), _is_per_env(mark.copy, num_envs), mark.copy.dtype)
    return Buffer(mark.value, _is_per_env(mark.value, num_envs), None)


# --- finding ---------------------------------------------------------------------------------------


def _look_over(env: BaseEnv, wanted: Collection[str] = ()) -> _Walk:
    """Everything that may have changed since the scene was built, and what is at the paths in `wanted`."""
    task: Any = getattr(env, "_workbench_task", type(env))
    scene = _scenes.get(env.scene, _Scene())
    walk = _Walk(env, task.__module__, built=scene.plain)
    for path in scene.paths.intersection(wanted):
        owner, _, name = path.rpartition(".")
        if name in walk.built.get(owner, {}):
            # Unchanged here, but another value is to be put.
            walk.built = {**walk.built, owner: {n: v for n, v in walk.built[owner].items() if n != name}}
    walk.entered[id(env)] = env
    walk.simulation = frozenset(
        array.torch().untyped_storage().data_ptr()
        for array in (getattr(env.scene.px, name, None) for name in _SIMULATION_TENSORS)
        if array is not None
    )
    _enter_members(walk, env, "", base_env_members(), 0)
    return walk


def _enter(walk: _Walk, value: Any, path: str, put: Callable[[Any], None], depth: int) -> None:
    if isinstance(value, PLAIN):
        walk.leaves.append(_Found(path, value, put))
        return
    if isinstance(value, (torch.Tensor, np.ndarray)):
        if isinstance(value, torch.Tensor) and value.untyped_storage().data_ptr() in walk.simulation:
            return
        if isinstance(value, np.ndarray) and value.dtype == object:
            walk.omitted[path] = "a numpy array of objects"
        else:
            walk.leaves.append(_Found(path, value, put))
        return
    if isinstance(value, tuple) and all(isinstance(item, PLAIN) for item in value):
        # As plain as its items. A list of them is one leaf too, but can be an env's each.
        walk.leaves.append(_Found(path, value, put))
        return
    if id(value) in walk.entered:
        return
    walk.entered[id(value)] = value
    if depth > _DEEPEST:
        walk.omitted[path] = f"more than {_DEEPEST} containers deep"
    elif isinstance(value, Pose):
        # A Pose is frozen, so another takes its place; torch may hold on to the old one.
        _enter(walk, value.raw_pose, f"{path}.raw_pose", lambda raw: put(Pose(raw)), depth + 1)
    elif isinstance(value, dict):
        for key, item in list(value.items()):
            if not _is_ignored(type(item), walk.author):
                _enter(walk, item, f"{path}[{key!r}]", _putter(value, key), depth + 1)
    elif isinstance(value, list):
        if all(isinstance(item, PLAIN) for item in value):
            walk.leaves.append(_Found(path, value, put))
        else:
            for i, item in enumerate(value):
                if not _is_ignored(type(item), walk.author):
                    _enter(walk, item, f"{path}[{i}]", _putter(value, i), depth + 1)
    elif isinstance(value, tuple):
        _enter_tuple(walk, value, path, put, depth)
    elif _has_members(type(value), walk.author):
        _enter_members(walk, value, path, frozenset(), depth)
    else:
        walk.omitted[path] = f"a {type(value).__module__}.{type(value).__qualname__}"


def _enter_members(walk: _Walk, owner: Any, path: str, skipped: frozenset[str], depth: int) -> None:
    walk.owners[path] = owner
    built = walk.built.get(path, {})
    for name, value in list(vars(owner).items()):
        # Most members are options and links to the simulation; a path and a way to put cost more than a look.
        if (
            name in skipped
            or (name in built and built[name] is value)
            or _is_ignored(type(value), walk.author)
        ):
            continue
        where = f"{path}.{name}" if path else name
        _enter(walk, value, where, lambda new, n=name: object.__setattr__(owner, n, new), depth + 1)


def _enter_tuple(walk: _Walk, value: tuple, path: str, put: Callable[[Any], None], depth: int) -> None:
    # A tuple cannot be written to: with every item that is put back, a new tuple takes the old one's place.
    items = list(value)

    def put_item(new: Any, i: int) -> None:
        items[i] = new
        put(type(value)(*items) if hasattr(value, "_fields") else type(value)(items))

    for i, item in enumerate(value):
        if not _is_ignored(type(item), walk.author):
            _enter(walk, item, f"{path}[{i}]", lambda new, i=i: put_item(new, i), depth + 1)


def _putter(container: Any, key: Any) -> Callable[[Any], None]:
    return lambda new: container.__setitem__(key, new)


@lru_cache(maxsize=4096)
def _has_members(cls: type, author: str) -> bool:
    """Whether an object's attributes are looked at: robots, controllers, what the author wrote, dataclasses."""
    if issubclass(cls, (BaseAgent, BaseController)):
        return True
    if issubclass(cls, (type, torch.nn.Module)) or not cls.__dictoffset__:
        return False
    return cls.__module__ == author or (
        dataclasses.is_dataclass(cls) and cls.__module__.split(".")[0] not in _NOT_ENTERED
    )


@lru_cache(maxsize=4096)
def _is_ignored(cls: type, author: str) -> bool:
    """Whether an object is neither entered nor worth a word: upstream's, or code."""
    if issubclass(cls, _ENTERED) or _has_members(cls, author):
        return False
    return cls.__module__.split(".")[0] in _NOT_ENTERED or any("__call__" in vars(c) for c in cls.__mro__)


@lru_cache(maxsize=1)
def base_env_members() -> frozenset[str]:
    """The attributes that ManiSkill's BaseEnv sets on itself: read off its source, ``self.NAME = ...``.

    They are the env's options, spaces, sensors, last observation and generators, which are either not
    state or are put back by name (elapsed steps, generators). ``agent`` is entered.
    """
    tree = ast.parse(textwrap.dedent(inspect.getsource(BaseEnv)))
    targets = (node for node in ast.walk(tree) if isinstance(node, ast.Attribute))
    names = {
        node.attr
        for node in targets
        if isinstance(node.ctx, ast.Store) and isinstance(node.value, ast.Name) and node.value.id == "self"
    }
    ours = {"_kept_controllers", "observation_space", "single_observation_space", "segmentation_id_map"}
    return frozenset(names | ours) - {"agent"}


# --- comparing -------------------------------------------------------------------------------------


def _is_per_env(value: Any, num_envs: int) -> bool:
    if isinstance(value, (torch.Tensor, np.ndarray)):
        return value.ndim > 0 and value.shape[0] == num_envs
    return isinstance(value, list) and len(value) == num_envs


def _mark(value: Any) -> _Mark:
    if isinstance(value, torch.Tensor):
        copy = value.detach().clone()
        return _Mark(value, _version(value), copy.float() if copy.dtype == torch.bfloat16 else copy)
    return _Mark(value.copy() if isinstance(value, (np.ndarray, list)) else value, 0, None)


def _changed(value: Any, mark: _Mark | None) -> bool:
    """Whether a value was written since its mark; what was not there then has been."""
    if mark is None:
        return True
    if value is mark.value and isinstance(value, PLAIN):
        return False
    if isinstance(value, torch.Tensor):
        return value is not mark.value or _version(value) != mark.version
    return not _equal(value, mark.value)


def _version(tensor: torch.Tensor) -> int:
    return 0 if tensor.is_inference() else tensor._version


def _equal(a: Any, b: Any) -> bool:
    if type(a) is not type(b):
        return False
    if isinstance(a, np.ndarray):
        return a.shape == b.shape and a.tobytes() == b.tobytes()
    return a is b or a == b
