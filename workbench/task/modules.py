"""Finds, executes and unloads an author's modules, without bytecode files and stale namespaces."""

from __future__ import annotations

import importlib.machinery
import importlib.util
import io
import linecache
import os
import re
import sys
import tokenize
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from importlib.abc import MetaPathFinder
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any

from workbench.machine.files import MAX_SOURCE_BYTES, read_regular_file
from workbench.source.parsed import plain_line_ends
from workbench.task.library_names import (
    LIBRARY_ROOTS,
    files_named_like_libraries,
    hides_module_of,
    importable_names,
    is_library,
    is_own_file,
)

_MODULE_PREFIX = "workbench_task_"


@dataclass(frozen=True)
class ModuleName:
    """Name of a task's file in ``sys.modules``, and the folder that must be on ``sys.path``."""

    name: str
    search_folder: Path
    own_folder: Path
    """Folder of the author: the files in and below it are the author's."""


def module_name(file: Path) -> ModuleName:
    """The module name of `file`: unique, and the same at every load.

    For a file in a package (its folder has an ``__init__.py``) it is the dotted name, which relative imports
    need.
    """
    if (file.parent / "__init__.py").is_file():
        parts, folder = [] if file.stem == "__init__" else [file.stem], file.parent
        while (folder / "__init__.py").is_file() and folder.name.isidentifier():
            parts.insert(0, folder.name)
            folder = folder.parent
        return ModuleName(".".join(parts), folder, file.parent)
    stem = re.sub(r"\W", "_", file.stem)
    name = f"{_MODULE_PREFIX}{stem}_{sha256(str(file).encode()).hexdigest()[:8]}"
    return ModuleName(name, file.parent, file.parent)


def hidden_by_libraries(file: Path, search_folder: Path | None = None) -> tuple[Path, ...]:
    """Files in the folder of the task `file` that it cannot import because a library has their name."""
    folder = search_folder or module_name(file).search_folder
    return tuple(found for found in files_named_like_libraries(folder) if found != file)


class AuthorFinder(MetaPathFinder):
    """Finds and executes the modules of one task: its file, and those of its folder.

    `importlib.reload` runs new text in the old namespace, so deleted names live on. It also ignores the other
    modules of the folder. Python's own import trusts a ``.pyc`` whose modification time (in whole seconds)
    and size match, so it misses a change of ``0.1`` to ``0.2`` that is saved in the same second as the
    previous text. This finder compiles from text alone and keeps every text it executed: for the watcher, for
    recordings, and for tracebacks (through `linecache`), which must show the text that ran.
    """

    def __init__(
        self,
        file: Path,
        given: Mapping[str, str],
        only_given: bool = False,
        named: ModuleName | None = None,
    ) -> None:
        """
        Args:
            named: the module as a person named it; None derives the name from the file's path.
        """
        self.file = file
        place = named or module_name(file)
        self.main, self.search_folder, self.own_folder = place.name, place.search_folder, place.own_folder
        self.goes_by_stem = named is None
        """Whether helpers may import the task by its file's name."""
        self.given = given
        """Text by path that replaces the file on disk."""
        self.only_given = only_given
        """Whether to execute no file of the folder except those in `given`: a recording named the task, and a
        person approved these texts."""
        self.texts: dict[str, str] = {}
        """Text by path of the files read so far, in order."""
        self.names: list[str] = []
        """Names in ``sys.modules`` of the executed modules."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        if fullname == self.main:
            return self._spec(fullname, str(self.file), is_package=self.file.stem == "__init__")
        spec = self._find_in_folder(fullname, path, target)
        if spec is not None and path is None and is_library(fullname):
            return None
        return spec

    def _find_in_folder(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None
    ) -> importlib.machinery.ModuleSpec | None:
        last = fullname.rpartition(".")[2]
        for folder in [str(self.search_folder)] if path is None else list(path):
            for name, is_package in ((os.path.join(last, "__init__.py"), True), (f"{last}.py", False)):
                candidate = os.path.join(folder, name)
                if candidate in self.given:
                    return self._spec(fullname, candidate, is_package)
        if self.only_given:
            return self._given_folder(fullname, last, path) if self._is_newest else None
        found = importlib.machinery.PathFinder.find_spec(fullname, path, target)
        if (
            found is None
            or found.origin is None
            or not isinstance(found.loader, importlib.machinery.SourceFileLoader)
        ):
            return None
        if not is_own_file(found.origin, self.own_folder):
            return None
        return self._spec(fullname, found.origin, found.submodule_search_locations is not None)

    def _given_folder(
        self, fullname: str, last: str, path: Sequence[str] | None
    ) -> importlib.machinery.ModuleSpec | None:
        """The spec for a name that has no given text: an installed module, else a folder of given texts without
        ``__init__.py``.

        Raises ModuleNotFoundError for a file of the task's folder that has no given text. After None, Python
        would continue with `PathFinder`, which finds this file if an earlier task, or the code itself, has
        put the folder on ``sys.path``.
        """
        root = str(self.file.parent)
        places = [place for place in (sys.path if path is None else path) if not _is_in(place, root)]
        found = importlib.machinery.PathFinder.find_spec(fullname, places) if places else None
        if found is not None:
            return found
        folders = [
            os.path.join(folder, last)
            for folder in ([str(self.search_folder)] if path is None else path)
            if any(given.startswith(os.path.join(folder, last) + os.sep) for given in self.given)
        ]
        if folders:
            spec = importlib.machinery.ModuleSpec(fullname, None, is_package=True)
            spec.submodule_search_locations = folders
            return spec
        if importlib.machinery.PathFinder.find_spec(fullname, path) is None:
            return None
        for finder in sys.meta_path:
            if not isinstance(finder, AuthorFinder) and finder is not importlib.machinery.PathFinder:
                spec = finder.find_spec(fullname, path)
                if spec is not None:
                    return spec
        raise ModuleNotFoundError(f"No module named {fullname!r}", name=fullname)

    @property
    def _is_newest(self) -> bool:
        """Whether this finder's task was loaded last: imports then count as imports of this task."""
        return next((f for f in sys.meta_path if isinstance(f, AuthorFinder)), None) is self

    def text(self, path: str) -> str:
        """The text to execute for `path`. Raises OSError, or SyntaxError if it is not text."""
        if path in self.given:
            return self.given[path]
        raw = read_regular_file(path, MAX_SOURCE_BYTES)
        try:
            return decode(path, raw)
        except SyntaxError:
            # Keep the text, so that the problem's line can be shown.
            self.add_text(path, raw.decode(errors="replace"))
            raise

    def add_text(self, path: str, text: str) -> None:
        self.texts[path] = text
        show_in_tracebacks(path, text)

    def _spec(self, name: str, path: str, is_package: bool) -> importlib.machinery.ModuleSpec | None:
        return importlib.util.spec_from_file_location(
            name,
            path,
            loader=_AuthorLoader(self, name, path),
            submodule_search_locations=[os.path.dirname(path)] if is_package else None,
        )


