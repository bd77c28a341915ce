"""Finds the line of the author's source at which a finding is reported."""

from __future__ import annotations

import ast
import linecache
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

from mani_skill.envs.sapien_env import BaseEnv

from workbench.envs.broken_rule import Place
from workbench.machine.parse_python import parse_python
from workbench.task.load import LoadedTask
from workbench.task.problem import hook_definition


@dataclass(frozen=True)
class Module:
    """A parsed file of the author."""

    file: str
    tree: ast.Module

    @cached_property
    def functions(self) -> tuple[ast.FunctionDef, ...]:
        return tuple(node for node in ast.walk(self.tree) if isinstance(node, ast.FunctionDef))

    @cached_property
    def classes(self) -> dict[str, ast.ClassDef]:
        """Classes by qualified name."""
        found: dict[str, ast.ClassDef] = {}
        waiting: list[tuple[str, ast.AST]] = [("", self.tree)]
        while waiting:
            prefix, owner = waiting.pop()
            for node in ast.iter_child_nodes(owner):
                if isinstance(node, ast.ClassDef):
                    found[f"{prefix}{node.name}"] = node
                    waiting.append((f"{prefix}{node.name}.", node))
                elif isinstance(node, ast.FunctionDef):
                    waiting.append((f"{prefix}{node.name}.<locals>.", node))
                else:
                    waiting.append((prefix, node))
        return found

    @cached_property
    def imports(self) -> dict[str, str]:
        """Full name of each imported name, such as ``numpy`` for ``np``, and ``random.uniform`` for
        ``uniform``."""
        found: dict[str, str] = {}
        for node in ast.walk(self.tree):
            if isinstance(node, ast.Import):
                for each in node.names:
                    found[each.asname or each.name.split(".")[0]] = (
                        each.name if each.asname else each.name.split(".")[0]
                    )
            elif isinstance(node, ast.ImportFrom) and not node.level:
                for each in node.names:
                    found[each.asname or each.name] = f"{node.module}.{each.name}"
        return found

    def place(self, node: ast.AST, function: str = "") -> Place:
        line: int = getattr(node, "lineno", 1)
        inside = [f for f in self.functions if f.lineno <= line <= (f.end_lineno or f.lineno)]
        return self.file, line, function or (inside[-1].name if inside else "")


