"""The line of a task's source that assigns an attribute, for where nobody saw it happen."""

from __future__ import annotations

import ast
import inspect
import re
import textwrap
from collections.abc import Iterator
from typing import Any

from mani_skill.envs.sapien_env import BaseEnv

from workbench.core.broken_rule import Place

_NAME = re.compile(r"[^\W\d]\w*")
_NOT_IN_A_RESET = {"__init__", "_load_scene", "_load_agent", "_after_reconfigure"}


def find_assignment(task: type, path: str) -> Place | None:
    """Where the task gives ``self.<path>`` its value, as far as its text says: in its reset first, then in other methods.

    Args:
        path: ``target``, ``memory.best``, ``targets['left']``, ``goal.raw_pose``.
    """
    names = _NAME.findall(re.sub(r"\[.*?\]", "", path))
    wanted = names[-2] if names[-1:] == ["raw_pose"] and len(names) > 1 else (names or [""])[-1]
    found: list[tuple[int, Place]] = []
    for order, (name, function) in enumerate(_methods(task)):
        if name in _NOT_IN_A_RESET:
            continue
        for line in _lines_that_assign(function, wanted):
            rank = order + (0 if name == "_initialize_episode" else 1000)
            found.append((rank, (function.__code__.co_filename, line, name)))
    return min(found, default=(0, None))[1]


def _methods(task: type) -> Iterator[tuple[str, Any]]:
    for owner in task.__mro__:
        if not issubclass(owner, BaseEnv) or owner is BaseEnv:
            continue
        for name, member in vars(owner).items():
            member = member.fset if isinstance(member, property) else getattr(member, "__func__", member)
            member = inspect.unwrap(member) if callable(member) else member
            if inspect.isfunction(member):
                yield name, member


def _lines_that_assign(function: Any, wanted: str) -> Iterator[int]:
    try:
        lines, first = inspect.getsourcelines(function)
        tree = ast.parse(textwrap.dedent("".join(lines)))
    except (OSError, SyntaxError):  # made without a text, or a lambda in the middle of a line
        return
    for node in ast.walk(tree):
        if isinstance(node, ast.Assign):
            targets = node.targets
        elif isinstance(node, (ast.AugAssign, ast.AnnAssign)):
            targets = [node.target]
        else:
            continue
        if any(_names(target, wanted) for target in targets):
            yield first + node.lineno - 1


def _names(target: ast.expr, wanted: str) -> bool:
    if isinstance(target, (ast.Tuple, ast.List)):
        return any(_names(item, wanted) for item in target.elts)
    if isinstance(target, (ast.Subscript, ast.Starred)):
        return _names(target.value, wanted)
    return isinstance(target, ast.Attribute) and target.attr == wanted
