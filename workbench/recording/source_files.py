"""Which recordings a file is, or a folder holds, told by looking into them."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from workbench.recording.document import Document, WrongDocument, read_document
from workbench.recording.lerobot_read import is_lerobot, lerobot_rows
from workbench.recording.read_maniskill import trajectories
from workbench.recording.source import Source, UnreadableRecording

_OURS = (".rrd", ".h5", ".json")


def sources_in(path: Path) -> Iterator[Source]:
    """In a folder by name, with the folders below it. Raises OSError where a folder cannot be looked into."""
    if not path.is_dir():
        yield from _in_file(path) if path.suffix in _OURS else ()
    elif is_lerobot(path):
        yield from _in_dataset(path)
    else:
        # What is hidden is under way, an index, or thrown away.
        there = sorted(inside for inside in path.iterdir() if not inside.name.startswith("."))
        stems = {inside.with_suffix(""): inside for inside in there if inside.suffix in _OURS}
        for inside in sorted([*stems.values(), *(inside for inside in there if inside.is_dir())]):
            # A link may lead round in a circle.
            if not (inside.is_dir() and os.path.islink(inside)):
                yield from sources_in(inside)


def _in_file(path: Path) -> Iterator[Source]:
    json, h5, rrd = (path.with_suffix(suffix) for suffix in (".json", ".h5", ".rrd"))
    document = _document(json)
    if document.is_ours:
        yield Source(json, None, str(document.said["workbench"].get("id") or json.resolve()), json.stem)
    elif document.is_maniskills and h5.is_file():
        try:
            names = trajectories(h5)
        except UnreadableRecording:
            return
        yield from (Source(h5, name, f"{h5.resolve()}#{name}", f"{h5.stem}#{name}") for name in names)
    elif rrd.is_file():
        yield Source(rrd, None, str(rrd.resolve()), rrd.stem)


def _in_dataset(folder: Path) -> Iterator[Source]:
    try:
        numbers = [facts.trajectory for facts in lerobot_rows(folder)]
    except UnreadableRecording:
        numbers = ["0"]  # whoever reads it is told why
    for number in numbers:
        yield Source(folder, number, f"{folder.resolve()}#{number}", f"{folder.name}#{number}")


def _document(path: Path) -> Document:
    try:
        return read_document(path)
    except (OSError, WrongDocument):
        return Document({})
