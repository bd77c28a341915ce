"""Keeps the results of a job in a file as they arrive: a stopped job can resume, and parts can be merged.

The file is an SQLite database: each result is stored atomically, even if the process is killed.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import sqlite3
import sys
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from workbench.jobs.scheduler import Executor, Result, Scheduler, Setup, Shard, Update, Work
from workbench.machine.files import open_regular_file
from workbench.machine.processes.wire import Unpacker, Unreadable, pack
from workbench.machine.versions import package_versions
from workbench.task.content import read_content
from workbench.task.reference import named_file

_MAGIC = 0x57424A31
"""SQLite's ``application_id`` of these files."""
_TABLES = """
CREATE TABLE about (name TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE kept (name TEXT PRIMARY KEY, value BLOB NOT NULL);
CREATE TABLE result (number INTEGER PRIMARY KEY, value BLOB NOT NULL);
"""
_MAX_DIFFERENCES = 5
"""Maximum number of differences that a message names."""

Request = TypeVar("Request")


class JobFileError(ValueError):
    """The file belongs to another job, cannot be used, or is not a job file."""


@dataclass(frozen=True)
class JobKey:
    """Identity of the job that a job file belongs to."""

    command: str
    about: Mapping[str, str]
    """Names and values of everything that the results depend on."""
    request: bytes
    """Options of the command, packed; `merge` reads them."""
    folder: str = ""
    """Folder that the episodes are written to."""


def job_of(
    command: str, task: str, request: Any, leaves_out: Iterable[str], files: Sequence[Path] = ()
) -> JobKey:
    """The key of a command's job.

    Args:
        task: the task as the user named it.
        request: a dataclass with all options.
        leaves_out: fields of `request` that the results do not depend on.
        files: other files that the results depend on, such as the file of a policy.

    Raises:
        OSError: a file cannot be read.
    """
    about = {"command": command, "python": ".".join(map(str, sys.version_info[:2])), **package_versions()}
    file = named_file(task)
    # The task is identified by its file's name and text: the folder may differ between machines.
    about["task"] = task if file is None else task.replace(str(file.parent) + "/", "").rpartition("/")[2]
    if file is not None and file.is_file():
        about["the task's text"] = read_content(file).hash[:12]
    for path in files:
        about[f"the content of {path.name}"] = _sum(path)
    about.update(_flat("", request, {"task", *leaves_out}))
    folder = getattr(request, "out", None)
    return JobKey(command, about, pack(request), "" if folder is None else str(Path(folder).absolute()))


def _sum(path: Path) -> str:
    with open_regular_file(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:12]  # type: ignore[arg-type]


def _flat(name: str, value: Any, leaves_out: Iterable[str] = ()) -> Iterator[tuple[str, str]]:
    if dataclasses.is_dataclass(value):
        for one in dataclasses.fields(value):
            if one.name not in leaves_out:
                yield from _flat(one.name, getattr(value, one.name))
    elif isinstance(value, Mapping):
        for key, one in sorted(value.items()):
            yield from _flat(f"{name} {key}", one)
    else:
        yield name.replace("_", " "), json.dumps(value, default=str)


class JobFile:
    """The results of a job, by item. Used on one thread."""

    def __init__(self, path: Path, job: JobKey) -> None:
        """Open or create the file.

        Raises:
            JobFileError: the file belongs to another job (the message lists the differences), is open in
                another process, or is not a job file.
            OSError: the folder of the file cannot be created.
        """
        path.absolute().parent.mkdir(parents=True, exist_ok=True)
        self.path = path
        self.count = 0
        """Number of results that the file held when it was opened."""
        with _named(path):
            self._database = sqlite3.connect(path, timeout=0, isolation_level=None)
        try:
            with _named(path):
                # Lock the file while it is open: without a lock, two processes with the same job file would
                # both run all items.
                self._database.execute("PRAGMA locking_mode = EXCLUSIVE")
                self._database.execute("BEGIN EXCLUSIVE")
                if not self._database.execute("PRAGMA schema_version").fetchone()[0]:
                    self._create(job)
                else:
                    _require_same(path, job.about, _about(path, self._database))
                self.run = _kept(self._database, "run").decode()
                (self.count,) = self._database.execute("SELECT COUNT(*) FROM result").fetchone()
                self._database.execute("COMMIT")
        except BaseException:
            self._database.close()
            raise

    def _create(self, job: JobKey) -> None:
        self._database.execute(f"PRAGMA application_id = {_MAGIC}")
        for table in _TABLES.strip().splitlines():
            self._database.execute(table)
        self._database.executemany("INSERT INTO about VALUES (?, ?)", job.about.items())
        kept = {"run": uuid.uuid4().hex.encode(), "request": job.request, "folder": os.fsencode(job.folder)}
        self._database.executemany("INSERT INTO kept VALUES (?, ?)", kept.items())

    def results(self, kind: Any) -> dict[int, Any]:
        """Results in the file, by item. Raises JobFileError if a result cannot be read as the type `kind`."""
        return _results(self.path, self._database, kind)

    def keep(self, number: int, result: object) -> None:
        """Write a result to the disk. Raises JobFileError."""
        with _named(self.path):
            self._database.execute("INSERT OR REPLACE INTO result VALUES (?, ?)", (number, pack(result)))

    def put(self, packed: Mapping[int, bytes]) -> None:
        """Write packed results; they replace results of the same items in the file. Raises JobFileError."""
        with _named(self.path):
            self._database.execute("BEGIN")
            self._database.executemany("INSERT OR REPLACE INTO result VALUES (?, ?)", packed.items())
            self._database.execute("COMMIT")

    def close(self) -> None:
        self._database.close()


