"""Files beside the task that are no Python: meshes, textures, tables of numbers that its code reads.

A recording holds the text of the task, so that it can be made again after the file has changed. Meshes are not text,
may be larger than all recordings together, and which of them a task reads is known to its code alone: much of it is
opened by native libraries, where nothing can listen. So they are not taken along, but named, each with a hash, and whoever
wants the recorded text to run again is told what else that takes, and whether it is still as it was.

What is named is what the task's own text names: files and folders below the task's folder whose name stands in one of
its strings, and what those files name in turn (a URDF its meshes). A name that the code puts together is missed,
unless its folder is named, and a folder that is named brings files that are not read; so what is amiss with one of
these is said, and nothing is refused for it.
"""

from __future__ import annotations

import ast
import hashlib
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from io import BufferedReader
from pathlib import Path, PurePosixPath

from workbench.machine.files import NotARegularFile, open_regular_file, read_regular_file

MOST_FILES = 200
MOST_LOOKED_AT = 5000
"""Files below the task's folder that are looked at; who keeps a task in the home folder has more."""
NAMING = (".urdf", ".xml", ".srdf", ".obj", ".mtl", ".gltf", ".dae")
"""Ends of the names of files that name others."""
NAMING_BYTES = 4_000_000
_NAMED = re.compile(r"[\w./ -]+\.\w{2,5}")
_INSTALLED = {"site-packages", "dist-packages"}
_hashes: dict[tuple[str, int, int], str] = {}


def side_files(task: str | None, source: Mapping[str, str]) -> dict[str, str]:
    """Path as seen from the task's folder, to hash.

    Args:
        task: the task's own file; of an installed package nothing is named, since its version says it.
        source: texts of its Python files.
    """
    if task is None or not os.path.isabs(task) or _INSTALLED & set(Path(task).parts):
        return {}
    folder = Path(task).parent
    below = {path.relative_to(folder).as_posix(): path for path in _files_below(folder)}
    found: dict[str, str] = {}
    wanted = sorted(_named(below, _strings(source.values())))
    while wanted and len(found) < MOST_FILES:
        name = wanted.pop(0)
        if name in found:
            continue
        try:
            found[name] = hash_of(below[name])
            wanted += sorted(_named(below, _names_in(below[name])) - {name})
        except OSError:  # gone in this moment, or not ours to read: then the task cannot read it either
            continue
    return dict(sorted(found.items()))


def hash_of(path: Path) -> str:
    """Twelve characters. Raises OSError."""
    stat = path.stat()
    key = (os.fspath(path), stat.st_mtime_ns, stat.st_size)
    if key not in _hashes:
        with open_regular_file(path) as file:
            assert isinstance(file, BufferedReader)
            _hashes[key] = hashlib.file_digest(file, "sha256").hexdigest()[:12]
    return _hashes[key]


def side_files_text(task: str | None, recorded: Mapping[str, str]) -> str:
    """A sentence on what the recorded text needs besides, and how that is now; empty for nothing.

    Args:
        task: its file, where that is still there.
        recorded: of `side_files`.
    """
    if not recorded:
        return ""
    changed = list(_changed_files(folder_of(task), recorded).items())
    names = ", ".join(list(recorded)[:3]) + (f" and {len(recorded) - 3} more" if len(recorded) > 3 else "")
    it = "it is" if len(recorded) == 1 else "they are"
    now = f"{it} as then" if not changed else "; ".join(f"{name} {what}" for name, what in changed[:3])
    if len(changed) > 3:
        now += f"; nor are {len(changed) - 3} more as they were"
    return f"The task also reads {names}, which the recording does not hold: {now}."


def _changed_files(folder: Path | None, recorded: Mapping[str, str]) -> dict[str, str]:
    """Those of `recorded` that are not as they were, and what is with them."""
    changed = {}
    for name, hashed in recorded.items():
        path = side_file_path(folder, name)
        try:
            if path is None or not path.is_file():
                changed[name] = "is not there"
            elif hash_of(path) != hashed:
                changed[name] = "has changed since"
        except OSError as error:
            changed[name] = f"cannot be read ({error.strerror})"
    return changed


def folder_of(task: str | None) -> Path | None:
    """The folder of a task's file, where the file is known and there."""
    return Path(task).parent if task is not None and os.path.isabs(task) and os.path.isfile(task) else None


def side_file_path(folder: Path | None, name: str) -> Path | None:
    """Where a side file is; None where that is nowhere, or above the folder: a recording is somebody else's file."""
    pure = PurePosixPath(name)
    if folder is None or pure.is_absolute() or ".." in pure.parts or not pure.parts:
        return None
    return folder / pure


def _files_below(folder: Path) -> Iterator[Path]:
    looked_at = 0
    for root, folders, names in os.walk(folder):
        # A .json or .h5 with a .rrd of its name beside it is a recording.
        folders[:] = sorted(f for f in folders if not f.startswith((".", "__")) and f != "recordings")
        recordings = {name[:-4] for name in names if name.endswith(".rrd")}
        for name in sorted(names):
            looked_at += 1
            if looked_at > MOST_LOOKED_AT:
                return
            stem, suffix = os.path.splitext(name)
            if not name.startswith(".") and suffix not in (".py", ".pyc", ".rrd") and stem not in recordings:
                yield Path(root, name)


def _strings(texts: Iterable[str]) -> set[str]:
    """What stands in the strings of these programs, docstrings left out; of one that does not parse, nothing."""
    found: set[str] = set()
    for text in texts:
        try:
            nodes = list(ast.walk(ast.parse(text)))
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
    if path.suffix.lower() not in NAMING or path.stat().st_size > NAMING_BYTES:
        return set()
    try:
        return set(_NAMED.findall(read_regular_file(path, NAMING_BYTES).decode(errors="replace")))
    except NotARegularFile:
        return set()


def _named(below: Mapping[str, Path], strings: Iterable[str]) -> set[str]:
    """Of the files below, those that one of the strings names: by the end of its path, or by a folder that it is in."""
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
