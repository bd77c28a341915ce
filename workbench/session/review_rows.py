"""Whether the files of opened recordings are still what was read.

What was read stays in memory, so a file that is deleted or written anew later takes nothing away. It only has to be said.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from workbench.core.geometry import SharedShapes
from workbench.recording.episode import Episode
from workbench.recording.library_row import LibraryRow


@dataclass(frozen=True)
class Stamp:
    """Of a file that was read."""

    of: str
    """The recording's name."""
    was: tuple[int, int] | None
    """Size and time of change then; None if it was not there."""


def shared(episode: Episode, shapes: SharedShapes) -> Episode:
    """The same recording, with shapes of others where they look the same."""
    return episode if episode.geometry is None else replace(episode, geometry=shapes.share(episode.geometry))


def stamps_of(row: LibraryRow) -> dict[Path, Stamp]:
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


def opening_words(rows: Sequence[LibraryRow], done: int) -> str:
    """What is being opened, and how far that is."""
    name = rows[done].name
    return f"opening {name}" if len(rows) == 1 else f"opening {done + 1} of {len(rows)}: {name}"


def _size_and_time(path: Path) -> tuple[int, int] | None:
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_size, found.st_mtime_ns