@dataclass(frozen=True)
class Kept:
    """Executor that skips the items whose results are in a job file, and writes new results to the file."""

    executor: Executor
    file: JobFile | None = None
    shard: Shard = Shard()
    is_there: Callable[[Any], bool] = lambda result: True
    """Returns whether the files that a result names still exist. An item without its files runs again."""

    @property
    def is_remote(self) -> bool:
        return self.executor.is_remote

    def run(self, work: Work[Setup, Result, Update], scheduler: Scheduler[Result, Update]) -> None:
        scheduler.take_part(self.shard)
        if self.file is not None:
            known = {n: one for n, one in self.file.results(work.result).items() if self.is_there(one)}
            scheduler.go_on(known, self.file.keep)
        if scheduler.count_left(1):
            self.executor.run(work, scheduler)


# --- merging of parts ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class JobParts:
    """The results of several job files of one job."""

    command: str
    about: Mapping[str, str]
    request: bytes
    values: dict[int, bytes]
    """Packed results, by item."""
    folders: dict[int, str]
    """Folder that the episode of each item was written to."""
    files: tuple[Path, ...] = field(default=())

    def requested(self, kind: type[Request]) -> Request:
        """Options of the command. Raises JobFileError."""
        try:
            return Unpacker().unpack(self.request, kind)
        except Unreadable as error:
            raise JobFileError(
                f"{self.files[0]} has options of the command that cannot be read ({error})"
            ) from error

    def results(self, kind: Any) -> dict[int, Any]:
        """Results by item. Raises JobFileError."""
        unpacker = Unpacker()
        try:
            return {number: unpacker.unpack(value, kind) for number, value in sorted(self.values.items())}
        except Unreadable as error:
            raise JobFileError(f"a result cannot be read ({error})") from error


def write_whole(path: Path, merged: JobParts) -> None:
    """Write the results of all parts to a job file; they replace results of the same items in the file.

    Raises:
        JobFileError: the file exists and belongs to another job, or another process has it open.
        OSError: the folder of the file cannot be created.
    """
    folder = next(iter(merged.folders.values()), "")
    file = JobFile(path, JobKey(merged.command, merged.about, merged.request, folder))
    with closing(file), _named(path):
        file.put(merged.values)


def read_parts(files: Sequence[Path]) -> JobParts:
    """The results of these job files.

    Raises:
        JobFileError: the files belong to different jobs (the message lists the differences), or two files
            have a result of the same item.
        FileNotFoundError: a file does not exist.
    """
    about: Mapping[str, str] | None = None
    values: dict[int, bytes] = {}
    folders: dict[int, str] = {}
    owners: dict[int, Path] = {}
    """For each item: the job file with its result."""
    request = b""
    for path in files:
        if not path.is_file():
            raise FileNotFoundError(f"there is no file {path}")
        with (
            _named(path),
            closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", timeout=0, uri=True)) as database,
        ):
            about_part = _about(path, database)
            if about is None:
                about, request = about_part, _kept(database, "request")
            _require_same(path, about, about_part)
            folder = os.fsdecode(_kept(database, "folder"))
            rows = database.execute("SELECT number, value FROM result").fetchall()
        if (doubled := next((number for number, _ in rows if number in owners), None)) is not None:
            raise JobFileError(
                f"{owners[doubled]} and {path} both have the result of item {doubled}: they are the same "
                "part of the job, so leave one of them out"
            )
        owners.update((number, path) for number, _ in rows)
        values.update(rows)
        folders.update((number, folder) for number, _ in rows)
    if about is None:
        raise JobFileError("name the job files to merge")
    return JobParts(about["command"], about, request, values, folders, tuple(files))


def _require_same(path: Path, mine: Mapping[str, str], there: Mapping[str, str]) -> None:
    names = [name for name in dict.fromkeys((*mine, *there)) if mine.get(name) != there.get(name)]
    if names:
        differences = "; ".join(
            f"{name} is {mine.get(name, 'not given')} here and {there.get(name, 'not given')} there"
            for name in names[:_MAX_DIFFERENCES]
        )
        more = f"; and {len(names) - _MAX_DIFFERENCES} more differ" if len(names) > _MAX_DIFFERENCES else ""
        raise JobFileError(f"{path} belongs to another job: {differences}{more}")


def _about(path: Path, database: sqlite3.Connection) -> dict[str, str]:
    if database.execute("PRAGMA application_id").fetchone()[0] != _MAGIC:
        raise JobFileError(f"{path} is not a job file")
    return dict(database.execute("SELECT name, value FROM about"))


def _kept(database: sqlite3.Connection, name: str) -> bytes:
    (value,) = database.execute("SELECT value FROM kept WHERE name = ?", (name,)).fetchone()
    return value


def _results(path: Path, database: sqlite3.Connection, kind: Any) -> dict[int, Any]:
    unpacker = Unpacker()
    with _named(path):
        rows = database.execute("SELECT number, value FROM result ORDER BY number").fetchall()
    try:
        return {number: unpacker.unpack(value, kind) for number, value in rows}
    except Unreadable as error:
        raise JobFileError(f"{path} holds a result that cannot be read ({error})") from error


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """Raise errors of the database as JobFileError with the name of the file."""
    try:
        yield
    except sqlite3.OperationalError as error:
        busy = error.sqlite_errorcode == sqlite3.SQLITE_BUSY
        why = "another process has it open" if busy else str(error)
        raise JobFileError(f"{path} cannot be used: {why}") from error
    except (sqlite3.DatabaseError, TypeError) as error:
        raise JobFileError(f"{path} is not a job file ({error})") from error
