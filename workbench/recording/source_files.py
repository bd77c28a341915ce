"""Which recordings a file is, or a folder holds, told by looking into them."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from workbench.recording.document import WrongDocument, read_document
from workbench.recording.lerobot_read import is_lerobot, lerobot_rows
from workbench.recording.read_maniskill import trajectories
from workbench.recording.unreadable import UnreadableRecording

_OURS = (".rrd", ".h5", ".json")


def sources_in(path: Path) -> Iterator[tuple[Path, str | None]]:
    """Path and part (``traj_3``, or the number of a dataset's episode) of each; in a folder by name, with the folders below it.

    Raises:
        UnreadableRecording: a dataset is broken; the message says what is wrong.
        OSError: a folder cannot be looked into.
    """
    yield from _in_folder(path) if path.is_dir() else _in_file(path)


def _in_file(path: Path) -> Iterator[tuple[Path, str | None]]:
    if path.suffix not in _OURS:
        return
    if path.suffix == ".rrd" or _is_ours(path.with_suffix(".json")):
        yield (path.with_suffix(".json") if path.with_suffix(".json").is_file() else path), None
    elif path.with_suffix(".h5").is_file():
        try:
            names = trajectories(path.with_suffix(".h5"))
        except UnreadableRecording:
            return
        yield from ((path.with_suffix(".h5"), name) for name in names)


def _in_folder(folder: Path) -> Iterator[tuple[Path, str | None]]:
    if is_lerobot(folder):
        yield from ((folder, str(row.index)) for row in lerobot_rows(folder))
        return
    for path in sorted(folder.iterdir()):
        # What is hidden is under way, an index, or thrown away.
        if path.name.startswith("."):
            continue
        if path.is_dir():
            # A link may lead round in a circle.
            if not os.path.islink(path):
                yield from _in_folder(path)
        elif path.suffix == ".json" or (path.suffix == ".rrd" and not path.with_suffix(".json").exists()):
            yield from _in_file(path)


def _is_ours(path: Path) -> bool:
    try:
        return read_document(path).is_ours
    except (OSError, WrongDocument):
        return False
