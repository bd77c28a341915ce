"""ManiSkill's and gymnasium's tables of names, while an author's file is being executed.

`@register_env` keeps the *old* class when an id exists: it logs "already registered. Skip" and
returns. For a file that is executed on every save this means that the first version stays for ever
in the tables, and that a file which takes a built-in id is not looked at at all. So while a file
is executed, the two decorators are replaced by ones that note what they were asked, clear the
name, and hand over to ManiSkill's own. What stood under a name before is kept, slot by slot, so
that a load that fails, or a new version that no longer uses the name, leaves the tables as if it
had never been.

Only registrations made from the author's files are treated so. A library that the file imports
for the first time registers as it always does, and stays registered when the load fails, because
it stays imported.

This is the only module of `workbench.authoring` that relies on names of mani_skill which it does
not document; tests/authoring/loading/test_registry.py fails when one of them moves (mani_skill 3.0.1).
"""

from __future__ import annotations

import functools
import inspect
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import mani_skill.envs  # noqa: F401  (registers the built-in tasks, which a file may replace)
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
"""What the four tables hold under one name."""


class DuplicateName(Exception):
    """One load registers the same id twice: the author's mistake, whose second place raises."""


@dataclass(frozen=True)
class Registration:
    name: str
    cls: type
    file: str
    line: int


@dataclass
class Registrations:
    """What one load put into the tables."""

    made: list[Registration] = field(default_factory=list)
    """In order; environments and agents."""
    displaced: dict[str, Slot] = field(default_factory=dict)
    """Name to what stood there before."""
    placed: dict[str, Slot] = field(default_factory=dict)
    """Name to what this load put there."""
    _put_back: list[str] = field(default_factory=list)
    """Of `placed`: names that the last `undo` took this load's entries from."""

    def undo(self) -> None:
        """Put back what stood under each name, unless somebody took the name since."""
        self._put_back = []
        for name, before in self.displaced.items():
            if name not in self.placed or _same(_take(name), self.placed[name]):
                _put(name, before)
                self._put_back += [name] if name in self.placed else []

    def redo(self) -> None:
        """Put those entries in again that `undo` took out: a name that somebody took before that stays theirs."""
        for name in self._put_back:
            self.displaced[name] = _take(name)
            _put(name, self.placed[name])

    def replaced_names(self) -> tuple[str, ...]:
        """Names that belonged to somebody else: built-in tasks, say."""
        return tuple(
            name for name, slot in self.displaced.items() if any(value is not _NOTHING for value in slot[:3])
        )


def environment(env_id: str) -> EnvSpec | None:
    """ManiSkill's entry for `env_id`: ``cls``, ``max_episode_steps``, ``default_kwargs``."""
    return REGISTERED_ENVS.get(env_id)


def id_of(cls: type) -> str | None:
    """The id that a class is registered under; None if it is under none."""
    return next((name for name in environment_ids() if REGISTERED_ENVS[name].cls is cls), None)


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
    """Note in `registrations`, and let through, what files for which `is_own` holds register meanwhile.

    Leaves the tables as they are afterwards, whether the body raises or not: see `Registrations.undo`.
    """
    register_env, register_agent = env_registration.register_env, agent_registration.register_agent

    def noting(
        name: str, cls: type, override: bool, caller: tuple[str, int], register: Callable[[], Any]
    ) -> Any:
        file, line = caller
        earlier = next((made for made in registrations.made if made.name == name), None)
        if earlier is not None and not override:
            # ManiSkill would keep the first and say so in one log line, which nobody sees.
            raise DuplicateName(
                f"{name!r} is registered twice: in line {earlier.line} ({earlier.cls.__name__}) of "
                f"{earlier.file} and in line {line} ({getattr(cls, '__name__', cls)})"
                f"{'' if file == earlier.file else f' of {file}'}. Give one of them another id."
            )
        registrations.displaced.setdefault(name, _take(name))
        _put(name, (_NOTHING,) * len(_TABLES))
        result = register()
        registrations.made.append(Registration(name, cls, file, line))
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
            return lambda cls: noting(name_of(cls, given), cls, override, caller, lambda: decorator(cls))

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
