"""Names of the arguments that a task's constructor takes, read from the text of the author's files."""

from __future__ import annotations

import ast
import importlib
from collections.abc import Sequence
from pathlib import Path

from workbench.envs.keywords import parameters_of
from workbench.source.parsed import RefusedEdit, SourceFile
from workbench.task.library_names import is_library
from workbench.task.modules import read_source
from workbench.task.reference import find_in, find_module

_MAX_DEPTH = 20
"""Maximum number of base classes through which a constructor is followed."""


def class_arguments(cls: type) -> tuple[str, ...]:
    """Arguments that can be given to an installed task's constructor by name."""
    return tuple(name for name, _ in parameters_of(cls, object) if name != "num_envs")


def arguments_of(file: SourceFile, path: Path, cls: ast.ClassDef, depth: int = 0) -> tuple[str, ...] | None:
    """Names of the constructor arguments of an author's class, including those that the constructor passes on
    to base classes; None if a base class is not found."""
    init = next(
        (one for one in cls.body if isinstance(one, ast.FunctionDef) and one.name == "__init__"), None
    )
    own: list[str] = []
    if init is not None:
        own = [one.arg for one in (*init.args.args[1:], *init.args.kwonlyargs) if one.arg != "num_envs"]
        if init.args.kwarg is None:
            return tuple(own)
    for base in cls.bases:
        inherited = _base_arguments(file, path, base, depth + 1) if depth < _MAX_DEPTH else None
        if inherited is None:
            return None
        own += inherited
    return tuple(dict.fromkeys(own))


def _base_arguments(file: SourceFile, path: Path, base: ast.expr, depth: int) -> tuple[str, ...] | None:
    base = base.value if isinstance(base, ast.Subscript) else base
    names: list[str] = []
    while isinstance(base, ast.Attribute):
        names.insert(0, base.attr)
        base = base.value
    if not isinstance(base, ast.Name):
        return None
    if not names and (there := _class_in(file, base.id)) is not None:
        return arguments_of(file, path, there, depth)
    for node in file.module.body:
        if not isinstance(node, ast.Import | ast.ImportFrom):
            continue
        for alias in node.names:
            if (alias.asname or alias.name) == base.id:
                within = [] if isinstance(node, ast.Import) else (node.module or "").split(".")
                *module, name = [*filter(None, within), *alias.name.split("."), *names]
                level = node.level if isinstance(node, ast.ImportFrom) else 0
                return _imported_arguments(path, module, name, level, depth)
    return None


def _class_in(file: SourceFile, name: str) -> ast.ClassDef | None:
    return next((one for one in file.module.body if isinstance(one, ast.ClassDef) and one.name == name), None)


def _imported_arguments(
    path: Path, module: Sequence[str], name: str, level: int, depth: int
) -> tuple[str, ...] | None:
    if not module:
        return None
    if not level and is_library(module[0]):
        # Import it: it is not the author's code, and the task imports it anyway.
        try:
            cls = getattr(importlib.import_module(".".join(module)), name, None)
        except ImportError:
            return None
        return class_arguments(cls) if isinstance(cls, type) else None
    folders, there = [path.parents[max(level - 1, 0)]], None
    for part in module:
        there, folders = find_in(folders, part)
    if there is None and not level and (found := find_module(".".join(module))) is not None:
        there = found.file
    if there is None:
        return None
    try:
        file = SourceFile(str(there), read_source(there))
    except (OSError, SyntaxError, ValueError, RefusedEdit):
        return None
    found_class = _class_in(file, name)
    return None if found_class is None else arguments_of(file, there, found_class, depth)
