"""Finds, imports and watches a policy: ``module:function`` or ``file.py:function``."""

from __future__ import annotations

import ast
import difflib
import importlib
import importlib.machinery
import importlib.util
import linecache
import os
import sys
import traceback
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from workbench.envs.error_notes import WrongAction
from workbench.machine.files import MAX_SOURCE_BYTES, read_regular_file
from workbench.machine.parse_python import parse_python
from workbench.task.library_names import (
    files_named_like_libraries,
    is_library,
    named_like_library_text,
    own_modules_first,
    searched_first,
)
from workbench.task.problem import Problem, definition_line, problem_from_exception
from workbench.task.watch import SourceWatcher

Policy = Callable[[Any], Any]
"""Takes the task's batched observation in the task's ``obs_mode``. Returns an array or tensor: (N, A), or one
action (A,) for all envs. For several robots it returns a dict with such an array for each robot."""

_warned: set[Path] = set()
"""Files named like a library, for which a warning was printed."""


class NoPolicy(ValueError):
    """The reference names no policy; the message gives the reason. The author's code never raises it."""


def find_policy(reference: str, task_folder: Path | None = None) -> tuple[str | Path, str]:
    """The module name or file path, and the function name, in `reference`. Imports nothing.

    Args:
        task_folder: the task's folder. A relative file is looked up in the current folder first, then in
            `task_folder`.

    Raises:
        NoPolicy: the reference is not of the form ``module:function`` or ``file.py:function``, or the file
            does not exist.
    """
    if not reference.strip():
        raise NoPolicy("name a policy: module:function or file.py:function")
    name, separator, attribute = reference.rpartition(":")
    if not separator or not name or not attribute:
        raise NoPolicy(f"'{reference}' is not of the form module:function or file.py:function")
    return (_find(name, task_folder) if name.endswith(".py") else name), attribute


def load_policy(reference: str, task_folder: Path | None = None) -> Policy:
    """Import the function of `reference`.

    Args:
        task_folder: as in `find_policy`.

    Raises:
        NoPolicy: as in `find_policy`; or there is no such package, or no such callable in the module.
        Exception: raised by the policy's module during its import.
    """
    named, attribute = find_policy(reference, task_folder)
    name = str(named)
    if isinstance(named, Path):
        path, name = named, f"workbench_policy_{named.stem}"
        spec = importlib.util.spec_from_file_location(name, path, loader=_PolicyLoader(name, str(path)))
        if spec is None or spec.loader is None:
            raise NoPolicy(f"{path} cannot be imported")
        module = importlib.util.module_from_spec(spec)
        for file in files_named_like_libraries(path.parent):
            if file not in (path, *_warned):
                _warned.add(file)
                print(named_like_library_text(file), file=sys.stderr)
        with searched_first(path.parent), own_modules_first(path.parent):
            spec.loader.exec_module(module)
    elif importlib.util.find_spec(package := name.partition(".")[0]) is None:
        # A module that is not installed is searched for in the current folder.
        with searched_first(Path.cwd()):
            if importlib.util.find_spec(package) is None:
                raise NoPolicy(f"there is no module {package}: it is neither installed nor in {Path.cwd()}")
            module = importlib.import_module(name)
    else:
        module = importlib.import_module(name)
    function = getattr(module, attribute, None)
    if not callable(function):
        callables = [each for each, value in vars(module).items() if callable(value)]
        close = difflib.get_close_matches(attribute, callables, n=1)
        hint = f"; did you mean {close[0]}?" if close else _hint(name, attribute, task_folder)
        raise NoPolicy(f"{named} has no function {attribute}{hint}")
    return function


def _hint(name: str, attribute: str, task_folder: Path | None) -> str:
    """End of the message for a missing function: how to refer to the file ``<name>.py`` if a library's module
    of that name was imported instead; empty if there is no such file or no such module."""
    for folder in (Path.cwd(), task_folder or Path.cwd()):
        file = folder / f"{name}.py"
        if file.is_file() and is_library(name):
            return f"; {name} is a library's module, so name the file: {file}:{attribute}"
    return ""


class _PolicyLoader(importlib.machinery.SourceFileLoader):
    """Reads only regular files of limited size; see `read_regular_file`."""

    def get_data(self, path: str) -> bytes:
        return read_regular_file(path, MAX_SOURCE_BYTES)

    def path_stats(self, path: str) -> Mapping[str, Any]:
        # The bytecode cache compares only a file's size and the second of its last change: it would miss a
        # save of the same size within that second.
        raise OSError("no bytecode is kept")


def policy_problem(
    error: BaseException, reference: str, task_folder: Path | None = None, policy: Policy | None = None
) -> Problem:
    """The problem of a policy, at a line of its module or of the author's other code that it calls.

    Args:
        task_folder: as in `load_policy`.
        policy: the function, if it was imported. If the traceback has no line of the author's (after a wrong
            return value, for example), the problem is at the function's ``def``.
    """
    if isinstance(error, NoPolicy):
        return Problem("policy", str(error), None, None, None, "")
    linecache.checkcache()  # the file may have changed since linecache read it
    defined = None if policy is None else definition_line(policy)
    if isinstance(error, WrongAction):
        file, line = defined or (None, None)
        code = None if defined is None else linecache.getline(*defined).strip() or None
        return Problem("policy", f"what {reference} returned {error.problem}", file, line, code, "")
    files = [Path(frame.filename) for frame in traceback.extract_tb(error.__traceback__)]
    own = [file for file in files if _is_module_of(file, reference, task_folder)]
    # The stage is "policy" even for a syntax error: the fault is not the task's.
    return replace(problem_from_exception(error, "policy", own, otherwise=defined), stage="policy")


