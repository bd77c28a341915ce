"""The rescoring of the history with new code, and how each event changes it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

from workbench.authoring.problem import Problem
from workbench.commands.command import Command, Refused
from workbench.commands.timeline import StopRescoring
from workbench.jobs.rescore.verdict import Verdict
from workbench.session.events import Asked
from workbench.session.protocol.messages import Load
from workbench.session.rescore.background import RUNNING, RescoreView, StoppedBy
from workbench.session.rescore.past import PastRun, RescoredCurve, RescoredPast
from workbench.session.run.events import FileSaved, VersionLoaded
from workbench.session.run.run import PastAfterLoad, Run

DOES: frozenset[type[Command]] = frozenset({StopRescoring})
"""Commands that `apply` takes."""


@dataclass(frozen=True)
class PastRescoring:
    """The running or the last job that rescores the history."""

    view: RescoreView = RescoreView()
    past: RescoredPast | None = field(default=None, compare=False)
    """Its scores: a store that is written into in place."""
    job: int = 0
    """Its number."""

    def curve(self, name: str, env: int) -> RescoredCurve | None:
        """The curve of `RescoredPast.curve`; None before the first job. Called on the loop."""
        return None if self.past is None else self.past.curve(name, env)


# --- events and effects -----------------------------------------------------------------------------


@dataclass(frozen=True)
class CodeLoads:
    """The background process loads the new code."""

    job: int


@dataclass(frozen=True)
class RescoreSummary:
    """Verdicts so far, and names as `RescoreView` has them."""

    verdicts: tuple[Verdict[PastRun], ...]
    names: tuple[str, ...]
    differing_names: frozenset[str]


@dataclass(frozen=True)
class MomentsRescored:
    """Some more moments have new scores."""

    job: int
    done: int
    """Control steps that have new scores."""
    seconds: float
    """Seconds that the new ones of them took."""
    not_restored: tuple[tuple[str, str], ...] = ()
    """What of the state could not be restored so far, and why."""
    summary: RescoreSummary | None = None
    """None if the last one still stands."""


@dataclass(frozen=True)
class RescoringDone:
    job: int


@dataclass(frozen=True)
class RescoringFailed:
    job: int
    why: str
    problem: Problem | None
    """What the code raised."""


RescoreEvent = CodeLoads | MomentsRescored | RescoringDone | RescoringFailed
"""What comes of a job."""


@dataclass(frozen=True)
class BeginRescoring:
    """Begin this job; cancel the one before."""

    job: int
    load: Load
    """The new code."""
    past: RescoredPast = field(compare=False)


@dataclass(frozen=True)
class EndRescoring:
    """Cancel the job, and free its moments; results so far stay."""


RescoreEffect = BeginRescoring | EndRescoring
Change = tuple[PastRescoring, list[RescoreEffect]]


# --- apply ------------------------------------------------------------------------------------------


def apply(rescoring: PastRescoring, event: object, before: Run, run: Run) -> Change:
    """The rescoring after an event, and what has to be done.

    Args:
        before: the run before the event.
        run: the run after it.

    Raises:
        Refused: the command makes no sense now; nothing has changed.
    """
    view = rescoring.view
    runs = view.state in RUNNING
    match event:
        case Asked(command=StopRescoring()):
            if not runs:
                raise Refused("Nothing is being rescored.")
            return _stop(rescoring, StoppedBy.HAND)
        case FileSaved() if runs:
            return _stop(rescoring, StoppedBy.SAVE)
        case VersionLoaded():
            what_to_do = rescore_after_load(run.after_load, view)
            if what_to_do == "forget" and rescoring.past is not None:
                return PastRescoring(RescoreView(serial=view.serial + 1), None, rescoring.job), [
                    EndRescoring()
                ]
            if what_to_do == "rescore":
                return _begin(rescoring, before, run)
        case CodeLoads(job=rescoring.job) if runs:
            return replace(rescoring, view=view.changed(state="loading")), []
        case MomentsRescored(job=rescoring.job) if runs:
            return replace(rescoring, view=_rescored(view, event)), []
        case RescoringDone(job=rescoring.job) if runs:
            return replace(rescoring, view=view.changed(state="done")), []
        case RescoringFailed(job=rescoring.job, why=why, problem=problem) if runs:
            return replace(rescoring, view=view.changed(state="failed", why=why, problem=problem)), []
    return rescoring, []


def rescore_after_load(past: PastAfterLoad, view: RescoreView) -> Literal["rescore", "keep", "forget"]:
    """Whether to rescore the history with the loaded version, keep the last results, or forget them with the episodes.

    Args:
        past: what the load means for the history.
    """
    if past == "patched":
        return "rescore"
    if past == "same":
        # Saved again without a relevant change: resume the job that the save stopped.
        return "rescore" if view.stopped_by is StoppedBy.SAVE else "keep"
    return "forget"


def _begin(rescoring: PastRescoring, before: Run, run: Run) -> Change:
    load = run.running_load()
    if before.past is None or load is None:
        return rescoring, []
    has_reward = any(task is not None and task.reward_mode != "none" for task in (before.task, run.task))
    past = RescoredPast(before.past.history, before.past.at, has_reward)
    if past.steps == 0:
        return rescoring, []
    view = RescoreView("loading", serial=rescoring.view.serial + 1, total=past.steps, task="the new code")
    begun = PastRescoring(view, past, rescoring.job + 1)
    return begun, [BeginRescoring(begun.job, load, past)]


def _stop(rescoring: PastRescoring, why: StoppedBy) -> Change:
    return replace(rescoring, view=rescoring.view.stopped(why)), [EndRescoring()]


def _rescored(view: RescoreView, event: MomentsRescored) -> RescoreView:
    summary = event.summary
    if summary is not None:
        view = replace(
            view,
            verdicts=summary.verdicts,
            names=summary.names,
            differing_names=summary.differing_names,
        )
    return view.changed(
        state="rescoring",
        done=event.done,
        steps=event.done,
        seconds=view.seconds + event.seconds,
        warnings=tuple(f"not restored: {what}: {why}" for what, why in event.not_restored),
    )
