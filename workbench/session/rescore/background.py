"""A rescoring job in the background, and what the page reads of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Any, Literal

from workbench.authoring.problem import Problem
from workbench.jobs.rescore.verdict import Verdict
from workbench.session.process.held_view import HeldView
from workbench.session.process.job_lane import Job, JobFailed, JobLane


class StoppedBy(Enum):
    """Why a job ended early; the value is the page's text."""

    HAND = "stopped by hand"
    SAVE = "the file was saved again"
    LOAD = "another version was loaded"
    LOSS = "the episodes are gone"
    CLOSING = "closing"


RescoreState = Literal["none", "asking", "loading", "rescoring", "done", "stopped", "failed"]
RUNNING: tuple[RescoreState, ...] = ("asking", "loading", "rescoring")


@dataclass(frozen=True)
class RescoreView:
    """State and results of the last rescoring job."""

    state: RescoreState = "none"
    """``asking`` whether the code may run; ``loading`` it in the background process."""
    serial: int = 0
    """Grows with every change."""
    verdicts: tuple[Verdict[Any], ...] = ()
    """Results so far, also of runs that are rescored in part."""
    done: int = 0
    total: int = 0
    unit: str = "steps"
    """Unit of `done` and `total`: control ``steps`` of the batch, or ``episodes``."""
    steps: int = 0
    """Control steps made so far."""
    seconds: float = 0.0
    """Time for them, without loading."""
    task: str = ""
    """The code that rescores."""
    stopped_by: StoppedBy | None = None
    why: str = ""
    """Why it stopped or failed, as text."""
    problem: Problem | None = None
    """What the code raised."""
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    """A sentence each: state that could not be restored, modules that a library's name hides."""
    names: tuple[str, ...] = ()
    """Names for `RescoredPast.curve`: ``reward`` first, then what differs, then the rest."""
    differing_names: frozenset[str] = frozenset()

    @property
    def rate(self) -> float:
        """Control steps a second; 0 while unknown."""
        return self.steps / self.seconds if self.seconds > 0.5 else 0.0


class Rescoring:
    """Runs one job at a time; a new one replaces the one before. All methods but `close` return at once."""

    def __init__(self, name: str, on_change: Callable[[], None] = lambda: None) -> None:
        """
        Args:
            name: of the thread.
            on_change: called when `view` has changed.
        """
        self._held = HeldView(RescoreView(), on_change)
        self._job_lane = JobLane(name, on_change, self._failed)

    @property
    def view(self) -> RescoreView:
        return self._held.now

    def begin(self, view: RescoreView, work: Callable[[Job], None]) -> None:
        """Start `work`, cancelling the job before; `view` is shown first."""

        def run(job: Job) -> None:
            work(job)
            self.update(job, state="done")

        with self._held.lock:
            self._job_lane.start("rescoring", run)
            self._held.put(view)
        self._held.changed()

    def update(self, job: Job, **values: Any) -> None:
        """Change fields of `view`, unless the job was stopped."""
        self._held.update(job, **values)

    def stop(self, why: StoppedBy = StoppedBy.HAND) -> None:
        """Cancel the running job; results so far stay."""
        with self._held.lock:
            self._job_lane.stop()
            if self._held.now.state not in RUNNING:
                return
            self._held.set(state="stopped", stopped_by=why, why=why.value)
        self._held.changed()

    def forget(self) -> None:
        """Cancel the running job and clear the view."""
        self.stop(StoppedBy.LOSS)
        with self._held.lock:
            self._held.put(RescoreView())
        self._held.changed()

    def close(self) -> None:
        """Stop; returns when the thread has ended."""
        self.stop(StoppedBy.CLOSING)
        self._job_lane.close()

    def _failed(self, job: Job, failure: JobFailed) -> None:
        self.update(job, state="failed", why=str(failure), problem=failure.problem)
