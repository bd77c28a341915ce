"""Distinguishes the author's files and modules from those of libraries."""

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
LIBRARY_ROOTS = (str(Path(__file__).resolve().parents[1]) + os.sep, *_INSTALLED)
"""Folders without files of an author: the workbench's, and those that Python installs into."""
_INSTALLED_BY_MISTAKE = {"docs", "example", "examples", "scripts", "test", "tests", "utils"}
"""Names of folders that packages install by mistake (sapien 3.0.3: ``example``). Authors have folders of
these names too."""

_author_folders: set[str] = set()
"""Every folder that was put on ``sys.path`` for an author."""
_permanent_folder = False
"""Whether an author's folder stays on ``sys.path``."""


def is_own_file(path: str, folder: Path) -> bool:
    """True for the author's files in or below `folder`.

    A project's root may also contain a virtual environment, and the workbench itself if it was installed from a
    clone. Their files are not the author's.
    """
    root = str(folder) + os.sep
    if not path.startswith(root) or path.startswith(LIBRARY_ROOTS):
        return False
    return not any(
        part in LIBRARY_FOLDERS or part.startswith(".") for part in path[len(root) :].split(os.sep)
    )


def importable_names(folder: Path) -> frozenset[str]:
    """Names of the modules and packages in `folder`; empty if it cannot be listed."""
    try:
        entries = list(os.scandir(folder))
    except OSError:
        return frozenset()
    return frozenset(
        one.name.removesuffix(".py") for one in entries if one.name.endswith(".py") or one.is_dir()
    )


def hides_module_of(folder: Path, name: str, module: ModuleType, names: frozenset[str]) -> bool:
    """Whether the loaded module `name` is an author's of another folder, so that ``import`` would give it instead of a
    module of the same name in `folder`.

    Args:
        names: `importable_names` of the folder.
    """
    # Not getattr: it triggers the imports of lazy modules.
    file = getattr(module, "__dict__", {}).get("__file__")
    if name.partition(".")[0] not in names or not isinstance(file, str) or not file.endswith(".py"):
        return False
    is_librarys = file.startswith(LIBRARY_ROOTS) or not LIBRARY_FOLDERS.isdisjoint(file.split(os.sep))
    return not is_librarys and not is_own_file(file, folder)


def is_library(name: str) -> bool:
    """Whether the top-level module `name` is a library's, even if an author has a file of that name."""
    # The slow check is last: reading the contents of the distributions takes 0.1 s, once.
    if _library_spec(name) is None or name in _INSTALLED_BY_MISTAKE:
        return False
    return name in sys.stdlib_module_names or name in _dependency_names()


def files_named_like_libraries(folder: Path) -> tuple[Path, ...]:
    """The author's files in `folder` that ``import`` does not find because a library has the same name."""
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


def named_like_library_text(file: Path) -> str:
    """Notice about a file that has the name of a library."""
    return (
        f"{file} has the name of a library: `import {file.stem}` gives the library, here and in every library that "
        "imports it. Rename the file to use it."
    )


def search_first(folder: Path, permanent: bool = False) -> None:
    """Put an author's folder first on ``sys.path``, but never find a module there that has a library's name.

    As with ``python task.py``, the folder comes first. A ``numpy.py`` or ``queue.py`` in it would replace the library
    for every late import: in the middle of an episode, in the renderer, in the workbench. So names of the standard
    library and of the workbench's dependencies are found as if the folder were not on the path.

    Args:
        permanent: the folder stays, and `remove_library_finder` does nothing from now on.
    """
    global _permanent_folder
    _permanent_folder = _permanent_folder or permanent
    name = str(folder)
    # site-packages is not an author's folder, even if a task in it is opened.
    if folder.name not in LIBRARY_FOLDERS and is_own_file(os.path.join(name, "x.py"), folder):
        _author_folders.add(name)
    if not _finder_is_installed():
        sys.meta_path.insert(0, LibraryFinder())
    sys.path[:] = [name, *(entry for entry in sys.path if entry != name)]


@contextmanager
def searched_first(folder: Path) -> Iterator[None]:
    """Context manager that applies `search_first` to its block; entries that the block adds to ``sys.path``
    stay."""
    path, guarded = list(sys.path), _finder_is_installed()
    search_first(folder)
    try:
        yield
    finally:
        added = [entry for entry in sys.path if entry not in (*path, str(folder))]
        sys.path[:] = [*added, *path]
        if not guarded:
            remove_library_finder()


@contextmanager
def own_modules_first(folder: Path) -> Iterator[None]:
    """Context manager: in its block ``import`` gives the modules of `folder`, not modules of the same names that were
    loaded from another author's folder. Afterwards those are in ``sys.modules`` again."""
    names = importable_names(folder)
    others = {
        name: module
        for name, module in list(sys.modules.items())
        if hides_module_of(folder, name, module, names)
    }
    for name in others:
        del sys.modules[name]
    try:
        yield
    finally:
        hidden = {name.partition(".")[0] for name in others}
        for name in [name for name in sys.modules if name.partition(".")[0] in hidden]:
            del sys.modules[name]
        sys.modules.update(others)


def remove_library_finder() -> None:
    """Remove the `LibraryFinder`; called after the last author's folder has left ``sys.path``. Does nothing
    if a folder is permanent."""
    if _permanent_folder:
        return
    sys.meta_path[:] = [finder for finder in sys.meta_path if not isinstance(finder, LibraryFinder)]


class LibraryFinder(MetaPathFinder):
    """Import finder that finds a library instead of an author's file of the same name; leaves other names to the next
    finder."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if path is not None or not _is_author_module(fullname) or not is_library(fullname):
            return None
        return _library_spec(fullname)


def _finder_is_installed() -> bool:
    return any(isinstance(finder, LibraryFinder) for finder in sys.meta_path)


def _is_author_module(name: str) -> bool:
    """Whether a module of that name is in an author's folder on ``sys.path``."""
    folders = [entry for entry in sys.path if entry in _author_folders]
    return PathFinder.find_spec(name, folders) is not None


def _library_spec(name: str) -> ModuleSpec | None:
    """The spec of `name`, searched without the authors' folders."""
    for finder in (BuiltinImporter, FrozenImporter):
        if (spec := finder.find_spec(name)) is not None:
            return spec
    return PathFinder.find_spec(name, [entry for entry in sys.path if entry not in _author_folders])


@lru_cache
def _dependency_names() -> frozenset[str]:
    """Top-level modules of the workbench and of its installed dependencies."""
    found: set[str] = set()
    pending = [DISTRIBUTION]
    while pending:
        name = _plain(pending.pop())
        if name in found:
            continue
        try:
            required = importlib.metadata.requires(name) or []
        except importlib.metadata.PackageNotFoundError:
            continue  # for another platform, or another version of Python
        found.add(name)
        pending += [
            match[0]
            for line in required
            if "extra ==" not in line and (match := re.match(r"[\w.-]+", line)) is not None
        ]
    of = importlib.metadata.packages_distributions()
    # A half-removed distribution has no name.
    tops = (top for top in of if found.intersection(_plain(owner) for owner in of[top] if owner))
    return frozenset({"workbench", *tops})


def _plain(distribution: str) -> str:
    return re.sub(r"[-_.]+", "-", distribution).lower()
