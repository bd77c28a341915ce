"""Times a control step of the running version in the background process."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from workbench.authoring.problem import Problem
from workbench.checks.results import StepProfile
from workbench.session.checks.checks import load_version
from workbench.session.process.askers import Background
from workbench.session.process.held_view import HeldView
from workbench.session.process.job_lane import Job, JobFailed, JobLane
from workbench.session.protocol.messages import Load
from workbench.session.protocol.questions import ProfileStep

ProfileState = Literal["none", "running", "done", "stopped", "failed"]


@dataclass(frozen=True)
class ProfileView:
    """The last profile of a step."""

    state: ProfileState = "none"
    serial: int = 0
    """Grows with every change."""
    profile: StepProfile | None = None
    """The last that was made; of an earlier version if `stale`."""
    stale: bool = False
    """Another version runs since."""
    why: str = ""
    """Why it failed, as text."""
    problem: Problem | None = None
    """What the code raised."""


class StepProfiler:
    """Makes one profile at a time; a person waits for it. All methods but `close` return at once."""

    def __init__(self, on_change: Callable[[], None], process: Background) -> None:
        """
        Args:
            on_change: called when `view` has changed.
            process: where it runs.
        """
        self._process = process
        self._held = HeldView(ProfileView(), on_change)
        self._lane = JobLane("profile", on_change, self._failed)

    @property
    def view(self) -> ProfileView:
        return self._held.now

    def profile(self, load: Load) -> None:
        """Time a step of this version."""
        with self._held.lock:
            self._lane.start("profile", lambda job: self._profile(job, load))
            self._held.set(state="running", why="", problem=None)
        self._held.changed()

    def loaded(self) -> None:
        """Another version runs: a running profile ends, and the last one is of an earlier version."""
        with self._held.lock:
            self._lane.stop()
            stopped = self._held.now.state == "running"
            self._held.set(
                state="stopped" if stopped else self._held.now.state, stale=self._held.now.profile is not None
            )
        self._held.changed()

    def stop(self) -> None:
        """End a running profile."""
        with self._held.lock:
            self._lane.stop()
            if self._held.now.state != "running":
                return
            self._held.set(state="stopped")
        self._held.changed()

    def close(self) -> None:
        """Stop; returns when the thread has ended."""
        self.stop()
        self._lane.close()

    def _profile(self, job: Job, load: Load) -> None:
        def ask() -> StepProfile:
            load_version(self._process, job, load)
            return self._process.ask(job.check, ProfileStep())

        self._held.update(job, state="done", profile=self._process.in_turns(job, ask), stale=False)

    def _failed(self, job: Job, failure: JobFailed) -> None:
        self._held.update(job, state="failed", why=str(failure), problem=failure.problem)
