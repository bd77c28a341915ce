"""Runs judged again for a page, of the past or of recordings: in the background, with progress, and to be stopped."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any, Literal

from workbench.authoring.problem import Problem
from workbench.jobs.verdict import Verdict
from workbench.session.process.job_lane import Job, JobFailed, JobLane


class StoppedBy(Enum):
    """Why it ended before it was done; the value is what the page says."""

    HAND = "stopped by hand"
    SAVE = "the file was saved again"
    LOAD = "another version was loaded"
    LOSS = "the episodes are gone"
    CLOSING = "closing"


RescoreState = Literal["none", "asking", "loading", "rescoring", "done", "stopped", "failed"]
RUNNING: tuple[RescoreState, ...] = ("asking", "loading", "rescoring")


@dataclass(frozen=True)
class RescoreView:
    state: RescoreState = "none"
    """``asking`` whether the code may run; ``loading``: it is being loaded by the process that judges."""
    serial: int = 0
    """Grows with every change."""
    verdicts: tuple[Verdict[Any], ...] = ()
    """Those that are known, also of a part of a run that is not judged whole."""
    done: int = 0
    total: int = 0
    unit: str = "steps"
    """What is counted: control steps of the batch, or ``episodes``."""
    steps: int = 0
    """Control steps that were made."""
    seconds: float = 0.0
    """That they took, without loading."""
    task: str = ""
    """What is judged with."""
    stopped_by: StoppedBy | None = None
    why: str = ""
    """Why it stopped or failed, in words."""
    problem: Problem | None = None
    """What the code raised."""
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    """A sentence each: what could not be put back, and files beside a task that no import finds."""
    names: tuple[str, ...] = ()
    """What the past has a curve of: ``reward`` first, then what differs, then the rest."""
    differing_names: frozenset[str] = frozenset()

    @property
    def rate(self) -> float:
        """Control steps a second; 0 while that is not known."""
        return self.steps / self.seconds if self.seconds > 0.5 else 0.0


class Rescoring:
    """One job at a time; a new one takes the place of the one before. All methods but `close` return at once."""

    def __init__(self, name: str, on_change: Callable[[], None] = lambda: None) -> None:
        """
        Args:
            name: of the thread that does all of it.
            on_change: called when `view` has something new.
        """
        self._on_change = on_change
        self._lock = threading.Lock()
        """Of `view`: what a job that was stopped still has to say is not heard."""
        self._view = RescoreView()
        self._job_lane = JobLane(name, on_change, self._failed)

    @property
    def view(self) -> RescoreView:
        return self._view

    def begin(self, view: RescoreView, work: Callable[[Job], None]) -> None:
        """Do this in place of what was done before; `view` is what is to be seen first."""

        def whole(job: Job) -> None:
            work(job)
            self.tell(job, state="done")

        with self._lock:
            # Under the lock, or the job might tell how far it is before it is said that it begins.
            self._job_lane.start("rescoring", whole)
            self._view = replace(view, serial=self._view.serial + 1)
        self._on_change()

    def tell(self, job: Job, **values: Any) -> None:
        """What is new in `view`."""
        with self._lock:
            if job.stopped:
                return
            self._view = replace(self._view, serial=self._view.serial + 1, **values)
        self._on_change()

    def stop(self, why: StoppedBy = StoppedBy.HAND) -> None:
        """Go no further with what is under way; what is known by now stays to be seen."""
        with self._lock:
            self._job_lane.stop()
            if self._view.state not in RUNNING:
                return
            stopped = replace(self._view, state="stopped", stopped_by=why, why=why.value)
            self._view = replace(stopped, serial=self._view.serial + 1)
        self._on_change()

    def forget(self) -> None:
        """Stop, and have nothing to show."""
        self.stop(StoppedBy.LOSS)
        with self._lock:
            self._view = RescoreView(serial=self._view.serial + 1)
        self._on_change()

    def close(self) -> None:
        """End it all; returns when the thread has ended."""
        self.stop(StoppedBy.CLOSING)
        self._job_lane.close()

    def _failed(self, job: Job, failure: JobFailed) -> None:
        self.tell(job, state="failed", why=str(failure), problem=failure.problem)
