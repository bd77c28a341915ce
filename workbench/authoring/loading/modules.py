"""The author's modules in Python's own tables: found, executed fresh, and put back.

`importlib.reload` is the wrong tool for a file that is executed on every save: it runs the new text
in the old namespace, so names that were deleted live on, and it does nothing for the modules
beside the file. Python's own import is wrong too, in one small way that bites: it believes a
``.pyc`` whose recorded modification time, in whole seconds, and size match the source, so of two
saves within a second that change ``0.1`` to ``0.2`` the second is not seen.

So each task has an `AuthorFinder` on ``sys.meta_path``. It finds what lies in the task's folder as
Python would, but compiles from text alone, remembers every text it executed (that is what the
watcher follows, what a recording keeps, and what `linecache` must show in tracebacks although the
file on disk has moved on), and can be given texts to use in place of what is on disk, which is how
the last good version comes back. `set_aside` takes the author's modules out of ``sys.modules`` so
that an edited helper is read again, and `put_back` undoes that.
"""

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

from workbench.authoring.loading.library_names import (
    LIBRARY_ROOTS,
    files_named_like_libraries,
    is_library,
    is_own_file,
)
from workbench.authoring.source.text import plain_line_ends
from workbench.machine.files import MOST_SOURCE_BYTES, read_regular_file

_MODULE_PREFIX = "workbench_task_"


@dataclass(frozen=True)
class ModuleName:
    """How a task's file is called in ``sys.modules``, and what must be on ``sys.path`` for it."""

    name: str
    search_folder: Path
    own_folder: Path
    """What is in or below it is its author's, and comes in with it."""


def module_name(file: Path) -> ModuleName:
    """A name that is the same for every load of `file` and that no other module has.

    A file in a package (its folder has an ``__init__.py``) goes by its dotted name, because only
    then do its relative imports work.
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
    """Files beside the task `file` that it cannot import; the task's own file may have any name."""
    folder = search_folder or module_name(file).search_folder
    return tuple(found for found in files_named_like_libraries(folder) if found != file)


class AuthorFinder(MetaPathFinder):
    """Finds and executes the modules of one task: its file, and what lies in the folder beside it."""

    def __init__(
        self,
        file: Path,
        given: Mapping[str, str],
        only_given: bool = False,
        named: ModuleName | None = None,
    ) -> None:
        """`named` is how a person named the module; else its name follows from where the file lies."""
        self.file = file
        place = named or module_name(file)
        self.main, self.search_folder, self.own_folder = place.name, place.search_folder, place.own_folder
        self.goes_by_stem = named is None
        """A helper may import the task by its file's name."""
        self.given = given
        """Path to text that is used in place of what is on disk."""
        self.only_given = only_given
        """Nothing else in the folder is executed: a recording named the file, and a person agreed to these texts."""
        self.texts: dict[str, str] = {}
        """Path to text of everything read so far, in order; the task's own file first."""
        self.names: list[str] = []
        """Names in ``sys.modules`` of what was executed."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        if fullname == self.main:
            return self._spec(fullname, str(self.file), is_package=self.file.stem == "__init__")
        spec = self._beside(fullname, path, target)
        if spec is not None and path is None and is_library(fullname):
            return None
        return spec

    def _beside(
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
        """For a name that is no given text: what is installed, else a folder of given texts without an ``__init__.py``.

        Raises ModuleNotFoundError for what lies beside the file, where an earlier task, or the code itself, has put the
        folder on ``sys.path``: Python would go on to `PathFinder`, and find it.
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
        """Whether what is imported now is imported for this task, and not for one that was loaded after it."""
        return next((f for f in sys.meta_path if isinstance(f, AuthorFinder)), None) is self

    def text(self, path: str) -> str:
        """What is executed for `path`. Raises OSError, or SyntaxError for what is no text."""
        if path in self.given:
            return self.given[path]
        raw = read_regular_file(path, MOST_SOURCE_BYTES)
        try:
            return decode(path, raw)
        except SyntaxError:
            # The author is to be shown the line, and this is one of their files.
            self.remember(path, raw.decode(errors="replace"))
            raise

    def remember(self, path: str, text: str) -> None:
        self.texts[path] = text
        show_in_tracebacks(path, text)

    def _spec(self, name: str, path: str, is_package: bool) -> importlib.machinery.ModuleSpec | None:
        return importlib.util.spec_from_file_location(
            name,
            path,
            loader=_AuthorLoader(self, name, path),
            submodule_search_locations=[os.path.dirname(path)] if is_package else None,
        )


