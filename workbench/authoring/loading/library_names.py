"""What is a library's and what is the author's: files by where they lie, names by who else needs them.

A folder that goes on ``sys.path`` for a task or a policy goes there first, as with ``python task.py``. A file in it
that is called ``numpy.py`` or ``queue.py`` would then stand in for the library wherever one imports it late: in the
middle of an episode, in the renderer, in ours. So the names of the standard library and of what the workbench depends
on are looked for as if that folder were not there, and the author is told of the file. All other names are found
beside the file first, as Python does it.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import re
import sys
import sysconfig
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from importlib.abc import MetaPathFinder
from importlib.machinery import BuiltinImporter, FrozenImporter, ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType

from workbench.machine import DISTRIBUTION

LIBRARY_FOLDERS = {"site-packages", "dist-packages"}
_INSTALLED = tuple(
    {
        os.path.realpath(sysconfig.get_paths()[name]) + os.sep
        for name in ("stdlib", "platstdlib", "purelib", "platlib")
    }
)
LIBRARY_ROOTS = (str(Path(__file__).resolve().parents[2]) + os.sep, *_INSTALLED)
"""Folders of nobody's own files: the workbench's, and those that Python installs into."""
_IMPORTED_BY_NOBODY = {"docs", "example", "examples", "scripts", "test", "tests", "utils"}
"""Packages install such folders by mistake (sapien 3.0.3 an ``example``); authors have their own."""

_author_folders: set[str] = set()
"""All that was ever put on ``sys.path`` for an author."""
_guarded_for_good = False
"""One of them stays there."""


def is_own_file(path: str, folder: Path) -> bool:
    """True for the author's files in or below `folder`.

    A task in a project's root has everything below it: a virtual environment, and the workbench
    itself where it is installed from its repository. Those are nobody's helpers.
    """
    root = str(folder) + os.sep
    if not path.startswith(root) or path.startswith(LIBRARY_ROOTS):
        return False
    return not any(
        part in LIBRARY_FOLDERS or part.startswith(".") for part in path[len(root) :].split(os.sep)
    )


def is_library(name: str) -> bool:
    """Whether the top-level module `name` is a library's, whatever an author has of that name."""
    # In this order: what the distributions contain takes a tenth of a second to read, once.
    if _library_spec(name) is None or name in _IMPORTED_BY_NOBODY:
        return False
    return name in sys.stdlib_module_names or name in _dependency_names()


def files_named_like_libraries(folder: Path) -> tuple[Path, ...]:
    """The author's files in `folder` that no ``import`` finds there, because a library has their name."""
    found: list[Path] = []
    try:
        entries = sorted(os.scandir(folder), key=lambda entry: entry.name)
    except OSError:
        return ()
    for entry in entries:
        path = os.path.join(entry.path, "__init__.py")
        if entry.name.endswith(".py"):
            path = entry.path
        elif not os.path.isfile(path):
            continue
        name = entry.name.removesuffix(".py")
        if name.isidentifier() and is_own_file(path, folder) and is_library(name):
            found.append(Path(entry.path))
    return tuple(found)


def named_like_library(file: Path) -> str:
    """What an author must know of such a file, in a sentence."""
    return (
        f"{file} has the name of a library: `import {file.stem}` gives the library, here and in every library that "
        "imports it. Rename the file to use it."
    )


def search_first(folder: Path, for_good: bool = False) -> None:
    """Put an author's folder first on ``sys.path``, but for the names of libraries.

    Args:
        for_good: It stays there, and `stop_guarding` does nothing any more.
    """
    global _guarded_for_good
    _guarded_for_good = _guarded_for_good or for_good
    name = str(folder)
    # A file of an installed package is opened with the folder of all packages: that stays the libraries'.
    if folder.name not in LIBRARY_FOLDERS and is_own_file(os.path.join(name, "x.py"), folder):
        _author_folders.add(name)
    if not _is_guarded():
        sys.meta_path.insert(0, LibraryFinder())
    sys.path[:] = [name, *(entry for entry in sys.path if entry != name)]


@contextmanager
def searched_first(folder: Path) -> Iterator[None]:
    """As `search_first`, for a while."""
    path, guarded = list(sys.path), _is_guarded()
    search_first(folder)
    try:
        yield
    finally:
        added = [entry for entry in sys.path if entry not in (*path, str(folder))]
        sys.path[:] = [*added, *path]
        if not guarded:
            stop_guarding()


def stop_guarding() -> None:
    """No author's folder is on ``sys.path`` any more, unless one is there for good."""
    if _guarded_for_good:
        return
    sys.meta_path[:] = [finder for finder in sys.meta_path if not isinstance(finder, LibraryFinder)]


class LibraryFinder(MetaPathFinder):
    """Finds the libraries whose names files of the author's have; all else it leaves to others."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if path is not None or not _beside(fullname) or not is_library(fullname):
            return None
        return _library_spec(fullname)


def _is_guarded() -> bool:
    return any(isinstance(finder, LibraryFinder) for finder in sys.meta_path)


def _beside(name: str) -> bool:
    """Whether an author has something of that name where it would be found."""
    folders = [entry for entry in sys.path if entry in _author_folders]
    return PathFinder.find_spec(name, folders) is not None


def _library_spec(name: str) -> ModuleSpec | None:
    """Where `name` is found without the authors' folders."""
    for finder in (BuiltinImporter, FrozenImporter):
        if (spec := finder.find_spec(name)) is not None:
            return spec
    return PathFinder.find_spec(name, [entry for entry in sys.path if entry not in _author_folders])


@lru_cache
def _dependency_names() -> frozenset[str]:
    """Top-level modules of the workbench and of all that it depends on, as far as it is installed."""
    found: set[str] = set()
    wanted = [DISTRIBUTION]
    while wanted:
        name = _plain(wanted.pop())
        if name in found:
            continue
        try:
            required = importlib.metadata.requires(name) or []
        except importlib.metadata.PackageNotFoundError:
            continue  # for another platform, or another version of Python
        found.add(name)
        wanted += [
            said[0]
            for line in required
            if "extra ==" not in line and (said := re.match(r"[\w.-]+", line)) is not None
        ]
    of = importlib.metadata.packages_distributions()
    # What was removed by halves has no name.
    tops = (top for top in of if found.intersection(_plain(owner) for owner in of[top] if owner))
    return frozenset({"workbench", *tops})


def _plain(distribution: str) -> str:
    return re.sub(r"[-_.]+", "-", distribution).lower()
