"""Background work of a session, as tasks of the loop."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from enum import Enum
from itertools import count

from workbench.machine import loop
from workbench.machine.processes.watched_thread import report_failure
from workbench.task.problem import Problem, shorten


@dataclass(frozen=True)
class JobProgress:
    """Progress of a job."""

    what: str
    done: int
    total: int

    @property
    def text(self) -> str:
        """Text for the page, such as "rendering again, 120 of 290"."""
        return f"{self.what}, {self.done} of {self.total}" if self.total > 1 else self.what


class JobFailed(Exception):
    """The job failed. The text is for the page; `problem` is set if the author's code raised."""

    def __init__(self, why: str, problem: Problem | None = None) -> None:
        super().__init__(why)
        self.problem = problem


class ProcessDied(JobFailed):
    """The process of the job died; the next question starts another one."""


class Job:
    """One piece of work."""

    _numbers = count(1)

    def __init__(self, what: str, on_change: Callable[[], None] = lambda: None) -> None:
        self._what, self._on_change = what, on_change
        self.number = next(self._numbers)
        """Number of the job, counting up over jobs of all kinds."""
        self.progress = JobProgress(what, 0, 0)
        self.stopped = False
        """Whether the job was stopped; work on another thread checks this."""

    def report(self, done: int, total: int, what: str = "") -> None:
        """Report progress."""
        self.progress = JobProgress(what or self._what, done, total)
        self._on_change()


class Jobs:
    """Runs one job at a time: a new job stops the previous one, which then has no further effect. Used on the loop."""

    def __init__(self, on_change: Callable[[], None], on_failure: Callable[[JobFailed], object]) -> None:
        """
        Args:
            on_change: called when `progress` has changed.
            on_failure: called when a job failed, unless it was stopped.
        """
        self._on_change, self._on_failure = on_change, on_failure
        self._job: Job | None = None
        self._task: asyncio.Task[None] | None = None
        self._closed = False

    @property
    def progress(self) -> JobProgress | None:
        """Progress of the running job; None without one."""
        return None if self._job is None else self._job.progress

    def start(self, what: str, work: Callable[[Job], Awaitable[None]]) -> None:
        """Start a job in place of the previous one."""
        self.stop()
        if self._closed:
            return
        self._job = job = Job(what, self._on_change)
        self._task = loop.begin(self._run(job, work))
        self._on_change()

    def stop(self) -> None:
        """Stop the job."""
        if self._job is not None and self._task is not None:
            self._job.stopped = True
            self._task.cancel()
            self._job = self._task = None

    def close(self) -> None:
        """Stop the job; no further job can start."""
        self._closed = True
        self.stop()

    async def _run(self, job: Job, work: Callable[[Job], Awaitable[None]]) -> None:
        failure: JobFailed | None = None
        try:
            await work(job)
        except JobFailed as failed:
            failure = failed
        except Exception as error:
            # A fault of the workbench. The page must see that the job is over.
            report_failure(f"The job '{job.progress.what}' failed", error)
            why = f"the workbench itself failed ({type(error).__name__}: {shorten(str(error))})"
            failure = JobFailed(why)
        if job.stopped:
            return
        self._job = self._task = None
        if failure is not None:
            self._on_failure(failure)
        self._on_change()


class StoppedBy(Enum):
    """Why a job ended early; the value is the page's text."""

    USER = "stopped by the user"
    SAVE = "the file was saved again"