def _work(code: CodeType) -> tuple[bytes, tuple[str, ...]]:
    return code.co_code, code.co_names


_NO_WORK = [_work(compile(text, "", "exec", dont_inherit=True)) for text in ("", "'a docstring'")]


class _AuthorLoader(importlib.machinery.SourceFileLoader):
    """Executes one text. Reads and writes no bytecode files."""

    executed = 0
    """Number of modules that the loaders of this process have begun to execute; modules without a statement
    do not count."""

    def __init__(self, finder: AuthorFinder, name: str, path: str) -> None:
        super().__init__(name, path)
        self.finder = finder

    def get_source(self, fullname: str) -> str:
        path = self.get_filename(fullname)
        return self.finder.texts[path] if path in self.finder.texts else self.finder.text(path)

    def get_code(self, fullname: str) -> CodeType:
        path = self.get_filename(fullname)
        text = self.finder.text(path)
        # Added before compile(): the line of a SyntaxError is looked up in this text.
        self.finder.add_text(path, text)
        if "\0" in text:
            # Python's own error names neither file nor line.
            line = text[: text.index("\0")].count("\n") + 1
            raise SyntaxError("source code cannot contain null bytes", (path, line, 1, None))
        return compile(text, path, "exec", dont_inherit=True)

    def exec_module(self, module: ModuleType) -> None:
        name = module.__name__
        self.finder.names.append(name)
        stem = self.finder.file.stem
        is_main = name == self.finder.main and self.finder.goes_by_stem
        if is_main and stem not in sys.modules and not is_library(stem):
            # A helper that imports the task by its file's name must get this module: executing the file as a
            # second module would register its ids twice.
            sys.modules[stem] = module
            self.finder.names.append(stem)
        code = self.get_code(name)
        _AuthorLoader.executed += _work(code) not in _NO_WORK
        exec(code, module.__dict__)


def executed_modules() -> int:
    """Number of authors' modules that this process has begun to execute in all loads; modules without a
    statement do not count."""
    return _AuthorLoader.executed


def read_source(path: str | Path) -> str:
    """The text of a Python source file, see `decode`.

    Raises:
        OSError: it cannot be read, is not a regular file, or is larger than `MAX_SOURCE_BYTES`.
        SyntaxError: it is not text.
    """
    return plain_line_ends(read_exactly(path)[1])


def read_exactly(path: str | Path) -> tuple[bytes, str, str]:
    """A Python source file's bytes, its text with its own line ends, and its encoding. Raises as `read_source`."""
    raw = read_regular_file(path, MAX_SOURCE_BYTES)
    return raw, *exact_text(str(path), raw)