class _AuthorLoader(importlib.machinery.SourceFileLoader):
    """Executes one text. Has no part in bytecode files: they are neither read nor written."""

    def __init__(self, finder: AuthorFinder, name: str, path: str) -> None:
        super().__init__(name, path)
        self.finder = finder

    def get_source(self, fullname: str) -> str:
        path = self.get_filename(fullname)
        return self.finder.texts[path] if path in self.finder.texts else self.finder.text(path)

    def get_code(self, fullname: str) -> CodeType:
        path = self.get_filename(fullname)
        text = self.finder.text(path)
        # Before compile(): a SyntaxError's place must be looked up in the text that has it.
        self.finder.remember(path, text)
        if "\0" in text:
            # What Python raises here names neither file nor line.
            line = text[: text.index("\0")].count("\n") + 1
            raise SyntaxError("source code cannot contain null bytes", (path, line, 1, None))
        return compile(text, path, "exec", dont_inherit=True)

    def exec_module(self, module: ModuleType) -> None:
        name = module.__name__
        self.finder.names.append(name)
        stem = self.finder.file.stem
        is_main = name == self.finder.main and self.finder.goes_by_stem
        if is_main and stem not in sys.modules and not is_library(stem):
            # A helper that imports the task by its file's name must get this module: executed a
            # second time under another name, it would register its ids twice.
            sys.modules[stem] = module
            self.finder.names.append(stem)
        exec(self.get_code(name), module.__dict__)


def read_source(path: str | Path) -> str:
    """The text of a Python source file, see `decode`.

    Raises:
        OSError: it cannot be read, also because it is no regular file or larger than any program.
        SyntaxError: it is no text.
    """
    return plain_line_ends(read_exactly(path)[1])


def read_exactly(path: str | Path) -> tuple[bytes, str, str]:
    """A Python source file's bytes, its text with its own line ends, and its encoding. Raises as `read_source`."""
    raw = read_regular_file(path, MOST_SOURCE_BYTES)
    return raw, *exact_text(str(path), raw)


def decode(path: str, raw: bytes) -> str:
    """The text of a Python source file, line ends as ``\\n``; see `exact_text`."""
    return plain_line_ends(exact_text(path, raw)[0])


def exact_text(path: str, raw: bytes) -> tuple[str, str]:
    """The text of a Python source file with its own line ends, and its encoding: its coding line's or UTF-8.

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
    """Whether `path` is the folder `root`, or below it and the author's own."""
    real = os.path.realpath(path or os.curdir)
    root = os.path.realpath(root)
    return real == root or is_own_file(os.path.join(real, "x.py"), Path(root))


@dataclass(frozen=True)
class SetAside:
    """The author's modules, and what tracebacks showed of them, while a new version is tried."""

    modules: dict[str, ModuleType]
    lines: dict[str, Any]
    path: list[str]


_libraries: dict[str, ModuleType] = {}
"""Modules that are nobody's own, as far as they were looked at: to look at three thousand takes 7 ms."""


def set_aside(finder: AuthorFinder, is_other_task: Callable[[str], bool]) -> SetAside:
    """Take the author's modules out of ``sys.modules``: those in the folder, other tasks' helpers.

    The latter because ``helper`` of another task's folder would be found in ``sys.modules`` before
    ``helper`` of this one. Main modules of other tasks stay (`is_other_task` of their name): nothing
    imports them by name, and their classes may be in use.
    """
    folder = finder.own_folder
    aside: dict[str, ModuleType] = {}
    for name, module in list(sys.modules.items()):
        if name in ("__main__", "__mp_main__") or is_other_task(name):
            continue
        if _libraries.get(name) is module and name != finder.main:
            continue
        # Not getattr: modules that import lazily would import on being asked.
        attributes = getattr(module, "__dict__", {})
        spec, file = attributes.get("__spec__"), attributes.get("__file__")
        if name == finder.main or isinstance(getattr(spec, "loader", None), _AuthorLoader):
            aside[name] = module
        elif isinstance(file, str):
            if file.endswith(".py") and is_own_file(file, folder):
                aside[name] = module
            elif file.startswith(LIBRARY_ROOTS):
                _libraries[name] = module
        elif spec is not None and spec.origin is None and spec.submodule_search_locations is not None:
            # A folder without __init__.py: ``from robots import arm`` takes the attribute ``arm``
            # of the namespace module, and would get the old one without any import.
            places = [os.path.join(place, "x.py") for place in spec.submodule_search_locations]
            if any(is_own_file(place, folder) for place in places):
                aside[name] = module
    lines: dict[str, Any] = {
        path: entry for path, entry in linecache.cache.items() if is_own_file(path, folder)
    }
    for name in aside:
        del sys.modules[name]
    return SetAside(aside, lines, list(sys.path))


def put_back(aside: SetAside, finder: AuthorFinder) -> None:
    """Undo `set_aside` and all that `finder` executed since."""
    for name in finder.names:
        sys.modules.pop(name, None)
    sys.modules.update(aside.modules)
    for name, module in aside.modules.items():
        # ``import package.part`` binds ``part`` on the package, and a failed load has rebound it.
        parent, _, last = name.rpartition(".")
        if parent in sys.modules:
            setattr(sys.modules[parent], last, module)
    for path in finder.texts:
        linecache.cache.pop(path, None)
    linecache.cache.update(aside.lines)
    sys.path[:] = aside.path


def show_in_tracebacks(path: str, text: str) -> None:
    """Make `linecache` serve `text` for `path`, whatever becomes of the file.

    An entry without a modification time is one that `linecache.checkcache`, which runs before
    every traceback, leaves alone.
    """
    linecache.cache[path] = (len(text), None, text.splitlines(keepends=True), path)
