"""Registers envs and agents of an author's file in ManiSkill's and gymnasium's tables, and undoes it."""

from __future__ import annotations

import functools
import inspect
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import mani_skill.envs  # noqa: F401  (registers the built-in tasks, which a file may replace)
from gymnasium.envs.registration import EnvSpec as GymnasiumSpec
from gymnasium.envs.registration import registry as gymnasium_registry
from mani_skill import agents
from mani_skill.agents import registration as agent_registration
from mani_skill.agents.base_agent import BaseAgent
from mani_skill.agents.registration import REGISTERED_AGENTS
from mani_skill.envs.sapien_env import BaseEnv

# Not `import mani_skill.utils.registration`: mani_skill's own `from .envs import *` binds the name
# `utils` on the package to mani_skill.envs.utils.
from mani_skill.utils import registration as env_registration
from mani_skill.utils.assets import DATA_GROUPS
from mani_skill.utils.registration import REGISTERED_ENVS, EnvSpec

_TABLES: tuple[dict[str, Any], ...] = (REGISTERED_ENVS, gymnasium_registry, REGISTERED_AGENTS, DATA_GROUPS)
_NOTHING = object()

Slot = tuple[Any, ...]
"""The entries of the four tables under one name."""


class DuplicateName(Exception):
    """One load registers the same id twice; raised at the second registration."""


@dataclass(frozen=True)
class Registration:
    name: str
    cls: type
    file: str
    line: int
    override: bool
    """Whether the registration asked to replace another one."""

    @property
    def is_robot(self) -> bool:
        return issubclass(self.cls, BaseAgent)


@dataclass
class Registrations:
    """The table entries of one load."""

    made: list[Registration] = field(default_factory=list)
    """Registrations of environments and agents, in order."""
    displaced: dict[str, Slot] = field(default_factory=dict)
    """Entries before the load, by name."""
    placed: dict[str, Slot] = field(default_factory=dict)
    """Entries of this load, by name."""
    _removed: list[str] = field(default_factory=list)
    """Names of `placed` whose entries the last `undo` removed."""

    def undo(self) -> None:
        """Restore the entries before the load, except for names that were registered again since."""
        self._removed = []
        for name, before in self.displaced.items():
            if name not in self.placed or _same(_take(name), self.placed[name]):
                _put(name, before)
                self._removed += [name] if name in self.placed else []

    def redo(self) -> None:
        """Restore the entries that `undo` removed."""
        for name in self._removed:
            self.displaced[name] = _take(name)
            _put(name, self.placed[name])

    def replaced(self) -> tuple[Registration, ...]:
        """Registrations that plain ManiSkill skips: their name is registered already, such as that of a built-in
        task, and they do not override it."""
        first = {made.name: made for made in reversed(self.made)}
        taken = [
            name for name, slot in self.displaced.items() if any(one is not _NOTHING for one in slot[:3])
        ]
        return tuple(first[name] for name in taken if name in first and not first[name].override)


def environment(env_id: str) -> EnvSpec | None:
    """ManiSkill's entry for `env_id`: ``cls``, ``max_episode_steps``, ``default_kwargs``."""
    return REGISTERED_ENVS.get(env_id)


def id_of(cls: type) -> str | None:
    """The id that a class is registered under; None if the class is not registered."""
    return next((name for name in environment_ids() if REGISTERED_ENVS[name].cls is cls), None)


def gymnasium_spec_of(cls: type) -> GymnasiumSpec | None:
    """Spec of a class that was registered with gymnasium's own `register`, so that ManiSkill's table does not
    have it; None if there is none."""
    entry_points = (cls, f"{cls.__module__}:{cls.__qualname__}")
    return next((spec for spec in gymnasium_registry.values() if spec.entry_point in entry_points), None)


def environment_ids() -> list[str]:
    return sorted(REGISTERED_ENVS)


def is_other_gymnasium_id(env_id: str) -> bool:
    """True for ids that gymnasium knows and ManiSkill does not (``CartPole-v1``)."""
    return env_id in gymnasium_registry and env_id not in REGISTERED_ENVS


def is_task(value: object) -> bool:
    return isinstance(value, type) and issubclass(value, BaseEnv) and value is not BaseEnv


def is_robot(value: object) -> bool:
    return isinstance(value, type) and issubclass(value, BaseAgent) and value is not BaseAgent


@contextmanager
def registering(is_own: Callable[[str], bool], registrations: Registrations) -> Iterator[None]:
    """Context manager: registrations by files for which `is_own(path)` is true are added to `registrations`.

    ManiSkill's `@register_env` keeps the old class of a known id ("already registered. Skip"), so a file that
    is executed on every save would keep its first version, and a file with a built-in id would be ignored. So
    `register_env` and `register_agent` are replaced by decorators that first remove the entries under the
    name. The entries stay after the block, even if it raises: `Registrations.undo` removes them.
    Registrations of libraries that the file imports are left alone, because the libraries stay imported.

    Depends on undocumented names of mani_skill 3.0.1; tests/task/test_registry.py fails if one moves.
    """
    register_env, register_agent = env_registration.register_env, agent_registration.register_agent

    def record(
        name: str, cls: type, override: bool, caller: tuple[str, int], register: Callable[[], Any]
    ) -> Any:
        file, line = caller
        earlier = next((made for made in registrations.made if made.name == name), None)
        if earlier is not None and not override:
            # ManiSkill would keep the first class and only log it.
            raise DuplicateName(
                f"{name!r} is registered twice: in line {earlier.line} ({earlier.cls.__name__}) of "
                f"{earlier.file} and in line {line} ({getattr(cls, '__name__', cls)})"
                f"{'' if file == earlier.file else f' of {file}'}. Give one of them another id."
            )
        registrations.displaced.setdefault(name, _take(name))
        _put(name, (_NOTHING,) * len(_TABLES))
        result = register()
        registrations.made.append(Registration(name, cls, file, line, override))
        registrations.placed[name] = _take(name)
        return result

    def own(
        register: Callable[..., Any], name_of: Callable[[Any, Mapping[str, Any]], str]
    ) -> Callable[..., Any]:
        @functools.wraps(register)
        def own_register(*args: Any, **kwargs: Any) -> Callable[[type], type]:
            frame = sys._getframe(1)
            caller = frame.f_code.co_filename, frame.f_lineno
            decorator = register(*args, **kwargs)
            if not is_own(caller[0]):
                return decorator
            given = inspect.signature(register).bind(*args, **kwargs).arguments
            override = bool(given.get("override"))
            return lambda cls: record(name_of(cls, given), cls, override, caller, lambda: decorator(cls))

        return own_register

    env_registration.register_env = own(register_env, lambda cls, given: given["uid"])
    agents.register_agent = agent_registration.register_agent = own(
        register_agent, lambda cls, given: cls.uid
    )
    try:
        yield
    finally:
        env_registration.register_env = register_env
        agents.register_agent = agent_registration.register_agent = register_agent


def _take(name: str) -> Slot:
    return tuple(table.get(name, _NOTHING) for table in _TABLES)


def _put(name: str, slot: Slot) -> None:
    for table, value in zip(_TABLES, slot, strict=True):
        if value is _NOTHING:
            table.pop(name, None)
        else:
            table[name] = value


def _same(left: Slot, right: Slot) -> bool:
    return all(a is b for a, b in zip(left, right, strict=True))
