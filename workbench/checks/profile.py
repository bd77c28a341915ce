"""Times a control step of the running version in the background process."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

from workbench.checks.commands import StopProfile, TimeStep
from workbench.checks.questions import ProfileStep
from workbench.checks.results import StepProfile
from workbench.checks.state import load_version
from workbench.live.effects import Asked
from workbench.live.events import VersionLoaded
from workbench.live.messages import Load
from workbench.live.process.ask import Background
from workbench.live.process.background_jobs import Job, JobFailed, Jobs
from workbench.live.run import Run
from workbench.machine.loop import do
from workbench.page.command import Command, Refused
from workbench.task.problem import Problem

DOES: frozenset[type[Command]] = frozenset({TimeStep, StopProfile})
"""Commands that `apply` handles."""
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
    """Whether another version has been loaded since."""
    why: str = ""
    """Why the profile failed, as text."""
    problem: Problem | None = None
    """The error that the author's code raised."""


# --- events and effects -----------------------------------------------------------------------------


@dataclass(frozen=True)
class StepTimed:
    """The job has its result."""

    profile: StepProfile


@dataclass(frozen=True)
class ProfileFailed:
    """The job failed."""

    why: str
    problem: Problem | None


@dataclass(frozen=True)
class BeginProfile:
    """Time a step of this version; a running job is stopped."""

    load: Load


@dataclass(frozen=True)
class EndProfile:
    """Stop the job."""


ProfileEvent = StepTimed | ProfileFailed
ProfileEffect = BeginProfile | EndProfile


def apply(view: ProfileView, event: object, run: Run) -> tuple[ProfileView, list[ProfileEffect]]:
    """The profile after an event, and the effects to perform.

    Args:
        run: the run after the event.

    Raises:
        Refused: the command makes no sense now.
    """
    running = view.state == "running"
    match event:
        case Asked(command=TimeStep()):
            if (load := run.running_load()) is None:
                raise Refused("No task is loaded yet.")
            return _changed(view, state="running", why="", problem=None), [BeginProfile(load)]
        case Asked(command=StopProfile()) if running:
            return _changed(view, state="stopped"), [EndProfile()]
        case VersionLoaded():
            state = "stopped" if running else view.state
            stale = view.profile is not None
            return _changed(view, state=state, stale=stale), [EndProfile()] if running else []
        case StepTimed(profile=profile) if running:
            return _changed(view, state="done", profile=profile, stale=False), []
        case ProfileFailed(why=why, problem=problem) if running:
            return _changed(view, state="failed", why=why, problem=problem), []
    return view, []


def _changed(view: ProfileView, **values: Any) -> ProfileView:
    return replace(view, serial=view.serial + 1, **values)


class ProfileJobs:
    """Performs the effects: one job at a time, at the priority of jobs that a person waits for. Used on the
    loop, except `close`."""

    def __init__(self, process: Background, dispatch: Callable[[ProfileEvent], object]) -> None:
        """
        Args:
            process: the background process in which a job runs.
            dispatch: handles the events of a job.
        """
        self._process, self._dispatch = process, dispatch
        self._jobs = Jobs(lambda: None, self._failed)

    def perform(self, effect: ProfileEffect) -> None:
        match effect:
            case BeginProfile(load=load):
                self._jobs.start("profile", lambda job: self._profile(job, load))
            case EndProfile():
                self._jobs.stop()

    def close(self) -> None:
        """Stop, and begin no more profiles. Called on any thread."""
        do(self._jobs.close)

    async def _profile(self, job: Job, load: Load) -> None:
        async def ask() -> StepProfile:
            await load_version(self._process, job, load)
            return await self._process.ask(ProfileStep())

        self._dispatch(StepTimed(await self._process.in_turns(job, ask)))

    def _failed(self, failure: JobFailed) -> None:
        self._dispatch(ProfileFailed(str(failure), failure.problem))