class Places:
    """Finds lines in the author's files, for one version of a task."""

    def __init__(self, loaded: LoadedTask) -> None:
        self._loaded = loaded

    @cached_property
    def modules(self) -> tuple[Module, ...]:
        """The author's files, the task's file first."""
        texts = {str(file): self._text(str(file)) for file in self._loaded.source_files}
        return tuple(Module(file, parse_python(text)) for file, text in texts.items())

    def _text(self, file: str) -> str:
        return self._loaded.source.get(file) or "".join(linecache.getlines(file))

    def hook(self, *names: str) -> Place | None:
        """The ``def`` line of the first of these hooks that the author's files have; else the
        ``class`` line."""
        found = hook_definition(self._loaded.cls, names, self._loaded.source_files)
        return self.task if found is None else (*found[1], found[0])

    @cached_property
    def task(self) -> Place | None:
        """The ``class`` line."""
        found = self.class_definition(self._loaded.cls)
        return None if found is None else (found[0].file, found[1].lineno, found[1].name)

    def class_definition(self, cls: type) -> tuple[Module, ast.ClassDef] | None:
        """The definition of a class in the author's files; None if it is elsewhere."""
        file, name = _identity(cls)
        for module in self.modules:
            if module.file == file and name in module.classes:
                return module, module.classes[name]
        return None

    @cached_property
    def methods(self) -> tuple[tuple[Module, ast.FunctionDef], ...]:
        """Methods of the task's class and of its base classes that are in the author's files, in the order of
        inheritance."""
        classes = filter(None, map(self.class_definition, self._loaded.cls.__mro__))
        return tuple(
            (module, node)
            for module, owner in classes
            for node in owner.body
            if isinstance(node, ast.FunctionDef)
        )

    def functions(self, *names: str) -> Iterator[tuple[Module, ast.FunctionDef]]:
        """The functions with these names in the author's files (all if no name is given): the task's methods first, without methods
        of other tasks."""
        methods = {function for _, function in self.methods}
        others = (
            (module, function)
            for module in self.modules
            for function in module.functions
            if function not in methods and function not in self._of_other_tasks
        )
        for module, function in (*self.methods, *others):
            if not names or function.name in names:
                yield module, function

    def reached_from(self, *hooks: str) -> Iterator[tuple[Module, ast.FunctionDef]]:
        """These hooks of the task, and the author's functions that they name, directly or through other
        functions."""
        known: dict[str, list[tuple[Module, ast.FunctionDef]]] = {}
        for module, function in self.functions():
            known.setdefault(function.name, []).append((module, function))
        waiting, seen = list(hooks), set(hooks)
        while waiting:
            for module, function in known.get(waiting.pop(0), ()):
                yield module, function
                for node in ast.walk(function):
                    name = getattr(node, "attr", getattr(node, "id", None))
                    if name in known and name not in seen:
                        seen.add(name)
                        waiting.append(name)

    @cached_property
    def _of_other_tasks(self) -> frozenset[ast.FunctionDef]:
        """Functions within the classes of further tasks in the files."""
        mine = set(map(_identity, self._loaded.cls.__mro__))
        others = set(map(_identity, _subclasses(BaseEnv))) - mine
        return frozenset(
            part
            for module in self.modules
            for name, node in module.classes.items()
            if (module.file, name) in others
            for part in ast.walk(node)
            if isinstance(part, ast.FunctionDef)
        )

    def entry(self, name: str, hook: str = "evaluate") -> Place | None:
        """The line, in a hook, that writes this entry; else a line that mentions it; else the hook's ``def`` line."""
        for lines_of in (_written_entries, _mentioned_entries):
            for module, function in self.functions(hook):
                for node in ast.walk(function):
                    for entry, at in lines_of(node):
                        if entry == name:
                            return module.place(at, hook)
        return self.hook(hook)

    def body(self, name: str, *hooks: str) -> Place | None:
        """The line that makes or places a body: the first call of a setter, in these hooks, on the attribute
        that holds the body; else the first line, in any function, that names the body; else the ``def`` line
        of a hook.

        Args:
            name: as in `SceneIndex.names`.
        """
        owner = name.split("/", 1)[0]
        attributes = set(self._attributes_of(owner))
        for hook in hooks:
            for module, function in self.functions(hook):
                for node in ast.walk(function):
                    if _places(node, attributes):
                        return module.place(node, hook)
        for module, function in self.functions():
            for node in ast.walk(function):
                if isinstance(node, ast.Constant) and node.value == owner:
                    return module.place(node, function.name)
        return self.hook(*hooks)

    def _attributes_of(self, owner: str) -> Iterator[str]:
        """The body's name, and the names of the attributes to which a statement assigns a value that contains
        this name."""
        yield owner
        if any(robot in owner for robot in ("panda", "robot", "agent")):
            yield from ("agent", "robot")
        for _, function in self.functions():
            for node in ast.walk(function):
                if not isinstance(node, ast.Assign):
                    continue
                named = any(
                    isinstance(part, ast.Constant) and part.value == owner for part in ast.walk(node.value)
                )
                for target in node.targets:
                    if named and isinstance(target, ast.Attribute):
                        yield target.attr


def _written_entries(node: ast.AST) -> Iterator[tuple[object, ast.expr]]:
    """Keys that the node writes into a dict, each with the place of its key: ``{"a": 1}``, ``dict(a=1)``,
    ``info["a"] = 1``."""
    if isinstance(node, ast.Dict):
        yield from ((key.value, key) for key in node.keys if isinstance(key, ast.Constant))
    elif isinstance(node, ast.keyword):
        yield node.arg, node.value
    elif isinstance(node, ast.Subscript) and isinstance(node.ctx, ast.Store):
        yield from _mentioned_entries(node.slice)


def _mentioned_entries(node: ast.AST) -> Iterator[tuple[object, ast.expr]]:
    if isinstance(node, ast.Constant):
        yield node.value, node


def _places(node: ast.AST, attributes: set[str]) -> bool:
    """Whether the node is a call ``self.<attribute>....set_...(...)``."""
    if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Attribute):
        return False
    if not node.func.attr.startswith("set_"):
        return False
    parts = [part.attr for part in ast.walk(node.func.value) if isinstance(part, ast.Attribute)]
    return not attributes.isdisjoint(parts)


def _identity(cls: type) -> tuple[str | None, str]:
    """File and qualified name: two files may have classes of the same name."""
    file = getattr(sys.modules.get(cls.__module__), "__file__", None)
    # Resolved, like the paths in `LoadedTask.source_files`: a folder of the path may be a link.
    return file and os.path.realpath(file), cls.__qualname__


def _subclasses(cls: type) -> Iterator[type]:
    for each in cls.__subclasses__():
        yield each
        yield from _subclasses(each)
