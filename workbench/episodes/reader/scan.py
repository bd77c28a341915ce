"""Lists the recordings below a folder by names, sizes and times, without opening files."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, field
from pathlib import Path

from workbench.episodes.row import Facts, LibraryEntry, clean_text

SUFFIXES = (".json", ".h5", ".rrd")
"""Suffixes of a recording, in the order of preference for opening it."""
NOTES = ".notes"
"""Suffix of the JSON file with tags and notes of other programs' recordings; a ``.json`` would be mistaken for a
recording."""
DATASET_KEY = ["meta", "info"]
"""End of the key of a LeRobot dataset."""
SETTLE_SECONDS = 3.0
"""A folder that changed less than this long ago is scanned again: its modification time advances in ticks, so
another change may not alter it, and a new recording may still get its other files."""
MAX_ENTRIES = 500_000
"""Maximum number of names that are listed: the folder may be a home folder."""


@dataclass(frozen=True)
class RecordingFiles:
    """The files that share one name. The values of two scans differ if a file was written, added or removed
    between the scans."""

    key: str
    """Path without suffix, relative to the library's folder; ``/`` separates its parts."""
    sizes: dict[str, int]
    """Size in bytes by suffix, in the order of `SUFFIXES`, `NOTES` last."""
    times: dict[str, int]
    """Modification time in nanoseconds by suffix."""

    @property
    def newest(self) -> int:
        """Time of the last change in nanoseconds, excluding notes."""
        return max(at for suffix, at in self.times.items() if suffix != NOTES)

    def path(self, folder: Path, suffix: str) -> Path:
        return folder / f"{self.key}{suffix}"

    def paths(self, folder: Path) -> tuple[Path, ...]:
        return tuple(self.path(folder, suffix) for suffix in self.sizes)


def broken(found: RecordingFiles, problem: str) -> LibraryEntry:
    """The row of files that cannot be read."""
    kind = "rrd only" if found.sizes.keys() <= {".rrd", NOTES} else "maniskill"
    return Facts(kind, written=found.newest / 1e9, problem=clean_text(problem, 500)), None


def files_named(path: Path) -> RecordingFiles | None:
    """The files of the recording that `path` belongs to, with the folder of `path` as the library; None if
    there are none."""
    stats: dict[str, os.stat_result] = {}
    for suffix in (*SUFFIXES, NOTES):
        try:
            stats[suffix] = path.with_suffix(suffix).stat()
        except OSError:
            continue  # missing, or a dangling link
    return _group(path.stem, stats)


def key_of(path: str) -> str:
    """Key of a file from its path below the library's folder."""
    return os.path.splitext(path)[0]


@dataclass(frozen=True)
class Scan:
    """Result of `scan_folder`.

    Writing or deleting a recording adds, replaces or removes names in a folder, which changes the folder's
    modification time. So `is_unchanged` checks only the times of folders. These times advance in ticks, and a
    file that is added within the tick of the last scan would be missed. Therefore a folder with a recent time
    counts as changed (`fresh`).
    """

    found: dict[str, RecordingFiles] = field(default_factory=dict)
    """Files of each recording, by key."""
    folders: dict[str, int] = field(default_factory=dict)
    """Modification time in nanoseconds of every scanned folder."""
    unsettled: dict[str, RecordingFiles] = field(default_factory=dict)
    """Files of new recordings that have no ``.json`` yet, by key."""
    fresh: bool = False
    """Whether something was written so recently that the folder must be scanned again."""
    problem: str | None = None
    """A sentence, if the scan is incomplete."""

    def is_unchanged(self) -> bool:
        """Whether no file was added, removed or replaced since the scan. Checks only the folders' times."""
        if self.fresh or self.problem is not None:
            return False
        try:
            return all(os.stat(path).st_mtime_ns == at for path, at in self.folders.items())
        except OSError:
            return False


def scan_folder(folder: Path) -> Scan:
    """The recordings in `folder` and the folders below it. Skips names that begin with a dot, and links to
    folders, which may form a cycle."""
    names: dict[str, dict[str, os.stat_result]] = {}
    folders: dict[str, int] = {}
    problem: str | None = None
    now = time.time_ns()
    pending, entries = [(os.fspath(folder), "")], 0
    while pending:
        path, below = pending.pop()
        try:
            # Read the time first, so that a file added during the listing counts as a change.
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
                problem = (
                    f"{_printable(folder)} does not exist. It is created when an episode is recorded into it."
                )
        except OSError as error:
            problem = f"{_printable(path)} cannot be listed: {error.strerror or error}."
        if entries > MAX_ENTRIES:
            problem = f"{_printable(folder)} holds more than {MAX_ENTRIES:,} files, and not all of them were searched. Choose a folder with recordings in it."
            break
    found, unsettled = {}, {}
    for key, stats in names.items():
        group = _group(key, stats)
        if group is None:
            continue
        if ".json" not in group.sizes and ".h5" in group.sizes and now - group.newest < SETTLE_SECONDS * 1e9:
            unsettled[key] = group
        else:
            found[key] = group
    fresh = bool(unsettled) or any(now - at < SETTLE_SECONDS * 1e9 for at in folders.values())
    return Scan(found, folders, unsettled, fresh, problem)


def _add(names: dict[str, dict[str, os.stat_result]], below: str, entry: os.DirEntry[str]) -> None:
    suffix = os.path.splitext(entry.name)[1]
    try:
        found = entry.stat()
    except OSError:
        return  # removed meanwhile, or a dangling link
    names.setdefault(below + entry.name[: -len(suffix)], {})[suffix] = found


def _group(key: str, stats: dict[str, os.stat_result]) -> RecordingFiles | None:
    if not any(suffix in stats for suffix in SUFFIXES):
        return None  # notes of removed files
    order = [suffix for suffix in (*SUFFIXES, NOTES) if suffix in stats]
    return RecordingFiles(
        key,
        {suffix: stats[suffix].st_size for suffix in order},
        {suffix: stats[suffix].st_mtime_ns for suffix in order},
    )


def _printable(path: str | Path) -> str:
    """A path as valid UTF-8, for the page."""
    return os.fsencode(path).decode(errors="replace")
