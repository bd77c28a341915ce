"""What was read of a library's files, kept so that thousands of them are there at once the next time.

The index is a cache and nothing else: all that it holds can be read again from the files, so whatever is wrong with it
(another version, cut short, a page of garbage, no place to write) is answered by throwing it away, never by an error.
For each name it keeps the signature of its files, the rows that they gave, and their thumbnails. It is SQLite, since
that bears two processes at once and being killed; each write is one short transaction. A process that finds the file
locked for long goes on without having written.

It lies in the user's cache folder, and where that cannot be written in memory, for this time. Not in the library's folder: one that
came from elsewhere would bring an index along, and SQLite does what a file says (it may be a link to another program's
database, which would be given our tables, or have a journal that names files to delete).
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import sqlite3
import threading
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec

from workbench.machine.user_folder import cache_folder
from workbench.recording.library_row import Entry, Facts, clean_facts
from workbench.recording.library_scan import found_of

log = logging.getLogger(__name__)

VERSION = 4
"""Raised whenever rows are read or kept in another way: what another version left is read again."""
LOCKED_SECONDS = 3.0
MOST_INDICES = 200
"""Of folders that were looked into."""
_ROWS = msgspec.msgpack.Decoder(list[Facts])
_TABLES = (
    "CREATE TABLE IF NOT EXISTS read (key TEXT PRIMARY KEY, signature TEXT NOT NULL, rows BLOB NOT NULL)",
    "CREATE TABLE IF NOT EXISTS pictures (key TEXT, row INTEGER, jpeg BLOB NOT NULL, PRIMARY KEY (key, row))",
)


@dataclass(frozen=True)
class Kept:
    """What the files of one name gave when they had this signature."""

    signature: str
    rows: tuple[Facts, ...]


class LibraryIndex:
    """The index of one folder. Safe to use from several threads."""

    def __init__(self, folder: Path) -> None:
        self._lock = threading.Lock()
        self.path: Path | None = None
        """Where it lies; None in memory."""
        self._database: sqlite3.Connection | None = None
        path = index_path(folder)
        self._database = _open(path)
        if self._database is None:
            self._database = _connect(":memory:")
            return
        self.path = path
        _tidy(path)

    def load(self) -> dict[str, Kept]:
        """All that it holds, by key."""
        try:
            with self._lock, self._transaction() as database:
                kept = {}
                for key, signature, rows in database.execute("SELECT key, signature, rows FROM read"):
                    found_of(key, signature)  # raises where it is none
                    kept[key] = Kept(signature, tuple(map(clean_facts, _ROWS.decode(rows))))
                return kept
        except (sqlite3.Error, ValueError, TypeError, KeyError) as error:
            self._begin_anew(error)
            return {}

    def store(self, read: Iterable[tuple[str, str, Sequence[Entry]]], gone: Iterable[str] = ()) -> None:
        """Keep what was read (key, signature, entries) and forget the keys that are gone."""
        # A name that is no text cannot be a key; its files are read every time.
        read, gone = [one for one in read if _is_text(one[0])], [key for key in gone if _is_text(key)]
        try:
            with self._lock, self._transaction() as database:
                keys = [(key,) for key in (*gone, *(key for key, _, _ in read))]
                database.executemany("DELETE FROM read WHERE key = ?", keys)
                database.executemany("DELETE FROM pictures WHERE key = ?", keys)
                database.executemany(
                    "INSERT INTO read VALUES (?, ?, ?)",
                    [
                        (key, signature, msgspec.msgpack.encode([facts for facts, _ in entries]))
                        for key, signature, entries in read
                    ],
                )
                database.executemany(
                    "INSERT INTO pictures VALUES (?, ?, ?)",
                    [
                        (key, row, jpeg)
                        for key, _, entries in read
                        for row, (_, jpeg) in enumerate(entries)
                        if jpeg is not None
                    ],
                )
        except sqlite3.Error as error:
            if not _is_locked(error):
                self._begin_anew(error)

    def thumbnails(self, wanted: Sequence[tuple[str, int]]) -> dict[tuple[str, int], bytes]:
        """The jpegs of these rows (key, and number of the row in what its files gave), of those that have one."""
        found: dict[tuple[str, int], bytes] = {}
        try:
            with self._lock, self._transaction() as database:
                for key, row in (place for place in wanted if _is_text(place[0])):
                    query = "SELECT jpeg FROM pictures WHERE key = ? AND row = ?"
                    for (jpeg,) in database.execute(query, (key, row)):
                        if isinstance(jpeg, bytes):
                            found[key, row] = jpeg
        except sqlite3.Error as error:
            if not _is_locked(error):
                self._begin_anew(error)
        return found

    def close(self) -> None:
        with self._lock:
            if self._database is not None:
                self._database.close()
                self._database = None

    @contextlib.contextmanager
    def _transaction(self):
        database = self._database
        if database is None:
            raise sqlite3.ProgrammingError("the index was closed")
        with database:
            yield database

    def _begin_anew(self, error: Exception) -> None:
        """Throw away what is there. Another process that has it open goes on with what it has, unharmed."""
        with self._lock:
            if self._database is None:
                return
            log.info("The index of the library is made anew: %s", error)
            self._database.close()
            self._database = None
            if self.path is not None:
                _remove(self.path)
                self._database = _open(self.path)
            if self._database is None:
                self.path = None
                self._database = _connect(":memory:")


def _is_text(key: str) -> bool:
    try:
        key.encode()
    except UnicodeEncodeError:
        return False
    return True


def index_path(folder: Path) -> Path:
    """Where the index of a folder lies."""
    name = hashlib.blake2b(os.fsencode(folder.resolve()), digest_size=12).hexdigest()
    return cache_folder() / "libraries" / f"{name}.sqlite"


def _open(path: Path) -> sqlite3.Connection | None:
    """None where there is no place for it. What is there and no index of this version is thrown away."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    for _ in range(2):
        try:
            return _connect(os.fspath(path))
        except sqlite3.OperationalError as error:
            if not _is_locked(error):
                return None
        except sqlite3.DatabaseError:
            pass
        if not _remove(path):
            return None
    return None


def _tidy(path: Path) -> None:
    """Throw away the indices that were used least lately, where there are very many."""
    try:
        os.utime(path)
        indices = sorted(path.parent.glob("*.sqlite"), key=lambda index: index.stat().st_mtime)
    except OSError:
        return  # another process is at it
    for index in indices[:-MOST_INDICES]:
        _remove(index)


def _connect(name: str) -> sqlite3.Connection:
    database = sqlite3.connect(name, timeout=LOCKED_SECONDS, check_same_thread=False)
    try:
        with database:
            if database.execute("PRAGMA user_version").fetchone()[0] != VERSION:
                for table in ("read", "pictures"):
                    database.execute(f"DROP TABLE IF EXISTS {table}")
                database.execute(f"PRAGMA user_version = {VERSION}")
            for table in _TABLES:
                database.execute(table)
            # A folder that may be read but not written says so only here.
            database.execute("DELETE FROM read WHERE key = ''")
    except sqlite3.Error:
        database.close()
        raise
    return database


def _remove(path: Path) -> bool:
    try:
        for name in (path, path.with_name(f"{path.name}-journal")):
            name.unlink(missing_ok=True)
    except OSError:
        return False
    return True


def _is_locked(error: sqlite3.Error) -> bool:
    # What Python's module raises by itself has no code. The low byte is the error, the rest tells its kinds apart.
    code = getattr(error, "sqlite_errorcode", None)
    return code is not None and code & 0xFF in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED)
