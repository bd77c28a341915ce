"""Moves deleted recordings into ``.trash`` in the library's folder and back."""

from __future__ import annotations

import datetime
import os
import shutil
import uuid
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

TRASH = ".trash"


@dataclass(frozen=True)
class Trash:
    """Content of the trash.

    Each deletion is a folder named by its time, in which the files keep their paths relative to the library's
    folder, so undo needs no list. The file that makes a recording appear in the library moves first and is
    restored last.
    """

    batches: tuple[str, ...] = ()
    """Names of the deletions that contain files, the newest last."""
    files: int = 0
    size: int = 0
    """Bytes."""


class TrashError(OSError):
    """Files could not be moved or deleted; the message names the file and the reason. The other files of
    the recording were moved back; if that failed, the message says where they are."""


def move_to_trash(folder: Path, recordings: Sequence[Sequence[Path]]) -> str | None:
    """Move the files of these recordings, in order; returns the name of the deletion, or None if no file exists.

    Raises:
        TrashError: a file could not be moved; the recordings before it were moved.
    """
    if (folder / TRASH).is_symlink():
        raise TrashError(
            f"{folder / TRASH} is a link, so nothing was moved there. Remove the link and try again."
        )
    now = datetime.datetime.now()
    batch = f"{now:%Y-%m-%dT%H-%M-%S.%f}-{uuid.uuid4().hex[:6]}"
    moved = False
    for paths in recordings:
        pairs = [(path, folder / TRASH / batch / path.relative_to(folder)) for path in paths]
        moved |= _move_together([(source, target) for source, target in pairs if os.path.lexists(source)])
    return batch if moved else None


def restore_from_trash(folder: Path, batch: str) -> tuple[str, ...]:
    """Restore the files of a deletion; returns their paths below `folder`, with ``/``. Existing files are not replaced.

    Raises:
        TrashError: a file could not be moved and is still in the trash.
    """
    root = folder / TRASH / batch
    if batch not in read_trash(folder).batches:
        raise TrashError("That deletion is no longer in the trash.")
    # Restore the .json last, or the library would show a recording whose other files are missing.
    order = {".h5": 0, ".rrd": 1, ".json": 2}
    files = sorted(
        (path for path in root.rglob("*") if path.is_symlink() or path.is_file()),
        key=lambda path: (order.get(path.suffix, 0), path),
    )
    _move_together([(path, folder / path.relative_to(root)) for path in files])
    shutil.rmtree(root, ignore_errors=True)
    return tuple(path.relative_to(root).as_posix() for path in files)


def read_trash(folder: Path) -> Trash:
    size = 0
    if (folder / TRASH).is_symlink():
        return Trash()  # it is a link to a foreign folder
    try:
        with os.scandir(folder / TRASH) as listed:
            batches = sorted(entry.name for entry in listed if entry.is_dir(follow_symlinks=False))
    except OSError:
        return Trash()
    held: dict[str, int] = {}
    for batch in batches:
        for below, _, names in os.walk(folder / TRASH / batch):
            for name in names:
                try:
                    size += os.lstat(os.path.join(below, name)).st_size
                    held[batch] = held.get(batch, 0) + 1
                except OSError:
                    continue  # the file was restored meanwhile
    # A failed deletion leaves empty folders, which undo must skip.
    return Trash(tuple(held), sum(held.values()), size)


def empty_trash(folder: Path) -> None:
    """Delete the content of the trash permanently.

    Raises:
        TrashError: a file could not be deleted.
    """
    try:
        shutil.rmtree(folder / TRASH)
    except FileNotFoundError:
        return
    except OSError as error:
        raise TrashError(f"{folder / TRASH} could not be emptied: {error.strerror or error}.") from error


def _move_together(pairs: Sequence[tuple[Path, Path]]) -> bool:
    """Move all files or none; returns whether there was anything to move."""
    done: list[tuple[Path, Path]] = []
    try:
        for source, target in pairs:
            _move(source, target)
            done.append((source, target))
    except OSError as error:
        what = f"{pairs[len(done)][0]} was not moved: {error.strerror or error}."
        for source, target in reversed(done):
            try:
                _move(target, source)
            except OSError as again:
                what += (
                    f" {source} is now at {target} and could not be moved back: {again.strerror or again}."
                )
        raise TrashError(what) from error
    return bool(done)


def _move(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    if os.path.lexists(target):
        raise FileExistsError(None, "there is already a file with that name", os.fspath(target))
    os.rename(source, target)
