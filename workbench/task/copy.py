"""Copies an installed task's file into the user's folder, so that it can be edited there."""

from __future__ import annotations

import ast
import importlib.util
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from workbench.machine.files import create_file
from workbench.source.parsed import RefusedEdit, Replacement, SourceFile
from workbench.task.modules import module_name, read_exactly

MAX_COPIES = 99
"""Maximum number of copies of a file in one folder."""
_VERSION = re.compile(r"-v\d+$")


class CannotCopy(Exception):
    """The task cannot be copied; the message is the end of a sentence."""


@dataclass(frozen=True)
class NewNames:
    """New names for a copy."""

    ids: dict[str, str] = field(default_factory=dict)
    """New ids by the original's id; an id that is missing here gets the default name of a copy."""
    classes: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class TaskCopy:
    file: Path
    ids: tuple[tuple[str, str], ...]
    """Pairs of the id that the task registers and the id that its copy registers."""


def copy_task(source: Path, folder: Path) -> TaskCopy:
    """Write a copy of a task's file into a folder, under a free name.

    An installed file must not be edited: the next installation would overwrite it.

    Raises:
        CannotCopy: it cannot be copied; nothing was written.
    """
    try:
        _, text, encoding = read_exactly(source)
    except (OSError, SyntaxError) as error:
        raise CannotCopy(f"{source.name} cannot be read ({error})") from error
    if not folder.is_dir():
        raise CannotCopy(f"there is no folder {folder}")
    for number in range(1, MAX_COPIES + 1):
        file = folder / f"{source.stem}{'' if number == 1 else f'_{number}'}.py"
        if file.exists():
            continue
        copied, ids = copied_text(source, text, number)
        try:
            if create_file(file, copied.encode(encoding)):
                return TaskCopy(file, ids)
        except OSError as error:
            raise CannotCopy(f"{file} cannot be written: {error.strerror}") from error
    raise CannotCopy(f"{folder} has {MAX_COPIES} copies of {source.name} already")


def copied_text(
    source: Path, text: str, number: int = 1, names: NewNames | None = None
) -> tuple[str, tuple[tuple[str, str], ...]]:
    """The text of the copy, and a pair for each registered id: the original's id and the copy's id.

    Only the ids, and code that depends on the file's place, change. Relative imports become absolute.
    ``__file__`` becomes the ``__file__`` of the installed module, because the assets are next to that module.
    Registered ids get another name. Without `names`, the rest is identical.

    Args:
        source: the file of `text`; its packages are found by their ``__init__.py``.
        number: number of the copy; from 2 on, it is part of the copy's ids.
        names: names chosen for the copy, also used in its docstrings.

    Raises:
        CannotCopy: the file cannot be copied; for example, it has relative imports but is not in a package.
    """
    try:
        file = SourceFile(str(source), text)
    except RefusedEdit as refused:
        raise CannotCopy(refused.reason) from refused
    package = module_name(source).name.split(".") if (source.parent / "__init__.py").is_file() else []
    changes = [
        _absolute(file, node, package)
        for node in file.nodes
        if isinstance(node, ast.ImportFrom) and node.level
    ]
    places = [node for node in file.nodes if isinstance(node, ast.Name) and node.id == "__file__"]
    if places:
        first = f"line {file.line(places[0])} reads the file's own path"
        if not package:
            raise CannotCopy(f"{first}, which the copy does not have")
        if any(text[slice(*file.inner_span(node))] != "__file__" for node in places):
            raise CannotCopy(f"{first} inside a multi-line string")
        name = _free_name("installed_task", text)
        changes += [Replacement(*file.inner_span(node), f"{name}.__file__") for node in places]
        at = file.import_place()
        changes.append(Replacement(at, at, f"import {'.'.join(package)} as {name}  # its files are there\n"))
    ids: list[tuple[str, str]] = []
    for _, call, uid in registrations_in(file.module):
        if not isinstance(uid, ast.Constant) or not isinstance(uid.value, str):
            raise CannotCopy(
                f"line {call.lineno} registers an id that is computed, so its copy would take the id of the original"
            )
        new = (names.ids.get(uid.value) if names else None) or _new_id(uid.value, number)
        changes.append(Replacement(*file.inner_span(uid), f'"{new}"'))
        ids.append((uid.value, new))
    if names is not None:
        changes += _renamed(file, names)
    return file.replaced(changes), tuple(ids)


def _renamed(file: SourceFile, names: NewNames) -> Iterator[Replacement]:
    """Replacements of class names where they are defined and used, and of ids and class names in docstrings.

    Raises:
        CannotCopy: the file uses a new name already.
    """
    used = {_bound(node) for node in file.nodes}
    for new in names.classes.values():
        if new in used:
            raise CannotCopy(f"{file.name} uses the name {new} already: choose another name")
    words = {**names.ids, **names.classes}
    any_word = re.compile(rf"(?<![\w-])(?:{'|'.join(map(re.escape, words))})(?![\w-])")
    for node in file.nodes:
        if isinstance(node, ast.ClassDef) and node.name in names.classes:
            start = file.token_after(file.token_after(file.inner_span(node)[0], "class"), node.name)
            yield Replacement(start, start + len(node.name), names.classes[node.name])
        elif isinstance(node, ast.Name) and node.id in names.classes:
            yield Replacement(*file.inner_span(node), names.classes[node.id])
        elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            # A string statement: the docstring of a definition or of a constant.
            start, end = file.inner_span(node.value)
            for found in any_word.finditer(file.text, start, end):
                yield Replacement(*found.span(), words[found[0]])


def _bound(node: ast.AST) -> str:
    """The name that a node uses or defines; empty if there is none."""
    if isinstance(node, ast.alias):
        return node.asname or node.name
    return getattr(node, "id", None) or (node.name if isinstance(node, ast.ClassDef) else "")


def _absolute(file: SourceFile, node: ast.ImportFrom, package: list[str]) -> Replacement:
    """The relative import `node` as an absolute one."""
    where = f"line {node.lineno} imports {'.' * node.level}{node.module or ''}"
    if not package:
        raise CannotCopy(f"{where}, a module of its folder, which is not a package: copy both files yourself")
    # The last part is the module's own name, which a package's __init__ does not have.
    inside = package if file.name == "__init__.py" else package[:-1]
    try:
        full = importlib.util.resolve_name("." * node.level + (node.module or ""), ".".join(inside))
    except ImportError as error:
        raise CannotCopy(f"{where}, which is outside its package") from error
    start = file.inner_span(node)[0]
    return Replacement(start, file.token_after(start, "import"), f"from {full} ")


def registrations_in(tree: ast.Module) -> Iterator[tuple[ast.ClassDef, ast.Call, ast.expr | None]]:
    """Each registered class, its ``@register_env(...)`` call, and the id argument of the call (None if it has
    none)."""
    for node in (node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)):
        for call in node.decorator_list:
            if isinstance(call, ast.Call) and ast.unparse(call.func).endswith("register_env"):
                given = (*call.args, *(word.value for word in call.keywords if word.arg == "uid"), None)[0]
                yield node, call, given


def _new_id(env_id: str, number: int) -> str:
    """The id of a copy: ``MyPushCube-v1`` for the first copy of ``PushCube-v1``, ``MyPushCube2-v1`` for the
    second."""
    space, slash, name = env_id.rpartition("/")
    version = _VERSION.search(name)
    bare = name if version is None else name[: version.start()]
    return (
        f"{space}{slash}My{bare}{'' if number == 1 else number}{'' if version is None else version.group()}"
    )


def _free_name(name: str, text: str) -> str:
    while name in text:
        name += "_"
    return name
