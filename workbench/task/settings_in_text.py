"""Finds constants and constructor arguments in the text of a task's file, and sets constants in that text."""

from __future__ import annotations

import ast
import difflib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from workbench.machine.text import listed
from workbench.source.definitions import Binding, Project
from workbench.source.parsed import RefusedEdit, Replacement
from workbench.task.constructor_arguments import arguments_of


class SettingError(ValueError):
    """A name cannot be set, or not to this value; the message gives advice."""


@dataclass(frozen=True)
class Constant:
    """A literal that is assigned once, in the module or a class of the file."""

    name: str
    """Name with its owner: ``push.REACH_WEIGHT`` of a module, ``PushEnv.reach_weight`` of a class."""
    line: int
    value: Any
    at: Replacement
    """Place of the value, with its current text."""


@dataclass(frozen=True)
class Argument:
    """An argument of the task's constructor."""

    name: str


class TaskText:
    """The text of a task's file."""

    def __init__(self, file: Path, text: str, class_name: str | None = None) -> None:
        """
        Args:
            class_name: name of the task's class; None for the class that opens if only the file is named.

        Raises:
            SettingError: the text is not Python.
        """
        self.text = text
        self._path, self._class = file, class_name
        self._project = Project({str(file): text})
        try:
            self._file = self._project.file(str(file))
        except RefusedEdit as error:
            raise SettingError(error.reason) from error

    def find(self, name: str) -> Constant | Argument:
        """The constant or argument that `name` sets. Raises SettingError if there is none, if there are
        several, or if its value is not a literal."""
        cls = self._task_class()
        arguments = None if cls is None else arguments_of(self._file, self._path, cls)
        found: dict[str, Constant | Argument | SettingError] = {}
        plain = name.rpartition(".")[2]
        for owner, bindings in self._scopes():
            if plain in bindings:
                found[f"{owner}.{plain}"] = self._constant(f"{owner}.{plain}", bindings[plain])
        # If the bases of the class cannot be found in the text, any name may be an argument.
        if cls is not None and (plain in (arguments or ()) or (arguments is None and not found)):
            found[f"{cls.name}.__init__.{plain}"] = Argument(plain)
        if name != plain:
            found = {full: one for full, one in found.items() if full == name}
        elif self._class is not None and f"{self._class}.{plain}" in found:
            # The person named the class: ignore the names of other classes.
            found = {full: one for full, one in found.items() if full.startswith(f"{self._class}.")}
        if not found:
            raise SettingError(self._nothing(name, arguments or ()))
        if len(found) > 1:
            raise SettingError(
                f"{name} of {self._file.name} may be {' or '.join(sorted(found))}: give one of these names"
            )
        (one,) = found.values()
        if isinstance(one, SettingError):
            raise one
        return one

    def replaced(self, values: Sequence[tuple[Constant, Any]]) -> str:
        """The text with new values of these constants. Raises SettingError for a value of another type."""
        changes = [
            Replacement(one.at.start, one.at.end, _python_text(one, value, one.value))
            for one, value in values
        ]
        return self._file.replaced(changes)

    # --- inside ----------------------------------------------------------------------------------------

    def _scopes(self) -> Iterator[tuple[str, Mapping[str, list[Binding]]]]:
        """(name, bindings) of the module and of each class of the file."""
        yield self._path.stem, self._project.bindings(self._file, self._file.module)
        for node in self._file.nodes:
            if isinstance(node, ast.ClassDef) and "<locals>" not in self._file.qualname(node):
                yield self._file.qualname(node), self._project.bindings(self._file, node)

    def _constant(self, name: str, bindings: Sequence[Binding]) -> Constant | SettingError:
        lines = [self._file.line(one.node) for one in bindings]
        where = f"{name} (line {lines[0]} of {self._file.name})"
        if len(bindings) > 1:
            places = listed([str(line) for line in lines], 5)
            return SettingError(f"{name} is set in several lines of {self._file.name}: {places}")
        (one,) = bindings
        if one.imported is not None:
            return SettingError(f"{where} is imported: only constants of the file itself can be set")
        if one.value is None:
            return SettingError(f"{where} is not a constant: {one.why or 'it is computed'}")
        try:
            value = ast.literal_eval(one.value)
        except (ValueError, TypeError, SyntaxError, MemoryError, RecursionError):
            code = self._file.one_line(one.value)
            return SettingError(
                f"{where} is computed, `{code}`: introduce a constant with a plain value, and set that"
            )
        start, end = self._file.span(one.value)
        return Constant(name, lines[0], value, Replacement(start, end, self._file.text[start:end]))

    def _task_class(self) -> ast.ClassDef | None:
        classes = {node.name: node for node in self._file.module.body if isinstance(node, ast.ClassDef)}
        if self._class is not None:
            return classes.get(self._class)
        registered = [node for node in classes.values() if any(map(_registers, node.decorator_list))]
        # As in `choose_task`: the last registered class, else the last class that has a base class.
        derived = [node for node in classes.values() if node.bases]
        return next(reversed([*derived, *registered]), None)

    def _nothing(self, name: str, arguments: Sequence[str]) -> str:
        owned = [
            (owner, one)
            for owner, bindings in self._scopes()
            for one, places in bindings.items()
            if isinstance(self._constant(one, places), Constant)
        ]
        asked, dot, _ = name.rpartition(".")
        if dot:
            known = [f"{owner}.{one}" for owner, one in owned]
        else:
            known = list(dict.fromkeys([*(one for _, one in owned), *arguments]))
        by_lower = {one.lower(): one for one in known}
        close = [by_lower[one] for one in difflib.get_close_matches(name.lower(), list(by_lower), n=3)]
        if close:
            hint = f"did you mean {' or '.join(close)}?"
        elif dot and asked not in {owner for owner, _ in owned}:
            hint = "only constants of this file can be set, not those of modules that it imports"
        else:
            plain = [one for one in known if not one.rpartition(".")[2].startswith("__")]
            hint = f"it has {listed(plain, 8)}" if plain else "it has none"
        return f"{self._file.name} has no constant and no constructor argument {name}; {hint}"


def _registers(decorator: ast.expr) -> bool:
    function = decorator.func if isinstance(decorator, ast.Call) else decorator
    return "register_env" in (getattr(function, "id", ""), getattr(function, "attr", ""))


# --- values ----------------------------------------------------------------------------------------------


def _python_text(constant: Constant, value: Any, before: Any) -> str:
    """The Python text of a JSON value, in the type of the current value."""
    if value is None or before is None:
        return repr(value)
    kinds = ((bool, "true or false"), (int | float, "a number"), (str, "a text"), (list | tuple, "a list"))
    for kind, what in (*kinds, (dict, "an object")):
        if isinstance(before, kind):
            if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
                raise SettingError(f"{constant.name} is {what} (line {constant.line}); got {value!r}")
            break
    if isinstance(before, float) and isinstance(value, int):
        # Written as a float: an integer would make an integer tensor, and a reward is a float.
        return repr(float(value))
    if isinstance(value, list) and isinstance(before, list | tuple):
        olds = [*before, *[before[-1] if before else None] * len(value)]
        items = [_python_text(constant, one, old) for one, old in zip(value, olds, strict=False)]
        if isinstance(before, tuple):
            return f"({', '.join(items)}{',' if len(items) == 1 else ''})"
        return f"[{', '.join(items)}]"
    return repr(value)