def decode(path: str, raw: bytes) -> str:
    """The text of a Python source file, line ends as ``\\n``; see `exact_text`."""
    return plain_line_ends(exact_text(path, raw)[0])


def exact_text(path: str, raw: bytes) -> tuple[str, str]:
    """The text of a Python source file with its own line ends, and its encoding (from its coding line, else UTF-8).

    Raises SyntaxError, with `path` and line, where Python's own functions raise a
    UnicodeDecodeError that names neither.
    """
    try:
        encoding, _ = tokenize.detect_encoding(io.BytesIO(raw).readline)
        return raw.decode(encoding), encoding
    except (UnicodeDecodeError, SyntaxError) as exc:
        message, line = str(exc), 1
        try:
            raw.decode()
        except UnicodeDecodeError as wrong:
            message = f"{wrong}; save the file as UTF-8"
            line = raw[: wrong.start].count(b"\n") + 1
        raise SyntaxError(message, (path, line, 1, None)) from None


def _is_in(path: str, root: str) -> bool:
    """Whether `path` is the folder `root`, or a folder of the author below it."""
    real = os.path.realpath(path or os.curdir)
    root = os.path.realpath(root)
    return real == root or is_own_file(os.path.join(real, "x.py"), Path(root))


@dataclass(frozen=True)
class UnloadedModules:
    """The author's modules and their `linecache` entries, kept while a new version is tried."""

    modules: dict[str, ModuleType]
    lines: dict[str, Any]
    path: list[str]


_libraries: dict[str, ModuleType] = {}
"""Cache of the modules of libraries: checking three thousand modules takes 7 ms."""


def unload_modules(finder: AuthorFinder, is_other_task: Callable[[str], bool]) -> UnloadedModules:
    """Remove the author's modules from ``sys.modules``, so that edited helpers are read again.

    Removes the modules of the folder, and the helpers of other tasks: if they stayed, ``import helper`` would
    give the loaded ``helper`` of another folder. Main modules of other tasks, for whose names `is_other_task`
    returns True, stay: they are not imported by name, and their classes may be in use.
    """
    folder = finder.own_folder
    names = importable_names(finder.search_folder)
    unloaded: dict[str, ModuleType] = {}
    for name, module in list(sys.modules.items()):
        if name in ("__main__", "__mp_main__") or is_other_task(name):
            continue
        if _libraries.get(name) is module and name != finder.main:
            continue
        # Not getattr: it triggers the imports of lazy modules.
        attributes = getattr(module, "__dict__", {})
        spec, file = attributes.get("__spec__"), attributes.get("__file__")
        if name == finder.main or isinstance(getattr(spec, "loader", None), _AuthorLoader):
            unloaded[name] = module
        elif isinstance(file, str):
            if file.endswith(".py") and is_own_file(file, folder):
                unloaded[name] = module
            elif hides_module_of(folder, name, module, names):
                unloaded[name] = module  # such as a helper of a policy in another folder
            elif file.startswith(LIBRARY_ROOTS):
                _libraries[name] = module
        elif spec is not None and spec.origin is None and spec.submodule_search_locations is not None:
            # A folder without __init__.py: ``from robots import arm`` would take the old attribute ``arm`` of the
            # namespace module, without an import.
            places = [os.path.join(place, "x.py") for place in spec.submodule_search_locations]
            if any(is_own_file(place, folder) for place in places):
                unloaded[name] = module
    lines: dict[str, Any] = {
        path: entry for path, entry in linecache.cache.items() if is_own_file(path, folder)
    }
    for name in unloaded:
        del sys.modules[name]
    return UnloadedModules(unloaded, lines, list(sys.path))


def restore_modules(unloaded: UnloadedModules, finder: AuthorFinder) -> None:
    """Undo `unload_modules`, and remove the modules that `finder` executed since."""
    for name in finder.names:
        sys.modules.pop(name, None)
    sys.modules.update(unloaded.modules)
    for name, module in unloaded.modules.items():
        # ``import package.part`` binds ``part`` on the package, and a failed load has rebound it.
        parent, _, last = name.rpartition(".")
        if parent in sys.modules:
            setattr(sys.modules[parent], last, module)
    for path in finder.texts:
        linecache.cache.pop(path, None)
    linecache.cache.update(unloaded.lines)
    sys.path[:] = unloaded.path


def show_in_tracebacks(path: str, text: str) -> None:
    """Make `linecache` return `text` for `path`, even after the file has changed.

    `linecache.checkcache`, which runs before every traceback, skips entries without a modification time.
    """
    linecache.cache[path] = (len(text), None, text.splitlines(keepends=True), path)
