"""Packs the author's files for workers on other machines: the task with its folder, a policy, recordings."""

from __future__ import annotations

import dataclasses
import io
import os
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any, TypeVar

from workbench.machine.files import read_regular_file

MAX_BYTES = 256 << 20
"""Maximum total size of the files; each machine of a cluster gets them all."""
_LEFT_OUT = {"__pycache__", "node_modules", "site-packages", "venv", "recordings", "sweeps"}
"""Names of folders that are not packed: packages, caches and recordings."""

Value = TypeVar("Value")


class TooMuch(ValueError):
    """The files exceed the maximum size; the message names the largest files."""


@dataclass(frozen=True)
class WorkerFiles:
    """Folders and files of the submitting side, as one zip."""

    roots: tuple[str, ...]
    """Absolute paths of the packed folders and files on the submitting side."""
    current: str
    """Current folder on the submitting side."""
    data: bytes
    """The zip. Its names are absolute paths without the first slash, so that relative paths between files
    stay valid."""

    def unpack(self, folder: Path) -> dict[str, str]:
        """Write all files into `folder`, which must be empty, and its subfolders. The copy of the submitting
        side's current folder becomes the current folder of this process.

        Returns:
            maps each root's path on the submitting side to its path here.

        Raises:
            OSError: a file cannot be written.
        """
        with zipfile.ZipFile(io.BytesIO(self.data)) as archive:
            archive.extractall(folder)
        current = Path(f"{folder}{self.current}")
        current.mkdir(parents=True, exist_ok=True)
        os.chdir(current)
        return {root: f"{folder}{root}" for root in self.roots}


def pack_worker_files(folders: Iterable[Path], files: Iterable[Path] = ()) -> WorkerFiles:
    """Pack the files that a job needs.

    Args:
        folders: folders with everything below, except hidden files, virtual environments and recordings.
        files: other files, packed without the rest of their folders.

    Raises:
        TooMuch: the files are together larger than `MAX_BYTES`.
        OSError: a file cannot be read.
    """
    roots = _outermost(folder.resolve() for folder in folders)
    found = [file for root in roots for file in files_below(root)]
    # Pack these files in any case: `files_below` leaves some out, such as recordings in the task's folder.
    alone = {file.resolve() for file in files}
    sizes = {file: file.stat().st_size for file in sorted({*found, *alone})}
    if sum(sizes.values()) > MAX_BYTES:
        largest = sorted(sizes, key=lambda file: -sizes[file])[:3]
        raise TooMuch(
            f"the files in the task's folder are {sum(sizes.values()) >> 20} MB, and at most {MAX_BYTES >> 20} MB are sent to "
            f"the workers. The largest are {', '.join(f'{file} ({sizes[file] >> 20} MB)' for file in largest)}: put the task "
            "into a folder of its own"
        )
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for file in sizes:
            archive.writestr(zipfile.ZipInfo(str(file).lstrip("/")), read_regular_file(file, MAX_BYTES))
    outside = sorted(file for file in alone if not any(file.is_relative_to(root) for root in roots))
    return WorkerFiles(tuple(map(str, (*roots, *outside))), str(Path.cwd()), data.getvalue())


def _outermost(folders: Iterable[Path]) -> list[Path]:
    """The folders that are not inside another one of the list."""
    kept: list[Path] = []
    for folder in sorted(set(folders)):
        if not any(folder.is_relative_to(one) for one in kept):
            kept.append(folder)
    return kept


def files_below(folder: Path) -> Iterator[Path]:
    """The regular files that are packed with a task in `folder`, in a fixed order. Links are not followed."""
    for path, folders, names in os.walk(folder):
        here = Path(path)
        folders[:] = sorted(
            name
            for name in folders
            if name not in _LEFT_OUT
            and not name.startswith(".")
            and not (here / name / "pyvenv.cfg").exists()
        )
        for name in sorted(names):
            file = here / name
            if not name.startswith(".") and file.is_file() and not file.is_symlink():
                yield file


def relocated(value: Value, places: Mapping[str, str]) -> Value:
    """Copy of `value` in which ``places[old]`` replaces each occurrence of ``old``, in every text and path,
    recursively through dataclasses, sequences, sets and mappings. Arrays and bytes stay unchanged.
    """
    return _relocated(value, sorted(places.items(), key=lambda pair: -len(pair[0]))) if places else value


def _relocated(value: Any, places: Sequence[tuple[str, str]]) -> Any:
    if isinstance(value, str):
        for before, after in places:
            value = value.replace(before, after)
        return value
    if isinstance(value, PurePath):
        return type(value)(_relocated(str(value), places))
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        named = {one.name: getattr(value, one.name) for one in dataclasses.fields(value) if one.init}
        return dataclasses.replace(value, **{name: _relocated(one, places) for name, one in named.items()})
    if isinstance(value, Mapping):
        return {_relocated(key, places): _relocated(one, places) for key, one in value.items()}
    if isinstance(value, list | tuple | frozenset | set):
        return type(value)(_relocated(one, places) for one in value)
    return value
