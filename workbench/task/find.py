"""Finds the task files below a folder by parsing them, without running or importing any."""

from __future__ import annotations

import ast
import os
import re
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from workbench.machine.files import read_regular_file
from workbench.machine.parse_python import parse_python
from workbench.task.library_names import LIBRARY_FOLDERS

MAX_DEPTH = 6
"""Maximum depth of searched folders below the given folder."""
MAX_FILES_READ = 5_000
"""Maximum number of Python files that are opened."""
MAX_FOUND = 200
MAX_FILE_BYTES = 512 * 1024
"""Maximum size of a file that is read; the largest task of ManiSkill has 60 kB."""
TIMEOUT_SECONDS = 5.0
"""Timeout of one search."""
MAX_NAME_CHARACTERS = 120
"""Length to which an id or a class name is cut."""
_NO_TASKS_IN = LIBRARY_FOLDERS | {"node_modules", "__pycache__", "build", "dist"}
_ENVIRONMENT_HAS = ("pyvenv.cfg", "conda-meta")
"""Files and folders that only the root of a Python environment has."""


@dataclass(frozen=True)
class TaskFile:
    """A Python file with a task, as its text describes it."""

    path: Path
    """Absolute path, without links."""
    ids: tuple[str, ...]
    """Ids that the file registers, as far as they are string literals."""
    classes: tuple[str, ...]
    """Task classes of the file, in the order of the text."""
    not_python: bool = False
    """Whether the text does not parse."""
    line: int | None = None
    """Line of the syntax error, if known."""


@dataclass(frozen=True)
class FoundTasks:
    """The result of a search."""

    files: tuple[TaskFile, ...] = ()
    """Sorted by depth below the folder, the folder's own files first, and then by path."""
    left_out: str = ""
    """Why the search may have missed files, as a sentence; empty if it is complete."""


class TaskFileReader:
    """Cache of `read_task_file` by path; rereads a file when its ``stat`` has changed."""

    def __init__(self) -> None:
        self._known: dict[Path, tuple[tuple[int, ...], TaskFile | None]] = {}

    def read(self, path: Path) -> TaskFile | None:
        """The result of `read_task_file`, read again only when the file's ``stat`` has changed."""
        try:
            found = os.stat(path)
        except OSError:
            self._known.pop(path, None)
            return None
        status = found.st_mtime_ns, found.st_ctime_ns, found.st_size, found.st_ino
        known = self._known.get(path)
        if known is None or known[0] != status:
            known = self._known[path] = status, read_task_file(path)
        return known[1]


def find_task_files(folder: Path, read: Callable[[Path], TaskFile | None] | None = None) -> FoundTasks:
    """The task files in and below a folder.

    Hidden folders, Python environments, installed packages and links are left out. With too many files, or after the
    timeout, the search ends early; `FoundTasks.left_out` says why.

    Args:
        read: reads a file; None for `read_task_file`.
    """
    read = read or read_task_file
    root = Path(os.path.realpath(folder))
    ends_at = time.monotonic() + TIMEOUT_SECONDS
    found: list[TaskFile] = []
    left_out = ""
    for number, path in enumerate(_python_files(root)):
        if number >= MAX_FILES_READ:
            left_out = f"Only the first {MAX_FILES_READ} Python files were searched."
        elif len(found) >= MAX_FOUND:
            left_out = f"Only the first {MAX_FOUND} task files are listed."
        elif time.monotonic() > ends_at:
            left_out = f"The search ended after {TIMEOUT_SECONDS:.0f} s."
        if left_out:
            break
        if (task := read(path)) is not None:
            found.append(task)
    found.sort(key=lambda task: (len(task.path.relative_to(root).parts), str(task.path)))
    return FoundTasks(tuple(found), left_out)


_BEGUN = re.compile(rb"^[ \t]*(class[ \t][^(\n]*\([^)\n]*\bBaseEnv\b|@[\w.]*\bregister_env\b)", re.MULTILINE)
"""Pattern for a text that does not parse: with a match, it is most likely an unfinished task."""


