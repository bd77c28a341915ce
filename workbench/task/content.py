"""Collects the source code that opening a task file would run, by parsing its imports."""

from __future__ import annotations

import ast
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from hashlib import sha256
from itertools import chain
from pathlib import Path

from workbench.machine.files import real_path
from workbench.machine.parse_python import parse_python
from workbench.source.parsed import plain_line_ends
from workbench.task.library_names import is_library, is_own_file
from workbench.task.modules import module_name, read_exactly
from workbench.task.reference import find_in

MAX_MODULES = 300
"""Maximum number of modules of a task."""
_DYNAMIC = frozenset(
    "__import__ import_module spec_from_file_location spec_from_loader module_from_spec exec_module load_module "
    "find_spec run_path run_module exec eval SourceFileLoader addsitedir meta_path path_hooks".split()
)
_COMPILED = (".so", ".pyd", ".pyc")


class CannotRead(OSError):
    """The file cannot be read; the message is a sentence."""


@dataclass(frozen=True)
class TaskContent:
    """Source code of a task: the texts that are hashed, and that a person is asked to trust. For a task from
    a recording, `load_task` executes nothing else."""

    main: str
    """Path of the task's own file, or its name in a recording."""
    texts: dict[str, str]
    """Text by path; the task's own file first."""
    unseen: tuple[str, ...] = ()
    """Sentences about code that may run but is not in `texts`."""
    computed: bool = False
    """Whether a text imports by computed names; `texts` then has every module of the folder."""
    sums: Mapping[str, str] = field(default_factory=dict)
    """sha256 of each file's bytes, by path; equal texts may have different bytes (line ends, encoding)."""

    @property
    def modules(self) -> tuple[str, ...]:
        """Paths of all texts except the task's own file, relative to the task's folder."""
        return tuple(sorted(self.name(path) for path in self.texts if path != self.main))

    @property
    def file_sums(self) -> dict[str, str]:
        """The ``sha256sum`` of each file, by its path relative to the task's folder; the task's own file
        first."""
        paths = [self.main, *sorted(path for path in self.texts if path != self.main)]
        raw = {path: self.texts[path].encode("utf-8", "surrogatepass") for path in paths}
        return {self.name(path): self.sums.get(path) or sha256(raw[path]).hexdigest() for path in paths}

    @property
    def hash(self) -> str:
        """sha256 over relative paths and texts; independent of the folder."""
        named = sorted((self.name(path), text) for path, text in self.texts.items())
        return _sum([self.name(self.main), *chain.from_iterable(named)])

    def name(self, path: str) -> str:
        """`path` relative to the task's folder."""
        return Path(os.path.relpath(path, os.path.dirname(self.main) or ".")).as_posix()


def read_content(file: Path) -> TaskContent:
    """The texts that opening `file` would run.

    Finds imports inside functions too. A text that imports by computed names could load any module of the
    folder, so all modules of the folder are then included.

    Raises:
        CannotRead: a file is too large or is not an ordinary file of Python text, or the task has more than
            `MAX_MODULES` modules.
    """
    file = real_path(file)
    return _ContentReader(file).content()


