"""Names and hashes of the non-Python files that a task reads: meshes, textures, tables."""

from __future__ import annotations

import ast
import hashlib
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from io import BufferedReader
from pathlib import Path, PurePosixPath

from workbench.machine.files import NotARegularFile, open_regular_file, read_regular_file
from workbench.machine.parse_python import parse_python

MAX_FILES = 200
MAX_LISTED_FILES = 5000
"""Maximum number of files below the task's folder that are considered: the folder may be a home folder."""
NAMING_SUFFIXES = (".urdf", ".xml", ".srdf", ".obj", ".mtl", ".gltf", ".dae")
"""Suffixes of files that name other files."""
MAX_NAMING_BYTES = 4_000_000
_NAMED = re.compile(r"[\w./ -]+\.\w{2,5}")
_INSTALLED = {"site-packages", "dist-packages"}
_hashes: dict[tuple[str, int, int], str] = {}


def side_files(task: str | None, source: Mapping[str, str]) -> dict[str, str]:
    """Hash of each side file, by path relative to the task's folder.

    A recording holds the task's text but not its meshes, which may be larger than all recordings together. The files that
    a task reads cannot be observed, since native libraries open many of them. So the result has each file
    below the task's folder that a string in the text names, by its own path or by that of a folder above it,
    and each file that these files name in turn (as a URDF names its meshes). A file is missed if the code
    composes its path and no string names its folder. If a string names a folder, the folder's files are
    included even if the task never reads them. So a change of a side file is only reported: it never prevents
    anything.

    Args:
        task: the task's file. For a file of an installed package the result is empty: the package's version
            identifies its files.
        source: texts of its Python files.
    """
    if task is None or not os.path.isabs(task) or _INSTALLED & set(Path(task).parts):
        return {}
    folder = Path(task).parent
    below = {path.relative_to(folder).as_posix(): path for path in _files_below(folder)}
    found: dict[str, str] = {}
    pending = sorted(_named(below, _strings(source.values())))
    while pending and len(found) < MAX_FILES:
        name = pending.pop(0)
        if name in found:
            continue
        try:
            found[name] = hash_of(below[name])
            pending += sorted(_named(below, _names_in(below[name])) - {name})
        except OSError:  # removed meanwhile, or unreadable for the task too
            continue
    return dict(sorted(found.items()))


def hash_of(path: Path) -> str:
    """Twelve hex digits of SHA-256. Raises OSError."""
    stat = path.stat()
    key = (os.fspath(path), stat.st_mtime_ns, stat.st_size)
    if key not in _hashes:
        with open_regular_file(path) as file:
            assert isinstance(file, BufferedReader)
            _hashes[key] = hashlib.file_digest(file, "sha256").hexdigest()[:12]
    return _hashes[key]


def side_files_text(task: str | None, recorded: Mapping[str, str]) -> str:
    """A sentence on the recorded task's side files, and whether they have changed; empty if there are none.

    Args:
        task: the task's file, if it exists.
        recorded: result of `side_files`.
    """
    if not recorded:
        return ""
    changed = list(_changed_files(folder_of(task), recorded).items())
    names = ", ".join(list(recorded)[:3]) + (f" and {len(recorded) - 3} more" if len(recorded) > 3 else "")
    it = "it is" if len(recorded) == 1 else "they are"
    now = f"{it} unchanged" if not changed else "; ".join(f"{name} {what}" for name, what in changed[:3])
    if len(changed) > 3:
        now += f"; {len(changed) - 3} more differ too"
    return f"The task also reads {names}, which the recording does not hold: {now}."


def _changed_files(folder: Path | None, recorded: Mapping[str, str]) -> dict[str, str]:
    """What is wrong with each file of `recorded` that is missing, changed or unreadable, by name."""
    changed = {}
    for name, hashed in recorded.items():
        path = side_file_path(folder, name)
        try:
            if path is None or not os.path.isfile(path):
                changed[name] = "is missing"
            elif hash_of(path) != hashed:
                changed[name] = "has changed since"
        except OSError as error:
            changed[name] = f"cannot be read ({error.strerror})"
    return changed


def folder_of(task: str | None) -> Path | None:
    """The folder of a task's file; None if the file is unknown or missing."""
    return Path(task).parent if task is not None and os.path.isabs(task) and os.path.isfile(task) else None


def side_file_path(folder: Path | None, name: str) -> Path | None:
    """Path of a side file; None for a name that leads out of `folder`: names come from untrusted recordings."""
    pure = PurePosixPath(name)
    if folder is None or pure.is_absolute() or ".." in pure.parts or not pure.parts:
        return None
    return folder / pure


def _files_below(folder: Path) -> Iterator[Path]:
    looked_at = 0
    for root, folders, names in os.walk(folder):
        # A .json or .h5 with a .rrd of the same name is a recording.
        folders[:] = sorted(f for f in folders if not f.startswith((".", "__")) and f != "recordings")
        recordings = {name[:-4] for name in names if name.endswith(".rrd")}
        for name in sorted(names):
            looked_at += 1
            if looked_at > MAX_LISTED_FILES:
                return
            stem, suffix = os.path.splitext(name)
            if not name.startswith(".") and suffix not in (".py", ".pyc", ".rrd") and stem not in recordings:
                yield Path(root, name)


def _strings(texts: Iterable[str]) -> set[str]:
    """String constants of these programs, without docstrings; skips a program that does not parse."""
    found: set[str] = set()
    for text in texts:
        try:
            nodes = list(ast.walk(parse_python(text)))
        except (SyntaxError, ValueError, RecursionError):
            continue
        alone = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
        found |= {
            node.value
            for node in nodes
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in alone
        }
    return {string for string in found if len(string) < 300}


def _names_in(path: Path) -> set[str]:
    if path.suffix.lower() not in NAMING_SUFFIXES or path.stat().st_size > MAX_NAMING_BYTES:
        return set()
    try:
        return set(_NAMED.findall(read_regular_file(path, MAX_NAMING_BYTES).decode(errors="replace")))
    except NotARegularFile:
        return set()


def _named(below: Mapping[str, Path], strings: Iterable[str]) -> set[str]:
    """The files of `below` that a string names, by the end of their path or by a folder above them."""
    names = {string.strip().strip("/").removeprefix("./") for string in strings}
    names = {name for name in names if name and "\n" not in name}
    lasts = {PurePosixPath(name).name for name in names}
    found = set()
    for path in below:
        parts = PurePosixPath(path).parts
        ends = {"/".join(parts[k:]) for k in range(len(parts))}
        inside = {"/".join(parts[:k]) for k in range(1, len(parts))}
        if ends & names or inside & names or (parts[-1] in lasts and "." in parts[-1]):
            found.add(path)
    return found
