"""Runs jobs on a thread, one at a time: a new job replaces the one before."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from itertools import count

from workbench.authoring.problem import Problem, shorten
from workbench.machine.processes.watched_thread import report_failure, watched_thread


@dataclass(frozen=True)
class JobProgress:
    """Progress of a background job."""

    what: str
    done: int
    total: int


class Stopped(Exception):
    """The job was stopped."""


class JobFailed(Exception):
    """The job failed. The text is for the page; `problem` is what the author's code raised, if it did."""

    def __init__(self, why: str, problem: Problem | None = None) -> None:
        super().__init__(why)
        self.problem = problem


class ProcessDied(JobFailed):
    """The process that worked on it is gone; the next question starts another."""


class Job:
    """One piece of work. It calls `check` often, which raises once the job is stopped: a thread cannot be ended."""

    _numbers = count(1)

    def __init__(self, lane: JobLane, what: str, work: Callable[[Job], None]) -> None:
        self._job_lane, self._what, self.work = lane, what, work
        self.number = next(self._numbers)
        """Higher for a job that begins later, across all lanes."""
        self.stopped = False
        self.progress = JobProgress(what, 0, 0)

    @property
    def closing(self) -> bool:
        """Whether the lane is closing."""
        return self._job_lane.closing

    def check(self) -> None:
        """Raise Stopped if the job was stopped."""
        if self.stopped:
            raise Stopped

    def report(self, done: int, total: int, what: str = "") -> None:
        """Report progress."""
        self.progress = JobProgress(what or self._what, done, total)
        self._job_lane.changed()


class JobLane:
    """A thread that runs one job at a time. Thread-safe."""

    def __init__(
        self, name: str, on_change: Callable[[], None], on_failure: Callable[[Job, JobFailed], None]
    ) -> None:
        """
        Args:
            on_change: called when `progress` has changed.
            on_failure: called with a job that failed, by JobFailed or any other exception; it may be a stopped one.
        """
        self._name, self.changed, self._on_failure = name, on_change, on_failure
        self._wake = threading.Condition()
        self._waiting: Job | None = None
        self._job: Job | None = None
        self.closing = False
        self._thread: threading.Thread | None = None

    @property
    def progress(self) -> JobProgress | None:
        """Of the job that runs or waits; None for neither."""
        with self._wake:
            job = self._waiting or self._job
            return None if job is None or job.stopped else job.progress

    def start(self, what: str, work: Callable[[Job], None]) -> None:
        """Run this job; the previous one is stopped."""
        with self._wake:
            if self.closing:
                return
            self._stop()
            self._waiting = Job(self, what, work)
            self._wake.notify_all()
            if self._thread is None:
                self._thread = watched_thread(self._name, self._run)
                self._thread.start()
        self.changed()

    def stop(self) -> None:
        """Stop the job, without a callback."""
        with self._wake:
            self._stop()

    def close(self) -> None:
        """Stop, and join the thread."""
        with self._wake:
            self.closing = True
            self._stop()
            self._wake.notify_all()
            thread = self._thread
        if thread is not None:
            thread.join()

    def _stop(self) -> None:
        self._waiting = None
        if self._job is not None:
            self._job.stopped = True

    def _run(self) -> None:
        while (job := self._next()) is not None:
            try:
                job.work(job)
            except Stopped:
                pass
            except JobFailed as failure:
                self._on_failure(job, failure)
            except Exception as error:
                # A fault of the workbench. The page must see that the job is over.
                report_failure(f"The job '{job.progress.what}' failed", error)
                why = f"it failed within the workbench ({type(error).__name__}: {shorten(str(error))})"
                self._on_failure(job, JobFailed(why))
            finally:
                with self._wake:
                    self._job = None
                self.changed()

    def _next(self) -> Job | None:
        with self._wake:
            self._wake.wait_for(lambda: self._waiting is not None or self.closing)
            if self.closing:
                return None
            self._job, self._waiting = self._waiting, None
            return self._job
