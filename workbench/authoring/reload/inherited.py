"""What a task's class has of classes that are not its author's: the names that an edit must not meet unseen."""

from __future__ import annotations

import sys
from collections.abc import Collection, Iterator
from types import CodeType, FunctionType
from typing import Any

from mani_skill.envs.sapien_env import BaseEnv

from workbench.authoring.reload.level import Inherited


def inherited_by(task: type, files: Collection[str]) -> Inherited:
    """Names of the library classes among the bases of `task`; `files` are the author's own."""
    libraries = [cls for cls in task.__mro__ if cls is not object and _file_of(cls) not in files]
    names = {name for cls in libraries for name in (*vars(cls), *vars(cls).get("__annotations__", ()))}
    basic = {*BaseEnv.__mro__}
    used = {name for cls in libraries if cls not in basic for name in _used_in(cls)}
    return Inherited(frozenset(names), frozenset(used))


def _file_of(cls: type) -> str | None:
    return getattr(sys.modules.get(cls.__module__), "__file__", None)


def _used_in(cls: type) -> Iterator[str]:
    for member in vars(cls).values():
        functions: list[Any] = [member]
        if isinstance(member, property):
            functions = [member.fget, member.fset]
        for function in functions:
            function = getattr(function, "__func__", function)
            if isinstance(function, FunctionType):
                yield from _names_in(function.__code__)


def _names_in(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for inner in code.co_consts:
        if isinstance(inner, CodeType):
            yield from _names_in(inner)
