"""Which recordings lie below a folder, by names, sizes and times alone: nothing is opened.

A recording is a handful of files with one name and different endings, so files are put together by that name. By sizes
and times of all of them the index knows whether it has read them as they are.

A folder's own time changes when a name in it comes, goes or is given to another file, which is how every recording of
ours is written. So between two full looks it is enough to ask a few folders for their time (`Scan.is_unchanged`).
That time moves in ticks, and a file that came within the tick of the last look would never be seen: as long as a
folder's time is this fresh, it is looked into again.
"""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, field
from pathlib import Path

from workbench.recording.episode.row import Facts, LibraryEntry, clean_text

SUFFIXES = (".json", ".h5", ".rrd")
"""In the order in which a recording is opened by them."""
NOTES = ".notes"
"""Ending of the file with tags and notes of recordings that are not ours to write into: JSON, but a ``.json`` would be
taken for a recording's by whoever looks for those."""
DATASET_KEY = ["meta", "info"]
"""How the key of a LeRobot dataset ends."""
SETTLES = 3.0
"""Seconds in which a folder may change again within one tick of its time, and files of one recording come one by one."""
MOST_ENTRIES = 500_000
"""Names looked at: somebody will give a home folder for the library."""


@dataclass(frozen=True)
class Found:
    """The files of one name; another when any of them was written to, came or went."""

    key: str
    """Path of the name below the library's folder, with ``/``."""
    sizes: dict[str, int]
    """Suffix to bytes, in the order of `SUFFIXES`, `NOTES` last."""
    times: dict[str, int]
    """Suffix to nanoseconds."""

    @property
    def newest(self) -> int:
        """When the recording was last written to, in nanoseconds. Notes are not the recording."""
        return max(at for suffix, at in self.times.items() if suffix != NOTES)

    def path(self, folder: Path, suffix: str) -> Path:
        return folder / f"{self.key}{suffix}"

    def paths(self, folder: Path) -> tuple[Path, ...]:
        return tuple(self.path(folder, suffix) for suffix in self.sizes)


def broken(found: Found, problem: str) -> LibraryEntry:
    """The row of files of which nothing else is known."""
    kind = "rrd only" if found.sizes.keys() <= {".rrd", NOTES} else "maniskill"
    return Facts(kind, written=found.newest / 1e9, problem=clean_text(problem, 500)), None


def key_of(path: str) -> str:
    """Of a file, by its path below the library's folder."""
    return os.path.splitext(path)[0]


@dataclass(frozen=True)
class Scan:
    found: dict[str, Found] = field(default_factory=dict)
    """By key."""
    folders: dict[str, int] = field(default_factory=dict)
    """Every folder that was looked into, and its time in nanoseconds."""
    fresh: bool = False
    """Whether something was written so lately that it must be looked at again."""
    problem: str | None = None
    """A sentence, where not everything could be looked at."""

    def is_unchanged(self) -> bool:
        """Whether nothing came or went since; cheap."""
        if self.fresh or self.problem is not None:
            return False
        try:
            return all(os.stat(path).st_mtime_ns == at for path, at in self.folders.items())
        except OSError:
            return False


def scan_folder(folder: Path) -> Scan:
    """Look for recordings in `folder` and the folders below it. Names that begin with a dot are passed over, and so
    are links to folders, which may lead round in a circle."""
    names: dict[str, dict[str, os.stat_result]] = {}
    folders: dict[str, int] = {}
    problem: str | None = None
    now = time.time_ns()
    pending, entries = [(os.fspath(folder), "")], 0
    while pending:
        path, below = pending.pop()
        try:
            # Its time first: what comes while its names are read makes it differ, not look the same.
            at = os.stat(path).st_mtime_ns
            with os.scandir(path) as listed:
                folders[path] = at
                for entry in listed:
                    entries += 1
                    if entry.name.startswith("."):
                        continue
                    if entry.is_dir(follow_symlinks=False):
                        pending.append((entry.path, f"{below}{entry.name}/"))
                    elif entry.name.endswith((*SUFFIXES, NOTES)):
                        _add(names, below, entry)
        except FileNotFoundError:
            if not below:
                problem = f"{_printable(folder)} is not there."
        except OSError as error:
            problem = f"{_printable(path)} cannot be looked into: {error.strerror or error}."
        if entries > MOST_ENTRIES:
            problem = f"{_printable(folder)} holds more than {MOST_ENTRIES:,} files; not all of them were looked at. Choose a folder with recordings in it."
            break
    found, waits = {}, False
    for key, stats in names.items():
        group = _group(key, stats)
        if group is None:
            continue
        if ".json" not in group.sizes and ".h5" in group.sizes and now - group.newest < SETTLES * 1e9:
            waits = True  # being given its names just now
            continue
        found[key] = group
    fresh = waits or any(now - at < SETTLES * 1e9 for at in folders.values())
    return Scan(found, folders, fresh, problem)


def _add(names: dict[str, dict[str, os.stat_result]], below: str, entry: os.DirEntry[str]) -> None:
    suffix = os.path.splitext(entry.name)[1]
    try:
        found = entry.stat()
    except OSError:
        return  # gone since, or a link to nowhere: not a recording
    names.setdefault(below + entry.name[: -len(suffix)], {})[suffix] = found


def _group(key: str, stats: dict[str, os.stat_result]) -> Found | None:
    if not any(suffix in stats for suffix in SUFFIXES):
        return None  # notes of files that were taken away
    order = [suffix for suffix in (*SUFFIXES, NOTES) if suffix in stats]
    return Found(
        key,
        {suffix: stats[suffix].st_size for suffix in order},
        {suffix: stats[suffix].st_mtime_ns for suffix in order},
    )


def _printable(path: str | Path) -> str:
    """A path as text that can be sent to a page."""
    return os.fsencode(path).decode(errors="replace")
