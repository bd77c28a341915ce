"""A rescoring job in the background, and what the page reads of it."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any, Literal

from workbench.authoring.problem import Problem
from workbench.jobs.rescore.verdict import Verdict
from workbench.session.loop import on_loop
from workbench.session.process.jobs import Job, JobFailed, Jobs


class StoppedBy(Enum):
    """Why a job ended early; the value is the page's text."""

    HAND = "stopped by hand"
    SAVE = "the file was saved again"
    CLOSING = "closing"


RescoreState = Literal["none", "asking", "loading", "rescoring", "done", "stopped", "failed"]
RUNNING: tuple[RescoreState, ...] = ("asking", "loading", "rescoring")


@dataclass(frozen=True)
class RescoreView:
    """State and results of the last rescoring job."""

    state: RescoreState = "none"
    """``asking``: whether the code may run; ``loading``: the code is loaded in the background process."""
    serial: int = 0
    """Grows with every change."""
    verdicts: tuple[Verdict[Any], ...] = ()
    """Verdicts so far, including runs that are rescored in part."""
    done: int = 0
    total: int = 0
    unit: str = "steps"
    """Unit of `done` and `total`: control ``steps`` of the batch, or ``episodes``."""
    steps: int = 0
    """Control steps made so far."""
    seconds: float = 0.0
    """Seconds that these steps took, without loading."""
    task: str = ""
    """The code that rescores."""
    stopped_by: StoppedBy | None = None
    why: str = ""
    """Why the job stopped or failed, as text."""
    problem: Problem | None = None
    """What the code raised."""
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    """Warnings, a sentence each: state that could not be restored, modules that a library's name hides."""
    names: tuple[str, ...] = ()
    """Names for `RescoredPast.curve`: ``reward`` first, then the numbers that differ, then the others."""
    differing_names: frozenset[str] = frozenset()

    @property
    def rate(self) -> float:
        """Control steps per second; 0 while unknown."""
        return self.steps / self.seconds if self.seconds > 0.5 else 0.0

    def changed(self, **values: Any) -> RescoreView:
        """The next view, with these values."""
        return replace(self, serial=self.serial + 1, **values)

    def stopped(self, why: StoppedBy) -> RescoreView:
        """The view once the job is cancelled; the same if none runs."""
        if self.state not in RUNNING:
            return self
        return self.changed(state="stopped", stopped_by=why, why=why.value)


class Rescoring:
    """Runs one job at a time; a new one replaces the one before. Methods return at once."""

    def __init__(self, on_change: Callable[[], None] = lambda: None) -> None:
        """
        Args:
            on_change: called when `view` has changed.
        """
        self.view = RescoreView()
        self._on_change = on_change
        self._jobs = Jobs(on_change, self._failed)

    @on_loop
    def begin(self, view: RescoreView, work: Callable[[Job], Awaitable[None]]) -> None:
        """Start `work`, cancelling the job before; `view` is shown first."""

        async def run(job: Job) -> None:
            await work(job)
            self.update(state="done")

        self._put(replace(view, serial=self.view.serial + 1))
        self._jobs.start("rescoring", run)

    def update(self, **values: Any) -> None:
        """Change fields of `view`; called by the job."""
        self._put(self.view.changed(**values))

    @on_loop
    def stop(self, why: StoppedBy = StoppedBy.HAND) -> None:
        """Cancel the running job; results so far stay."""
        self._jobs.stop()
        self._put(self.view.stopped(why))

    @on_loop
    def close(self) -> None:
        """Stop the job, and begin no more."""
        self.stop(StoppedBy.CLOSING)
        self._jobs.close()

    def _put(self, view: RescoreView) -> None:
        self.view = view
        self._on_change()

    def _failed(self, failure: JobFailed) -> None:
        self.update(state="failed", why=str(failure), problem=failure.problem)
