"""Jobs one at a time on a thread of their own: a new one takes the place of the one before, and any can be stopped.

A job is a function that asks often whether it is to go on (`Job.check`); so it ends within what it does between two
questions, and nobody ends a thread.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from itertools import count

from workbench.authoring.problem import Problem, shorten
from workbench.machine.processes.watched_thread import report_failure, watched_thread


@dataclass(frozen=True)
class JobProgress:
    """Of work in the background."""

    what: str
    done: int
    total: int


class Stopped(Exception):
    """The job is to go no further."""


class JobFailed(Exception):
    """The job cannot go on; its text is for the reader, and `problem` is what the author's code raised, if it did."""

    def __init__(self, why: str, problem: Problem | None = None) -> None:
        super().__init__(why)
        self.problem = problem


class Job:
    """One piece of work."""

    _numbers = count(1)

    def __init__(self, lane: JobLane, what: str, work: Callable[[Job], None]) -> None:
        self._job_lane, self._what, self.work = lane, what, work
        self.number = next(self._numbers)
        """One that is begun later has a higher one, whatever lane it is on."""
        self.stopped = False
        self.progress = JobProgress(what, 0, 0)

    @property
    def closing(self) -> bool:
        """There is to be no job after it."""
        return self._job_lane.closing

    def check(self) -> None:
        """Raises Stopped where it is to stop."""
        if self.stopped:
            raise Stopped

    def tell(self, done: int, total: int, what: str = "") -> None:
        """How far it is."""
        self.progress = JobProgress(what or self._what, done, total)
        self._job_lane.changed()


class JobLane:
    """See the module's text."""

    def __init__(
        self, name: str, on_change: Callable[[], None], on_failure: Callable[[Job, JobFailed], None]
    ) -> None:
        """
        Args:
            on_change: called when `progress` is new.
            on_failure: called with a job that failed, whether that was foreseen (JobFailed) or not; it may be stopped.
        """
        self._name, self.changed, self._on_failure = name, on_change, on_failure
        self._wake = threading.Condition()
        self._waiting: Job | None = None
        self._job: Job | None = None
        self.closing = False
        self._thread: threading.Thread | None = None

    @property
    def progress(self) -> JobProgress | None:
        """Of the job that is done, or waits to be; None for neither."""
        with self._wake:
            job = self._waiting or self._job
            return None if job is None or job.stopped else job.progress

    def start(self, what: str, work: Callable[[Job], None]) -> None:
        """Do this in place of whatever was done before."""
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
        """Go no further with what is under way. Calls nobody."""
        with self._wake:
            self._stop()

    def close(self) -> None:
        """Stop, and wait for the thread's end."""
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
                # Of the workbench's own. Whoever shows the job must hear that it is over.
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
