"""A task of somebody else's, copied into the user's folder so that it can be edited there.

An installed file is not to be edited: the next installation would take the change away. Its copy is another module in
another place, and what leaned on the place must be said otherwise: a relative import names its package, `__file__` is
that of the installed module (assets lie beside it), and an id that it registers gets another name, since the installed
task keeps its own. Everything else is the same to the last character. What cannot be said otherwise (modules beside a
file that is in no package) is refused with the reason.
"""

from __future__ import annotations

import ast
import importlib.util
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from workbench.authoring.loading.modules import module_name, read_exactly
from workbench.authoring.source.text import RefusedEdit, Replacement, SourceFile
from workbench.machine.files import create_file

MOST_COPIES = 99
_VERSION = re.compile(r"-v\d+$")


class NoCopy(Exception):
    """Why there is none, as the end of a sentence."""


@dataclass(frozen=True)
class TaskCopy:
    file: Path
    ids: tuple[tuple[str, str], ...]
    """Each id that the task registers, and what its copy registers instead."""


def copy_task(source: Path, folder: Path) -> TaskCopy:
    """Write a copy of a task's file into a folder, under a name that is free there.

    Raises:
        NoCopy: it cannot be copied; nothing was written.
    """
    try:
        _, text, encoding = read_exactly(source)
    except (OSError, SyntaxError) as error:
        raise NoCopy(f"{source.name} cannot be read ({error})") from error
    if not folder.is_dir():
        raise NoCopy(f"there is no folder {folder}")
    for number in range(1, MOST_COPIES + 1):
        file = folder / f"{source.stem}{'' if number == 1 else f'_{number}'}.py"
        if file.exists():
            continue
        copied, ids = copied_text(source, text, number)
        try:
            if create_file(file, copied.encode(encoding)):
                return TaskCopy(file, ids)
        except OSError as error:
            raise NoCopy(f"{file} cannot be written: {error.strerror}") from error
    raise NoCopy(f"{folder} has {MOST_COPIES} copies of {source.name} already")


def copied_text(source: Path, text: str, number: int = 1) -> tuple[str, tuple[tuple[str, str], ...]]:
    """What the copy says, and the ids that it registers in place of others.

    Args:
        source: where `text` is from; its packages are told by their ``__init__.py``.
        number: of the copy: further ones get further ids.

    Raises:
        NoCopy: it cannot be copied.
    """
    try:
        file = SourceFile(str(source), text)
    except RefusedEdit as refused:
        raise NoCopy(refused.reason) from refused
    package = module_name(source).name.split(".") if (source.parent / "__init__.py").is_file() else []
    changes = [
        _absolute(file, node, package)
        for node in file.nodes
        if isinstance(node, ast.ImportFrom) and node.level
    ]
    places = [node for node in file.nodes if isinstance(node, ast.Name) and node.id == "__file__"]
    if places:
        first = f"line {file.line(places[0])} asks for the file's own place"
        if not package:
            raise NoCopy(f"{first}, which the copy does not have")
        if any(text[slice(*file.inner_span(node))] != "__file__" for node in places):
            raise NoCopy(f"{first} inside a text of several lines")
        name = _free_name("installed_task", text)
        changes += [Replacement(*file.inner_span(node), f"{name}.__file__") for node in places]
        at = file.import_place()
        changes.append(Replacement(at, at, f"import {'.'.join(package)} as {name}  # its files lie there\n"))
    ids: list[tuple[str, str]] = []
    for _, call, said in registrations_in(file.module):
        if not isinstance(said, ast.Constant) or not isinstance(said.value, str):
            raise NoCopy(
                f"line {call.lineno} registers an id that is computed, so its copy would take the id of the original"
            )
        new = _new_id(said.value, number)
        changes.append(Replacement(*file.inner_span(said), f'"{new}"'))
        ids.append((said.value, new))
    return file.replaced(changes), tuple(ids)


def _absolute(file: SourceFile, node: ast.ImportFrom, package: list[str]) -> Replacement:
    """A relative import that names its package."""
    where = f"line {node.lineno} imports {'.' * node.level}{node.module or ''}"
    if not package:
        raise NoCopy(f"{where}, which lies beside the file and not in a package: copy them together yourself")
    # The module's own name is the last part; of a package's __init__ there is none.
    inside = package if file.name == "__init__.py" else package[:-1]
    try:
        full = importlib.util.resolve_name("." * node.level + (node.module or ""), ".".join(inside))
    except ImportError as error:
        raise NoCopy(f"{where}, which is beyond its package") from error
    start = file.inner_span(node)[0]
    return Replacement(start, file.token_after(start, "import"), f"from {full} ")


def registrations_in(tree: ast.Module) -> Iterator[tuple[ast.ClassDef, ast.Call, ast.expr | None]]:
    """Each class with its ``@register_env(...)``, and what that is given as id."""
    for node in (node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)):
        for call in node.decorator_list:
            if isinstance(call, ast.Call) and ast.unparse(call.func).endswith("register_env"):
                given = (*call.args, *(word.value for word in call.keywords if word.arg == "uid"), None)[0]
                yield node, call, given


def _new_id(env_id: str, number: int) -> str:
    """``PushCube-v1`` becomes ``MyPushCube-v1``, then ``MyPushCube2-v1``."""
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
