"""A policy that the author names: ``module:function`` or ``file.py:function``, obs to action; and its file, followed.

The function is called with the task's observation (as its ``obs_mode`` gives it, batched) and returns
an action for all envs: an array or tensor (N, A), one action (A,) for all, or a dict for several
robots.
"""

from __future__ import annotations

import importlib
import importlib.machinery
import importlib.util
import linecache
import sys
import traceback
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from workbench.authoring.loading.library_names import (
    files_named_like_libraries,
    is_library,
    named_like_library_text,
    searched_first,
)
from workbench.authoring.loading.watch import SourceWatcher
from workbench.authoring.problem import Problem, definition_line, problem_from_exception
from workbench.machine.files import MOST_SOURCE_BYTES, read_regular_file

Policy = Callable[[Any], Any]

_told: set[Path] = set()
"""Files beside policies of which it was said that a library has their name."""


class NoPolicy(ValueError):
    """What was named is no policy; the message says why. Nothing of the author's raised it."""


def find_policy(reference: str, beside: Path | None = None) -> tuple[str | Path, str]:
    """The module or file, and the function, that `reference` names. Imports nothing.

    Args:
        beside: a folder in which a relative file is looked for when it is not in the current one.

    Raises:
        NoPolicy: it is not of that form, or the file is not there.
    """
    if not reference.strip():
        raise NoPolicy("name a policy: module:function or file.py:function")
    name, separator, attribute = reference.rpartition(":")
    if not separator or not name or not attribute:
        raise NoPolicy(f"'{reference}' is not of the form module:function or file.py:function")
    return (_find(name, beside) if name.endswith(".py") else name), attribute


def load_policy(reference: str, beside: Path | None = None) -> Policy:
    """Import the function that `reference` names.

    Args:
        beside: as for `find_policy`.

    Raises:
        NoPolicy: the reference is not of that form, or names nothing callable.
        Exception: whatever the policy's module raises while it is imported.
    """
    named, attribute = find_policy(reference, beside)
    name = str(named)
    if isinstance(named, Path):
        path, name = named, f"workbench_policy_{named.stem}"
        spec = importlib.util.spec_from_file_location(name, path, loader=_PolicyLoader(name, str(path)))
        if spec is None or spec.loader is None:
            raise NoPolicy(f"{path} cannot be imported")
        module = importlib.util.module_from_spec(spec)
        for file in files_named_like_libraries(path.parent):
            if file not in (path, *_told):
                _told.add(file)
                print(named_like_library_text(file), file=sys.stderr)
        with searched_first(path.parent):
            spec.loader.exec_module(module)
    elif importlib.util.find_spec(package := name.partition(".")[0]) is None:
        # Whoever names a module in words means the one that they see where they are.
        with searched_first(Path.cwd()):
            if importlib.util.find_spec(package) is None:
                raise NoPolicy(f"there is no module {package}: it is neither installed nor in {Path.cwd()}")
            module = importlib.import_module(name)
    else:
        module = importlib.import_module(name)
    function = getattr(module, attribute, None)
    if not callable(function):
        raise NoPolicy(f"{name} has no function {attribute}{_hint(name, attribute, beside)}")
    return function


def _hint(name: str, attribute: str, beside: Path | None) -> str:
    """How to name a file whose name a library has."""
    for folder in (Path.cwd(), beside or Path.cwd()):
        file = folder / f"{name}.py"
        if file.is_file() and is_library(name):
            return f", it is a library's; name the file: {file}:{attribute}"
    return ""


class _PolicyLoader(importlib.machinery.SourceFileLoader):
    """Reads only what a program can be; see `regular_file`."""

    def get_data(self, path: str) -> bytes:
        return read_regular_file(path, MOST_SOURCE_BYTES)

    def path_stats(self, path: str) -> Mapping[str, Any]:
        # Python's own cache tells two versions apart by length and whole seconds: a second save would not be seen.
        raise OSError("no bytecode is kept")


def problem_of(
    error: BaseException, reference: str, beside: Path | None = None, policy: Policy | None = None
) -> Problem:
    """What is wrong with the policy that `reference` names, at a line of its module or of one in the same folder.

    Args:
        beside: as for `load_policy`.
        policy: what `load_policy` gave, if it got so far: its ``def`` is the place where no line on the traceback
            is the author's, because it is what it returned that is wrong.
    """
    if isinstance(error, NoPolicy):
        return Problem("policy", str(error), None, None, None, "")
    linecache.checkcache()  # it may have been mended, and be wrong elsewhere, since a line of it was last shown
    files = [Path(frame.filename) for frame in traceback.extract_tb(error.__traceback__)]
    if isinstance(error, SyntaxError) and error.filename is not None:
        files.append(Path(error.filename))
    folders = {file.parent for file in files if _is_module_of(file, reference, beside)}
    problem = problem_from_exception(error, "policy", [file for file in files if file.parent in folders])
    if problem.file is None and policy is not None and (place := definition_line(policy)) is not None:
        file, line = place
        problem = replace(problem, file=file, line=line, code=linecache.getline(file, line).strip() or None)
    # Also what cannot be parsed: the task's own file is well.
    return replace(problem, stage="policy")


def _is_module_of(file: Path, reference: str, beside: Path | None) -> bool:
    name = reference.rpartition(":")[0]
    if name.endswith(".py"):
        path = Path(name).expanduser()
        return file in (path.resolve(), (beside or Path()).joinpath(path).resolve())
    module = sys.modules.get(name)
    if module is not None and module.__spec__ is not None:
        return str(file) == module.__spec__.origin
    # It failed while it was imported.
    path = "/" + name.replace(".", "/")
    return str(file).endswith((f"{path}.py", f"{path}/__init__.py"))


def _find(name: str, beside: Path | None) -> Path:
    """Where the file is: in the folder where the command was started, or else beside the task."""
    path = Path(name).expanduser()
    here = path.resolve()
    if here.is_file():
        return here
    if path.is_absolute() or beside is None or (beside / path).resolve() == here:
        raise NoPolicy(f"there is no file {here}")
    there = (beside / path).resolve()
    if not there.is_file():
        raise NoPolicy(
            f"there is no {name} in {Path.cwd()}, where the command was started, nor beside the task in {beside}"
        )
    return there


class PolicyFile:
    """Follows the file of the policy that acts, as the task's is followed: a save has it imported anew. Used from any thread."""

    def __init__(self, on_save: Callable[[], None]) -> None:
        """`on_save` is called on a thread of this object's own."""
        self._on_save = on_save
        self._watcher: SourceWatcher | None = None
        self._files: list[Path] = []

    def follow(self, reference: str | None, beside: Path | None) -> None:
        """The file of a ``file.py:function`` from now on, wherever it may lie; of anything else, none.

        Args:
            beside: a folder in which a relative file is looked for when it is not in the current one.
        """
        name = (reference or "").rpartition(":")[0]
        files: list[Path] = []
        if name.endswith(".py"):
            path = Path(name).expanduser()
            files = [path, *([] if beside is None else [beside / path])]
        if files == self._files:
            return
        self._files = files
        if self._watcher is None:
            self._watcher = SourceWatcher(lambda changed: self._on_save())
        self._watcher.follow(files)

    def close(self) -> None:
        if self._watcher is not None:
            self._watcher.stop()
