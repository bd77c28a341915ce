"""Finds every attribute in which a task may keep state."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from mani_skill.agents.base_agent import BaseAgent
from mani_skill.agents.controllers.base_controller import BaseController
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils.structs.pose import Pose

from workbench.envs.maniskill_private import task_class
from workbench.envs.simulation.strict_system import TENSORS
from workbench.machine.versions import stored_names

PLAIN = (bool, int, float, complex, str, bytes, type(None), np.generic)
"""Immutable values, which need no copy."""
_ENTERED_TYPES = (
    *PLAIN,
    *(torch.Tensor, np.ndarray, Pose, dict, list, tuple),
    *(torch.nn.Module, torch.Generator, np.random.Generator, np.random.RandomState, set, bytearray),
)
"""Types that may hold state; the types in the last row cannot be copied: `Walk.omitted` lists
such objects."""
_SKIPPED_PACKAGES = (
    *("mani_skill", "sapien", "gymnasium", "torch", "numpy", "trimesh", "transforms3d", "builtins"),
    *("_thread", "weakref", "functools", "pathlib", "workbench"),
)
"""Packages whose objects belong to the simulation or hold no state of an episode."""
_MAX_DEPTH = 8


@dataclass
class TaskValue:
    """A value with its path, and a function that replaces it."""

    path: str
    value: Any
    put: Callable[[Any], None]


@dataclass
class Walk:
    """One walk over all values that a task stores between hooks."""

    env: BaseEnv
    author: str
    """Module of the task's class: attributes of objects whose class is from this module are searched too."""
    leaves: list[TaskValue] = field(default_factory=list)
    omitted: dict[str, str] = field(default_factory=dict)
    entered: dict[int, Any] = field(default_factory=dict)
    """Objects that were searched, by ``id``: kept alive, and not searched again."""
    owners: dict[str, Any] = field(default_factory=dict)
    """Objects whose attributes were read, by path."""
    simulation: frozenset[int] = frozenset()
    """Addresses of the simulation's tensors, since a view of one is not state of the task."""


def walk_task_values(env: BaseEnv) -> Walk:
    """Find everything that a task may remember.

    Searches the env, its agents and their controllers, through dicts, lists, tuples, dataclasses, Poses and
    objects of classes in the task's module. Skips objects of ManiSkill, SAPIEN, gymnasium or torch, and
    BaseEnv's members.
    """
    walk = Walk(env, task_class(env).__module__)
    walk.entered[id(env)] = env
    walk.simulation = frozenset(
        array.torch().untyped_storage().data_ptr()
        for array in (getattr(env.scene.px, name, None) for name in TENSORS)
        if array is not None
    )
    _enter_members(walk, env, "", base_env_members(), 0)
    return walk


def _enter(walk: Walk, value: Any, path: str, put: Callable[[Any], None], depth: int) -> None:
    if isinstance(value, PLAIN):
        walk.leaves.append(TaskValue(path, value, put))
        return
    if isinstance(value, (torch.Tensor, np.ndarray)):
        if isinstance(value, torch.Tensor) and value.untyped_storage().data_ptr() in walk.simulation:
            return
        if isinstance(value, np.ndarray) and value.dtype == object:
            walk.omitted[path] = "a numpy array of objects"
        else:
            walk.leaves.append(TaskValue(path, value, put))
        return
    if isinstance(value, tuple) and all(isinstance(item, PLAIN) for item in value):
        # A tuple is as immutable as its items. A list of plain values is one leaf too, but may have a row for each env.
        walk.leaves.append(TaskValue(path, value, put))
        return
    if id(value) in walk.entered:
        return
    walk.entered[id(value)] = value
    if depth > _MAX_DEPTH:
        walk.omitted[path] = f"more than {_MAX_DEPTH} containers deep"
    elif isinstance(value, Pose):
        # A Pose is frozen, so a new one replaces it.
        _enter(walk, value.raw_pose, f"{path}.raw_pose", lambda raw: put(Pose(raw)), depth + 1)
    elif isinstance(value, dict):
        for key, item in list(value.items()):
            if not _is_ignored(type(item), walk.author):
                _enter(walk, item, f"{path}[{key!r}]", _putter(value, key), depth + 1)
    elif isinstance(value, list):
        if all(isinstance(item, PLAIN) for item in value):
            walk.leaves.append(TaskValue(path, value, put))
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


def _enter_members(walk: Walk, owner: Any, path: str, skipped: frozenset[str], depth: int) -> None:
    walk.owners[path] = owner
    for name, value in list(vars(owner).items()):
        if name in skipped or _is_ignored(type(value), walk.author):
            continue
        where = f"{path}.{name}" if path else name
        _enter(walk, value, where, lambda new, n=name: object.__setattr__(owner, n, new), depth + 1)


def _enter_tuple(walk: Walk, value: tuple, path: str, put: Callable[[Any], None], depth: int) -> None:
    # A tuple is immutable: each restored item makes a new tuple.
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
    """Whether to search the attributes of objects of this class: robots, controllers, dataclasses and the
    author's classes."""
    if issubclass(cls, (BaseAgent, BaseController)):
        return True
    if issubclass(cls, (type, torch.nn.Module)) or not cls.__dictoffset__:
        return False
    return cls.__module__ == author or (
        dataclasses.is_dataclass(cls) and cls.__module__.split(".")[0] not in _SKIPPED_PACKAGES
    )


@lru_cache(maxsize=4096)
def _is_ignored(cls: type, author: str) -> bool:
    """Whether objects of this class are skipped without a report: callables, and objects of upstream
    packages."""
    if issubclass(cls, _ENTERED_TYPES) or _has_members(cls, author):
        return False
    return cls.__module__.split(".")[0] in _SKIPPED_PACKAGES or any(
        "__call__" in vars(c) for c in cls.__mro__
    )


@lru_cache(maxsize=1)
def base_env_members() -> frozenset[str]:
    """The attributes that ManiSkill's BaseEnv sets on itself, read from its code: ``self.NAME = ...``.

    These are options, spaces, sensors, last observation and generators. They are not state, or are restored
    separately (elapsed steps, generators). ``agent`` is left out, since its attributes are searched.
    """
    names: set[str] = set()
    for member in vars(BaseEnv).values():
        accessors = (member.fget, member.fset) if isinstance(member, property) else (member,)
        codes = (getattr(inspect.unwrap(f), "__code__", None) for f in accessors if callable(f))
        for code in codes:
            names |= set() if code is None else stored_names(code, "self")
    ours = {
        "_kept_controllers",
        "_to_begin",
        "begins_anew",
        "observation_space",
        "single_observation_space",
        "segmentation_id_map",
    }
    return frozenset(names | ours) - {"agent"}
