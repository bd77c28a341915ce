"""What a review needs of the library's rows: the recording behind one, and whether its files are still what was read.

A row is of any kind of recording that the library knows, and each kind is read by a reader of its own; whoever looks
at recordings side by side need not know which is which. What was read stays in memory, so a file that is deleted or
written anew later takes nothing away. It only has to be said.
"""

from __future__ import annotations

import datetime
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

from workbench.core.shared_shapes import SharedShapes
from workbench.recording.episode import Episode
from workbench.recording.sources import Source


class Row(Protocol):
    """What is asked of a row of the library."""

    @property
    def id(self) -> str: ...
    @property
    def name(self) -> str: ...
    @property
    def paths(self) -> tuple[Path, ...]: ...
    @property
    def source(self) -> Source: ...
    @property
    def date(self) -> datetime.datetime | None: ...


class Rows(Protocol):
    """What is asked of the library."""

    def rows(self) -> Sequence[Row]: ...


@dataclass(frozen=True)
class Stamp:
    """Of a file that was read."""

    of: str
    """The recording's name."""
    was: tuple[int, int] | None
    """Size and time of change then; None if it was not there."""


def read_row(row: Row, shapes: SharedShapes | None = None, folder: Path | None = None) -> Episode:
    """The recording of a row, with those shapes where it looks the same; `folder` is the library's. Raises as `read_recording`."""
    return row.source.read(shapes, folder)


def shared(episode: Episode, shapes: SharedShapes) -> Episode:
    """The same recording, with shapes of others where they look the same."""
    return episode if episode.geometry is None else replace(episode, geometry=shapes.share(episode.geometry))


def stamps_of(row: Row) -> dict[Path, Stamp]:
    """Its files as they are now."""
    return {path: Stamp(row.name, _size_and_time(path)) for path in row.paths}


def not_as_read(files: Mapping[Path, Stamp]) -> list[str]:
    """A sentence for each file that was deleted or changed since it was read."""
    said = []
    for path, stamp in files.items():
        now = _size_and_time(path)
        if now is None and stamp.was is not None:
            said.append(f"{path.name} was deleted since it was opened; what was read of it is still shown.")
        elif now != stamp.was:
            said.append(
                f"{path.name} has changed since it was opened; open {stamp.of} again to see what is in it now."
            )
    return said


def opening_words(rows: Sequence[Row], done: int) -> str:
    """What is being opened, and how far that is."""
    name = rows[done].name
    return f"opening {name}" if len(rows) == 1 else f"opening {done + 1} of {len(rows)}: {name}"


def _size_and_time(path: Path) -> tuple[int, int] | None:
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_size, found.st_mtime_ns
