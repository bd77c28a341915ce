"""State of rescoring the history or recordings, and its changes by events."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Literal

from workbench.live.effects import Asked
from workbench.live.events import FileSaved, VersionLoaded
from workbench.live.messages import Load
from workbench.live.process.background_jobs import StoppedBy
from workbench.live.run import PastAfterLoad, Run
from workbench.live.timeline_commands import StopRescoring
from workbench.page.command import Command, Refused
from workbench.rescore.past_scores import RescoredCurve, RescoredPast
from workbench.rescore.verdict import Verdict
from workbench.task.problem import Problem

DOES: frozenset[type[Command]] = frozenset({StopRescoring})
"""Commands that `apply` handles."""


RescoreState = Literal["none", "asking", "loading", "rescoring", "done", "stopped", "failed"]
RUNNING: tuple[RescoreState, ...] = ("asking", "loading", "rescoring")


@dataclass(frozen=True)
class RescoreView:
    """State and results of the last rescoring job."""

    state: RescoreState = "none"
    """``asking``: waiting for permission to run the code; ``loading``: the recordings are read, or the code
    is loaded in the background process."""
    serial: int = 0
    """Grows with every change."""
    verdicts: tuple[Verdict[Any], ...] = ()
    """Verdicts so far, including those of partly rescored runs."""
    done: int = 0
    total: int = 0
    unit: str = "steps"
    """Unit of `done` and `total`: ``steps`` (control steps of the batch) or ``episodes``."""
    steps: int = 0
    """Number of control steps that were rescored so far."""
    seconds: float = 0.0
    """Time in seconds that rescoring took so far, without loading."""
    task: str = ""
    """Name of the code that rescores."""
    stopped_by: StoppedBy | None = None
    why: str = ""
    """Reason why the job stopped or failed."""
    problem: Problem | None = None
    """Exception of the code."""
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    """Warnings as sentences: state that could not be restored, modules that a library of the same name hides."""
    names: tuple[str, ...] = ()
    """Names for `RescoredPast.curve`: ``reward`` first, then the numbers that differ, then the others."""
    differing_names: frozenset[str] = frozenset()

    @property
    def rate(self) -> float:
        """Control steps per second; 0 while unknown."""
        return self.steps / self.seconds if self.seconds > 0.5 else 0.0


@dataclass(frozen=True)
class Rescoring:
    """The running or the last job, which rescores the history or recordings."""

    view: RescoreView = RescoreView()
    past: RescoredPast | None = field(default=None, compare=False)
    """Scores of the history, modified in place; None for recordings."""
    job: int = 0
    """Number of the job."""

    @property
    def running(self) -> bool:
        return self.view.state in RUNNING

    def begun(self, view: RescoreView, past: RescoredPast | None = None) -> Rescoring:
        """The state when the next job begins, with this view."""
        return replace(self, past=past, job=self.job + 1).shows(view)

    def shows(self, view: RescoreView) -> Rescoring:
        """The same job with another view."""
        return replace(self, view=replace(view, serial=self.view.serial + 1))

    def curve(self, name: str, env: int) -> RescoredCurve | None:
        """Result of `RescoredPast.curve`; None before the first job, and for recordings. Called on the
        loop."""
        return None if self.past is None else self.past.curve(name, env)


# --- events and effects -----------------------------------------------------------------------------


@dataclass(frozen=True)
class RescoringUpdate:
    """New state and results of a job."""

    job: int
    view: RescoreView
    """The new view; its serial is ignored."""


@dataclass(frozen=True)
class BeginRescoring:
    """Begin this job, which rescores the history; cancel the previous job."""

    job: int
    view: RescoreView
    load: Load
    """The new code."""
    past: RescoredPast = field(compare=False)


@dataclass(frozen=True)
class EndRescoring:
    """Cancel the job and free its moments; the results so far stay."""


RescoreEffect = BeginRescoring | EndRescoring
Change = tuple[Rescoring, list[RescoreEffect]]


# --- apply ------------------------------------------------------------------------------------------


def apply_to_job(rescoring: Rescoring, event: object) -> Change:
    """The next state after a command or a job's message, and the effects to carry out.

    Raises:
        Refused: the command is not possible now; nothing has changed.
    """
    match event:
        case Asked(command=StopRescoring()):
            if not rescoring.running:
                raise Refused("Nothing is being rescored.")
            return _stop(rescoring, StoppedBy.USER)
        case RescoringUpdate(job=rescoring.job, view=view) if rescoring.running:
            return rescoring.shows(view), []
    return rescoring, []


def apply(rescoring: Rescoring, event: object, before: Run, run: Run) -> Change:
    """The next state of rescoring the history after an event, and the effects to carry out.

    Args:
        before: the run before the event.
        run: the run after the event.

    Raises:
        Refused: the command is not possible now; nothing has changed.
    """
    match event:
        case FileSaved() if rescoring.running:
            return _stop(rescoring, StoppedBy.SAVE)
        case VersionLoaded():
            what_to_do = rescore_after_load(run.after_load, rescoring.view)
            if what_to_do == "forget" and rescoring.past is not None:
                return replace(rescoring, past=None).shows(RescoreView()), [EndRescoring()]
            if what_to_do == "rescore":
                return _begin(rescoring, before, run)
    return apply_to_job(rescoring, event)


def rescore_after_load(past: PastAfterLoad, view: RescoreView) -> Literal["rescore", "keep", "forget"]:
    """Decide whether to rescore the history with the loaded version, keep the last results, or forget them.

    Args:
        past: effect of the load on the history.
    """
    if past == "patched":
        return "rescore"
    if past == "same":
        # Saved again without a relevant change: restart the job that the save stopped.
        return "rescore" if view.stopped_by is StoppedBy.SAVE else "keep"
    return "forget"


def _begin(rescoring: Rescoring, before: Run, run: Run) -> Change:
    load = run.running_load()
    if before.past is None or load is None:
        return rescoring, []
    has_reward = any(task is not None and task.reward_mode != "none" for task in (before.task, run.task))
    past = RescoredPast(before.past.history, before.past.at, has_reward)
    if past.steps == 0:
        return rescoring, []
    begun = rescoring.begun(RescoreView("loading", total=past.steps, task="the new code"), past)
    return begun, [BeginRescoring(begun.job, begun.view, load, past)]


def _stop(rescoring: Rescoring, why: StoppedBy) -> Change:
    view = replace(rescoring.view, state="stopped", stopped_by=why, why=why.value)
    return rescoring.shows(view), [EndRescoring()]
