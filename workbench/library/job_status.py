"""Status files of jobs that record into a folder: the command writes them there, and the folder's library shows them."""

from __future__ import annotations

import contextlib
import time
import uuid
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import msgspec

from workbench.episodes.row import clean_text
from workbench.machine.files import read_regular_file, replace_file

_PREFIX, _SUFFIX = ".job-", ".status"
_MAX_BYTES = 1 << 18
_MAX_FILES = 64
"""Maximum number of status files that are read from one folder; a job in 64 parts writes 64."""
_WRITE_SECONDS = 1.0
SILENT_SECONDS = 20.0
"""Age of the last status after which a job counts as dead."""
_KEPT_SECONDS = 3600.0
"""Time for which the last status of a job is shown."""
_MAX_FAILURES = 5

JobState = Literal["running", "done", "stopped", "failed"]


@dataclass(frozen=True)
class JobFailure:
    """Items that failed with the same error."""

    items: str
    """Names of the items."""
    count: int
    message: str
    traceback: str = ""


@dataclass(frozen=True)
class JobStatus:
    """Status of a job at one moment."""

    command: str
    """Name of the command, for example ``record``."""
    task: str
    done: int
    total: int
    """Number of requested episodes; `done` of them have ended."""
    rate: float = 0.0
    """Episodes per second since the job began; 0 if unknown."""
    failures: tuple[JobFailure, ...] = ()
    state: JobState = "running"
    part: str = ""
    """Part of a divided job, for example ``3/64``; empty if the job is not divided."""
    written_at: float = 0.0
    """Unix time in seconds."""
    place: str = ""
    """Folder that the job records into, relative to the library's folder; empty for the library's folder
    itself. Set by the reader."""

    @property
    def failed(self) -> int:
        return sum(failure.count for failure in self.failures)

    @property
    def seconds_left(self) -> float | None:
        left = self.total - self.done - self.failed
        return left / self.rate if self.state == "running" and self.rate > 0 else None

    def is_silent(self, now: float) -> bool:
        """Whether the job is dead: its last status says ``running``, but is older than `SILENT_SECONDS`."""
        return self.state == "running" and now - self.written_at > SILENT_SECONDS


class StatusFile:
    """Writes a job's status, at most once a second. Write errors are ignored: they must not end the job."""

    def __init__(self, folder: Path, clock: Callable[[], float] = time.time) -> None:
        self._folder, self._clock = folder.absolute(), clock
        self._path = self._folder / f"{_PREFIX}{uuid.uuid4().hex[:12]}{_SUFFIX}"
        self._written_at = 0.0

    def is_due(self) -> bool:
        """Whether the last status of a running job is old enough to be replaced."""
        return self._clock() - self._written_at >= _WRITE_SECONDS

    def write(self, status: JobStatus) -> None:
        now = self._clock()
        if status.state == "running" and not self.is_due():
            return
        if not self._folder.is_dir():
            return  # nothing is recorded yet
        self._written_at = now
        with contextlib.suppress(OSError):
            replace_file(self._path, msgspec.json.encode(replace(status, written_at=now)))

    def remove_old(self, status: JobStatus) -> None:
        """Remove status files older than an hour, and those of earlier runs of this job that have ended or
        died."""
        now = self._clock()
        mine = (status.command, status.task, status.part)
        for path in sorted(self._folder.glob(f"{_PREFIX}*{_SUFFIX}"))[: 10 * _MAX_FILES]:
            with contextlib.suppress(OSError, msgspec.MsgspecError, UnicodeError):
                if now - path.stat().st_mtime > _KEPT_SECONDS:
                    path.unlink()
                    continue
                there = msgspec.json.decode(read_regular_file(path, _MAX_BYTES), type=JobStatus)
                over = there.state != "running" or there.is_silent(now)
                if over and (there.command, there.task, there.part) == mine:
                    path.unlink()


def read_jobs(folder: Path, now: float, below: Iterable[Path] = ()) -> tuple[JobStatus, ...]:
    """The jobs of a folder that run or ended within the last hour, newest status first. The status files are
    untrusted: invalid files are skipped, and texts are cleaned.

    Args:
        below: subfolders of `folder` whose jobs are read too.
    """
    found: list[JobStatus] = []
    for place in dict.fromkeys((folder, *below)):
        with contextlib.suppress(OSError):
            for path in sorted(place.glob(f"{_PREFIX}*{_SUFFIX}"))[:_MAX_FILES]:
                with contextlib.suppress(OSError, msgspec.MsgspecError, UnicodeError):
                    status = msgspec.json.decode(read_regular_file(path, _MAX_BYTES), type=JobStatus)
                    if 0 <= now - status.written_at < _KEPT_SECONDS:
                        where = "" if place == folder else str(place.relative_to(folder))
                        found.append(_cleaned(replace(status, place=where)))
    return tuple(sorted(found, key=lambda status: -status.written_at))


def _cleaned(status: JobStatus) -> JobStatus:
    return replace(
        status,
        command=clean_text(status.command, 40),
        task=clean_text(status.task, 200),
        part=clean_text(status.part, 20),
        place=clean_text(status.place, 200),
        failures=tuple(
            JobFailure(
                clean_text(one.items, 200),
                max(one.count, 0),
                clean_text(one.message, 500),
                # Keep the indentation of lines, which shows their structure.
                "\n".join(
                    line[: len(line) - len(line.lstrip(" "))][:40] + clean_text(line, 300)
                    for line in one.traceback.splitlines()[:200]
                ),
            )
            for one in status.failures[:_MAX_FAILURES]
        ),
    )
