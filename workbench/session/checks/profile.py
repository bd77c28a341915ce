"""Times a control step of the running version in the background process."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

from workbench.authoring.problem import Problem
from workbench.checks.results import StepProfile
from workbench.session.checks.checks import load_version
from workbench.session.loop import on_loop
from workbench.session.process.askers import Background
from workbench.session.process.jobs import Job, JobFailed, Jobs
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
    """The last profile; of an earlier version if `stale`."""
    stale: bool = False
    """Whether another version runs since."""
    why: str = ""
    """Why the profile failed, as text."""
    problem: Problem | None = None
    """What the code raised."""


class StepProfiler:
    """Makes one profile at a time; a person waits for it. Methods return at once."""

    def __init__(self, on_change: Callable[[], None], process: Background) -> None:
        """
        Args:
            on_change: called when `view` has changed.
            process: where it runs.
        """
        self._process, self._on_change = process, on_change
        self.view = ProfileView()
        self._jobs = Jobs(on_change, self._failed)

    @on_loop
    def profile(self, load: Load) -> None:
        """Time a step of this version."""
        self._jobs.start("profile", lambda job: self._profile(job, load))
        self._set(state="running", why="", problem=None)

    @on_loop
    def loaded(self) -> None:
        """Another version runs: a running profile ends, and the last one is of an earlier version."""
        self.stop()
        self._set(stale=self.view.profile is not None)

    @on_loop
    def stop(self) -> None:
        """End a running profile."""
        self._jobs.stop()
        if self.view.state == "running":
            self._set(state="stopped")

    @on_loop
    def close(self) -> None:
        """Stop, and begin no more profiles."""
        self.stop()
        self._jobs.close()

    async def _profile(self, job: Job, load: Load) -> None:
        async def ask() -> StepProfile:
            await load_version(self._process, job, load)
            return await self._process.ask(ProfileStep())

        self._set(state="done", profile=await self._process.in_turns(job, ask), stale=False)

    def _failed(self, failure: JobFailed) -> None:
        self._set(state="failed", why=str(failure), problem=failure.problem)

    def _set(self, **values: Any) -> None:
        self.view = replace(self.view, serial=self.view.serial + 1, **values)
        self._on_change()
