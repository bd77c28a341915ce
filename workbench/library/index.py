"""SQLite cache of a library's rows and thumbnails."""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import sqlite3
import threading
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import msgspec

from workbench.episodes.reader.scan import RecordingFiles
from workbench.episodes.row import Facts, LibraryEntry, clean_facts
from workbench.machine.folders import cache_folder

log = logging.getLogger(__name__)

VERSION = 6
"""Increase this when the content or the format of rows changes; each version has its own file."""
LOCKED_SECONDS = 3.0
MAX_INDICES = 200
"""Maximum number of indices that are kept."""
_ROWS = msgspec.msgpack.Decoder(tuple[dict[str, int], dict[str, int], list[Facts]])
"""Sizes and times of the files, and their rows."""
_JPEGS = msgspec.msgpack.Decoder(list[bytes | None])
_TABLES = ("read (key BLOB PRIMARY KEY, rows BLOB)", "pictures (key BLOB PRIMARY KEY, jpegs BLOB)")
T = TypeVar("T")


@dataclass(frozen=True)
class IndexedFiles:
    """The rows of the files that share one name, with the files' sizes and times when they were read."""

    found: RecordingFiles
    rows: tuple[Facts, ...]


class LibraryIndex:
    """The index of one folder. Thread-safe; its methods do not fail.

    All its content can be read again from the files. So a broken index is deleted, and an operation that
    finds the index locked for `LOCKED_SECONDS` is skipped. SQLite tolerates concurrent processes, and processes that are killed.

    The index is in the user's cache folder, or in memory if that folder is not writable. It is not in the
    library's folder: a foreign folder could contain an index that is a link to another program's database, or
    whose journal names files to delete.
    """

    def __init__(self, folder: Path) -> None:
        self._lock = threading.Lock()
        self._path = index_path(folder)
        self._database: sqlite3.Connection | None = _open(self._path)
        _remove_oldest(self._path)

    def load(self) -> dict[str, IndexedFiles]:
        """All indexed files, by key."""

        def read(database: sqlite3.Connection) -> dict[str, IndexedFiles]:
            kept = {}
            for key, rows in database.execute("SELECT key, rows FROM read"):
                sizes, times, facts = _ROWS.decode(rows)
                found = RecordingFiles(os.fsdecode(key), sizes, times)
                kept[found.key] = IndexedFiles(found, tuple(map(clean_facts, facts)))
            return kept

        return self._do(read, {})

    def store(
        self, read: Collection[tuple[RecordingFiles, Sequence[LibraryEntry]]], gone: Collection[str] = ()
    ) -> None:
        """Store the rows of the files in `read`, and delete those of the keys in `gone`."""

        def write(database: sqlite3.Connection) -> None:
            for found, entries in read:
                key, facts = os.fsencode(found.key), [facts for facts, _ in entries]
                rows = msgspec.msgpack.encode((found.sizes, found.times, facts))
                jpegs = msgspec.msgpack.encode([jpeg for _, jpeg in entries])
                database.execute("REPLACE INTO read VALUES (?, ?)", (key, rows))
                database.execute("REPLACE INTO pictures VALUES (?, ?)", (key, jpegs))
            keys = [(os.fsencode(key),) for key in gone]
            database.executemany("DELETE FROM read WHERE key = ?", keys)
            database.executemany("DELETE FROM pictures WHERE key = ?", keys)

        self._do(write, None)

    def thumbnails(self, places: Collection[tuple[str, int]]) -> dict[tuple[str, int], bytes]:
        """JPEGs of these rows, which are given as (key of the files, row number in them); rows without a JPEG
        are left out."""

        def read(database: sqlite3.Connection) -> dict[tuple[str, int], bytes]:
            found = {}
            for key in {key for key, _ in places}:
                query = "SELECT jpegs FROM pictures WHERE key = ?"
                for (jpegs,) in database.execute(query, (os.fsencode(key),)):
                    found |= {(key, row): jpeg for row, jpeg in enumerate(_JPEGS.decode(jpegs)) if jpeg}
            return {place: found[place] for place in places if place in found}

        return self._do(read, {})

    def close(self) -> None:
        with self._lock:
            if self._database is not None:
                self._database.close()
                self._database = None

    def _do(self, work: Callable[[sqlite3.Connection], T], default: T) -> T:
        """Run `work`; returns `default` if another process has locked the file or the file is broken. A broken file is
        replaced, which does not harm another process that has it open."""
        with self._lock:
            if self._database is None:
                return default
            try:
                with self._database:
                    return work(self._database)
            except (sqlite3.Error, msgspec.MsgspecError, ValueError, TypeError) as error:
                # Only SQLite's errors have a code. Its low byte is the primary error code, the rest is the
                # variant.
                code = getattr(error, "sqlite_errorcode", None) or 0
                if code & 0xFF not in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED):
                    log.info("The index of the library is rebuilt: %s", error)
                    self._database.close()
                    _remove(self._path)
                    self._database = _open(self._path)
                return default


def index_path(folder: Path) -> Path:
    """Path of the index of a folder."""
    name = hashlib.blake2b(os.fsencode(folder.resolve()), digest_size=12).hexdigest()
    return cache_folder() / "libraries" / f"{name}-{VERSION}.sqlite"


def _open(path: Path) -> sqlite3.Connection:
    """Open or create the index, replacing a file that is not an index; in memory if `path` is not writable."""
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
    for _ in range(2):
        try:
            return _connect(os.fspath(path))
        except sqlite3.OperationalError:
            break
        except sqlite3.DatabaseError:
            _remove(path)
    return _connect(":memory:")


def _connect(name: str) -> sqlite3.Connection:
    database = sqlite3.connect(name, timeout=LOCKED_SECONDS, check_same_thread=False)
    try:
        with database:
            for table in _TABLES:
                database.execute(f"CREATE TABLE IF NOT EXISTS {table}")
            # Try a write: in a read-only folder, everything else succeeds.
            database.execute("DELETE FROM read WHERE key = ''")
    except sqlite3.Error:
        database.close()
        raise
    return database


def _remove_oldest(path: Path) -> None:
    """Delete the least recently used indices beyond `MAX_INDICES`."""
    try:
        os.utime(path)
        indices = sorted(path.parent.glob("*.sqlite"), key=lambda index: index.stat().st_mtime)
    except OSError:
        return  # missing, or another process is deleting
    for index in indices[:-MAX_INDICES]:
        _remove(index)


def _remove(path: Path) -> None:
    with contextlib.suppress(OSError):
        for name in (path, path.with_name(f"{path.name}-journal")):
            name.unlink(missing_ok=True)