class _ContentReader:
    def __init__(self, file: Path) -> None:
        self._file, self._root = file, module_name(file).search_folder
        self._texts: dict[str, str] = {}
        self._sums: dict[str, str] = {}
        self._computed = False
        self._unseen: dict[str, None] = {}
        self._waiting: list[Path] = []

    def content(self) -> TaskContent:
        self._add(self._file)
        for package in self._packages_above():
            self._add(package)
        while self._waiting:
            path = self._waiting.pop()
            try:
                tree = parse_python(self._texts[str(path)])
            except (SyntaxError, ValueError, RecursionError, MemoryError):
                self._unseen[f"{self._short(path)} cannot be parsed as Python."] = None
                continue
            self._add_imports(path, tree)
        return TaskContent(str(self._file), self._texts, tuple(self._unseen), self._computed, self._sums)

    def _packages_above(self) -> Iterator[Path]:
        """The ``__init__.py`` of each package that contains the file; these run before the file."""
        folder = self._file.parent
        while folder != self._root and folder.is_relative_to(self._root):
            yield folder / "__init__.py"
            folder = folder.parent

    def _add(self, path: Path) -> None:
        name = str(path)
        if name in self._texts:
            return
        if len(self._texts) >= MAX_MODULES:
            raise CannotRead(f"{self._file} has more than {MAX_MODULES} modules.")
        self._texts[name], self._sums[name] = _read(path)
        self._waiting.append(path)

    def _add_imports(self, path: Path, tree: ast.AST) -> None:
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                for alias in node.names:
                    self._import(self._root, alias.name.split("."))
            elif isinstance(node, ast.ImportFrom):
                base = self._root
                if node.level:
                    base = path.parent
                    for _ in range(node.level - 1):
                        base = base.parent
                parts = (node.module or "").split(".") if node.module else []
                for alias in node.names:
                    self._import(base, [*parts, alias.name])
            if (name := _dynamic(node)) is not None:
                line = getattr(node, "lineno", 1)
                self._unseen[f"{self._short(path)}:{line} may run other code ({name})."] = None
                self._add_all()

    def _import(self, folder: Path, parts: list[str]) -> None:
        if not folder.is_relative_to(self._root) or (folder == self._root and is_library(parts[0])):
            return
        for part in parts:
            if part == "*":
                if (folder / "__init__.py").is_file() and folder != self._root:
                    for path in sorted(folder.glob("*.py")):  # its __all__ may name modules
                        self._add(path)
                return
            file, inside = find_in([folder], part)
            if file is not None:
                self._add(file)
            elif not inside:
                self._report_compiled(folder, part)
            if not inside:
                return
            (folder,) = inside

    def _report_compiled(self, folder: Path, name: str) -> None:
        for path in sorted(folder.glob(f"{name}.*")) if name.isidentifier() else ():
            if path.suffix in _COMPILED:
                self._unseen[f"{self._short(path)} is compiled and is not loaded."] = None

    def _add_all(self) -> None:
        self._computed = True
        for root, folders, names in os.walk(self._file.parent):
            folders[:] = sorted(
                folder
                for folder in folders
                if is_own_file(os.path.join(root, folder, "x.py"), self._file.parent)
            )
            for name in sorted(names):
                path = Path(root, name)
                if path.suffix == ".py" and is_own_file(str(path), self._file.parent) and path.is_file():
                    self._add(path)

    def _short(self, path: Path) -> str:
        return os.path.relpath(path, self._file.parent)


def read_text(path: Path) -> str:
    """The text of a Python file.

    Raises:
        CannotRead: it cannot be read, is not text, or is too long.
    """
    return _read(path)[0]


def source_hash(source: Mapping[str, str], folder: Path) -> str:
    """sha256 over the texts and their paths (relative to `folder` if they are in it), 12 hex digits."""
    parts: list[str] = []
    for path in sorted(source):
        inside = Path(path).is_relative_to(folder)
        parts += [Path(path).relative_to(folder).as_posix() if inside else path, source[path]]
    return _sum(parts)[:12]


def _sum(parts: Iterable[str]) -> str:
    """sha256 of the texts in order, each preceded by its length."""
    digest = sha256()
    for part in parts:
        content = part.encode("utf-8", "surrogatepass")
        digest.update(len(content).to_bytes(8, "big") + content)
    return digest.hexdigest()


def _read(path: Path) -> tuple[str, str]:
    """The text, and the sha256 of its bytes."""
    try:
        raw, text, _ = read_exactly(path)
        return plain_line_ends(text), sha256(raw).hexdigest()
    except SyntaxError as error:
        raise CannotRead(f"{path} is not Python source: {error.msg}") from error
    except OSError as error:
        raise CannotRead(f"{path} cannot be read: {error.strerror or error}.") from error


def _dynamic(node: ast.AST) -> str | None:
    """The name by which this node may import or run code that the text does not name; None if there is
    none."""
    if isinstance(node, ast.ImportFrom):
        return next((alias.name for alias in node.names if alias.name in _DYNAMIC), None)
    if isinstance(node, ast.Name) and node.id in _DYNAMIC:
        return node.id
    if isinstance(node, ast.Attribute):
        if node.attr in _DYNAMIC:
            return node.attr
        if node.attr == "path" and isinstance(node.value, ast.Name) and node.value.id == "sys":
            return "sys.path"
    return None