def read_task_file(path: Path) -> TaskFile | None:
    """Tasks of a file, according to its text; None if it has none or cannot be read."""
    try:
        raw = read_regular_file(path, MAX_FILE_BYTES)
    except (OSError, ValueError):
        return None
    # Check this before parsing, which takes 20 ms for a large file.
    if b"BaseEnv" not in raw and b"register_env" not in raw:
        return None
    try:
        with warnings.catch_warnings():
            # Otherwise a text with "\d" would print a warning in the terminal.
            warnings.simplefilter("ignore")
            tree = parse_python(raw)
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        line = error.lineno if isinstance(error, SyntaxError) else None
        return TaskFile(path, (), (), not_python=True, line=line) if _BEGUN.search(raw) else None
    ids, classes = _tasks_of(tree)
    return TaskFile(path, ids, classes) if classes else None


def _python_files(root: Path) -> Iterator[Path]:
    """The Python files below `root`, breadth first, so that a deep folder cannot hide the files at the top."""
    waiting = [(root, 0)]
    while waiting:
        folder, depth = waiting.pop(0)
        try:
            entries = sorted(os.scandir(folder), key=lambda entry: entry.name)
        except OSError:
            continue  # not permitted, or deleted meanwhile
        if depth and any(entry.name in _ENVIRONMENT_HAS for entry in entries):
            continue
        for entry in entries:
            if entry.name.startswith("."):
                continue
            # Do not follow links: they can form cycles and lead out of the folder.
            if _is(entry.is_dir):
                if depth < MAX_DEPTH and entry.name not in _NO_TASKS_IN:
                    waiting.append((Path(entry.path), depth + 1))
            elif entry.name.endswith(".py") and _is(entry.is_file):
                yield Path(entry.path)


def _is(kind: Callable[..., bool]) -> bool:
    try:
        return kind(follow_symlinks=False)
    except OSError:
        return False


def is_below(path: Path, folder: Path) -> bool:
    """Whether a path, with all links followed, is in or below a folder."""
    return Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder))


def _tasks_of(tree: ast.Module) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Ids and class names of the tasks in a module."""
    ids: list[str] = []
    tasks: list[str] = []
    for node in _top_level(tree):
        if not isinstance(node, ast.ClassDef) or node.name == "BaseEnv":
            continue
        registrations = [call for call in node.decorator_list if _name(call) == "register_env"]
        if registrations or any(_name(base) in ("BaseEnv", *tasks) for base in node.bases):
            tasks.append(node.name[:MAX_NAME_CHARACTERS])
        ids += filter(None, map(_registered_id, registrations))
    return tuple(dict.fromkeys(ids)), tuple(dict.fromkeys(tasks))


def _top_level(tree: ast.Module) -> Iterator[ast.stmt]:
    """The statements of a module, and those within its ``if``, ``try`` and ``with`` statements."""
    waiting: list[ast.stmt] = list(reversed(tree.body))
    while waiting:
        node = waiting.pop()
        yield node
        if isinstance(node, (ast.If, ast.Try, ast.With)):
            inner = [*node.body, *getattr(node, "orelse", ())]
            waiting += reversed(inner)


def _name(node: ast.expr) -> str:
    """The last name of an expression: ``BaseEnv`` for each of ``BaseEnv``, ``sapien_env.BaseEnv``, ``BaseEnv(...)`` and
    ``BaseEnv[...]``. Empty for any other form."""
    if isinstance(node, ast.Call):
        node = node.func
    if isinstance(node, ast.Subscript):
        node = node.value
    if isinstance(node, ast.Attribute):
        return node.attr
    return node.id if isinstance(node, ast.Name) else ""


def _registered_id(call: ast.expr) -> str:
    """The id in ``@register_env("Push-v1")``; empty if it is computed."""
    if not isinstance(call, ast.Call):
        return ""
    given = [*call.args[:1], *(word.value for word in call.keywords if word.arg == "uid")]
    texts = [one.value for one in given if isinstance(one, ast.Constant) and isinstance(one.value, str)]
    return texts[0][:MAX_NAME_CHARACTERS] if texts else ""
