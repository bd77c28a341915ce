"""A task of somebody else's, copied into the user's folder so that it can be edited there.

An installed file is not to be edited: the next installation would take the change away. Its copy is another module in
another place, and what leaned on the place must be said otherwise: a relative import names its package, `__file__` is
that of the installed module (assets lie beside it), and an id that it registers gets another name, since the installed
task keeps its own. Everything else is the same to the last character. What cannot be said otherwise (modules beside a
file that is in no package) is refused with the reason.
"""

from __future__ import annotations

import ast
import errno
import io
import os
import re
import tempfile
import tokenize
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from workbench.authoring.modules import MOST_SOURCE_BYTES, decode, module_name
from workbench.machine.regular_file import read_regular_file

MOST_COPIES = 99
_FROM = re.compile(r"from[\s\\]*\.(?:[\s\\]*\.)*")
_VERSION = re.compile(r"-v\d+$")


class NoCopy(Exception):
    """Why there is none, as the end of a sentence."""


@dataclass(frozen=True)
class TaskCopy:
    file: Path
    ids: tuple[tuple[str, str], ...]
    """Each id that the task registers, and what its copy registers instead."""


@dataclass(frozen=True)
class _Replacement:
    start: int
    end: int
    text: str


def copy_task(source: Path, folder: Path) -> TaskCopy:
    """Write a copy of a task's file into a folder, under a name that is free there.

    Raises:
        NoCopy: it cannot be copied; nothing was written.
    """
    try:
        raw = read_regular_file(source, MOST_SOURCE_BYTES)
        text = decode(str(source), raw)
        encoding, _ = tokenize.detect_encoding(io.BytesIO(raw).readline)
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
            if _write_new(file, copied.encode(encoding)):
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
        tree = ast.parse(text)
    except (SyntaxError, ValueError) as error:
        raise NoCopy(f"{source.name} is not valid Python as it stands: {error}") from error
    offset = _offsets(text)
    changes: list[_Replacement] = []
    package = module_name(source).name.split(".") if (source.parent / "__init__.py").is_file() else []
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.level:
            changes.append(_absolute(node, source, package, text, offset))
    places = [n for n in ast.walk(tree) if isinstance(n, ast.Name) and n.id == "__file__"]
    if places:
        if not package:
            raise NoCopy(
                f"line {places[0].lineno} asks for the file's own place, which the copy does not have"
            )
        name = _free_name("installed_task", text)
        changes += [
            _Replacement(
                offset(n.lineno, n.col_offset), offset(n.lineno, n.col_offset) + 8, f"{name}.__file__"
            )
            for n in places
        ]
        if any(text[c.start : c.end] != "__file__" for c in changes[-len(places) :]):
            raise NoCopy(
                f"line {places[0].lineno} asks for the file's own place inside a text of several lines"
            )
        at = _after_the_head(tree, text, offset)
        changes.append(_Replacement(at, at, f"import {'.'.join(package)} as {name}  # its files lie there\n"))
    ids: list[tuple[str, str]] = []
    for said in _registered_ids(tree):
        new = _new_id(str(said.value), number)
        start = offset(said.lineno, said.col_offset)
        end = offset(said.end_lineno or said.lineno, said.end_col_offset or said.col_offset)
        changes.append(_Replacement(start, end, f'"{new}"'))
        ids.append((str(said.value), new))
    for change in sorted(changes, key=lambda change: change.start, reverse=True):
        text = text[: change.start] + change.text + text[change.end :]
    return text, tuple(ids)


def _absolute(
    node: ast.ImportFrom, source: Path, package: list[str], text: str, offset: Callable[[int, int], int]
) -> _Replacement:
    """A relative import that names its package."""
    where = f"line {node.lineno} imports {'.' * node.level}{node.module or ''}"
    # The module's own name is the last part; of a package's __init__ there is none.
    inside = package if source.stem == "__init__" else package[:-1]
    if not package:
        raise NoCopy(f"{where}, which lies beside the file and not in a package: copy them together yourself")
    if node.level > len(inside):
        raise NoCopy(f"{where}, which is beyond its package")
    start = offset(node.lineno, node.col_offset)
    match = _FROM.match(text, start)
    end = -1 if match is None else match.end()
    if match is not None and node.module:
        named = re.compile(rf"[\s\\]*{re.escape(node.module)}\b").match(text, end)
        end = -1 if named is None else named.end()
    if end < 0:
        raise NoCopy(f"{where}, in a way that is not understood")
    full = ".".join([*inside[: len(inside) - node.level + 1], *([node.module] if node.module else [])])
    return _Replacement(start, end, f"from {full}")


def _registered_ids(tree: ast.Module) -> Iterator[ast.Constant]:
    """Where ``@register_env`` is given an id."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.ClassDef):
            continue
        for call in node.decorator_list:
            if not isinstance(call, ast.Call) or not ast.unparse(call.func).endswith("register_env"):
                continue
            given = [*call.args[:1], *(word.value for word in call.keywords if word.arg == "uid")]
            if not given or not isinstance(given[0], ast.Constant) or not isinstance(given[0].value, str):
                raise NoCopy(
                    f"line {call.lineno} registers an id that is computed, so its copy would take the id of the original"
                )
            yield given[0]


def _new_id(env_id: str, number: int) -> str:
    """``PushCube-v1`` becomes ``MyPushCube-v1``, then ``MyPushCube2-v1``."""
    space, slash, name = env_id.rpartition("/")
    version = _VERSION.search(name)
    bare = name if version is None else name[: version.start()]
    return (
        f"{space}{slash}My{bare}{'' if number == 1 else number}{'' if version is None else version.group()}"
    )


def _after_the_head(tree: ast.Module, text: str, offset: Callable[[int, int], int]) -> int:
    """Behind the docstring and imports from ``__future__``, where the first other statement begins."""
    for i, node in enumerate(tree.body):
        docstring = i == 0 and isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        if not docstring and not (isinstance(node, ast.ImportFrom) and node.module == "__future__"):
            first = min([node.lineno, *(d.lineno for d in getattr(node, "decorator_list", []))])
            return offset(first, 0)
    return len(text)


def _free_name(name: str, text: str) -> str:
    while name in text:
        name += "_"
    return name


def _offsets(text: str) -> Callable[[int, int], int]:
    """From ast's lines and columns, which count bytes of UTF-8, to places in the text."""
    lines = text.split("\n")
    starts = [0]
    for line in lines:
        starts.append(starts[-1] + len(line) + 1)

    def offset(line: int, column: int) -> int:
        return starts[line - 1] + len(lines[line - 1].encode()[:column].decode())

    return offset


def _write_new(file: Path, text: bytes) -> bool:
    """Write a file that is not there yet, whole or not at all; False if somebody made one of that name meanwhile."""
    handle, temporary = tempfile.mkstemp(dir=file.parent, prefix=f".{file.name}.", suffix=".tmp")
    try:
        with os.fdopen(handle, "wb") as out:
            out.write(text)
            out.flush()
            os.fsync(out.fileno())
        os.chmod(temporary, 0o644)
        try:
            os.link(temporary, file)  # unlike a rename it is never over another
        except FileExistsError:
            return False
        except OSError as error:
            if error.errno not in (errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS, errno.EMLINK):
                raise
            # A filesystem without hard links: claim the name, then replace it.
            try:
                file.touch(exist_ok=False)
            except FileExistsError:
                return False
            try:
                os.replace(temporary, file)
            except OSError:
                file.unlink(missing_ok=True)
                raise
        return True
    finally:
        with suppress(FileNotFoundError):
            os.unlink(temporary)