def _is_module_of(file: Path, reference: str, task_folder: Path | None) -> bool:
    name = reference.rpartition(":")[0]
    if name.endswith(".py"):
        path = Path(os.path.expanduser(name))
        return file in (path.resolve(), (task_folder or Path()).joinpath(path).resolve())
    module = sys.modules.get(name)
    if module is not None and module.__spec__ is not None:
        return str(file) == module.__spec__.origin
    # The import failed: there is no module to compare.
    path = "/" + name.replace(".", "/")
    return str(file).endswith((f"{path}.py", f"{path}/__init__.py"))


def _find(name: str, task_folder: Path | None) -> Path:
    """The file's path: in the current folder, else in the task's folder."""
    path = Path(os.path.expanduser(name))
    here = path.resolve()
    if here.is_file():
        return here
    if path.is_absolute() or task_folder is None or (task_folder / path).resolve() == here:
        raise NoPolicy(f"there is no file {here}")
    there = (task_folder / path).resolve()
    if not there.is_file():
        raise NoPolicy(
            f"there is no {name} in {Path.cwd()}, where the command was started, nor in the folder of the task, {task_folder}"
        )
    return there


MAX_FILES, MAX_LISTED = 100, 40
"""Maximum number of files of a folder that are read, and of policies that are listed."""
_MAX_FILE_BYTES = 256 * 1024
"""Maximum size of a file that is searched for policies; no person writes a larger file."""


def list_policies(here: Path, task_folder: Path | None) -> tuple[str, ...]:
    """Functions that may be policies, as ``file.py:function``: functions with one required parameter, in the
    files of `here` and of the task's folder. Parses the files without importing them. Functions whose
    parameter's name begins with ``obs`` come first.

    Args:
        here: the folder where the command was started.
    """
    found: list[tuple[bool, str]] = []
    taken: set[str] = set()
    folders = [here.resolve()] if task_folder is None else [here.resolve(), task_folder.resolve()]
    for folder in folders if folders[0] != folders[-1] else folders[:1]:
        for file in _python_files(folder):
            # As in `find_policy`, a file of the first folder hides a file of the same name in the second, so
            # the second one is listed by its full path.
            name = str(file) if file.name in taken else file.name
            taken.add(file.name)
            found += [(not likely, f"{name}:{function}") for function, likely in _functions_that_fit(file)]
    return tuple(reference for _, reference in sorted(found, key=lambda one: one[0])[:MAX_LISTED])


def _python_files(folder: Path) -> list[Path]:
    try:
        files = sorted(file for file in folder.iterdir() if file.suffix == ".py")
    except OSError:
        return []  # the folder is deleted or not readable
    return [file for file in files if not file.name.startswith(("test_", "conftest", "setup."))][:MAX_FILES]


def _functions_that_fit(file: Path) -> list[tuple[str, bool]]:
    """Names of public functions with one required parameter, and whether that parameter's name begins with
    ``obs``."""
    try:
        tree = parse_python(read_regular_file(file, _MAX_FILE_BYTES))
    except (OSError, ValueError, SyntaxError, RecursionError, MemoryError):
        return []  # its policies are not listed; loading one by name reports the reason
    found = []
    for node in tree.body:
        if not isinstance(node, ast.FunctionDef) or node.name.startswith("_"):
            continue
        given = node.args
        named = [*given.posonlyargs, *given.args]
        required = named[: len(named) - len(given.defaults)]
        if len(required) == 1 and None not in given.kw_defaults:
            found.append((node.name, required[0].arg.startswith("obs")))
    return found


class PolicyFile:
    """Watches the file of the current policy for changes. Thread-safe."""

    def __init__(self, on_save: Callable[[], None]) -> None:
        """
        Args:
            on_save: called on the watcher's thread when the file has changed.
        """
        self._on_save = on_save
        self._watcher: SourceWatcher | None = None
        self._files: list[Path] = []

    def follow(self, reference: str | None, task_folder: Path | None) -> None:
        """Watch only the file of this ``file.py:function`` from now on; nothing for a ``module:function``.

        Args:
            task_folder: as in `find_policy`.
        """
        name = (reference or "").rpartition(":")[0]
        files: list[Path] = []
        if name.endswith(".py"):
            path = Path(os.path.expanduser(name))
            files = [path, *([] if task_folder is None else [task_folder / path])]
        if files == self._files:
            return
        self._files = files
        if self._watcher is None:
            self._watcher = SourceWatcher(lambda changed: self._on_save())
        self._watcher.follow(files)

    def close(self) -> None:
        if self._watcher is not None:
            self._watcher.stop()
