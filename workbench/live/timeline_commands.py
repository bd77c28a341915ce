"""Commands that move through the history of the run and the steps of recordings, and commands of rescored runs."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from workbench.page.command import Command


class StepBack(Command, frozen=True):
    """One step back."""

    key = "arrowleft"
    repeats = True


class StepForward(Command, frozen=True):
    """One step forward."""

    key = "arrowright"
    repeats = True


class PreviousEvent(Command, frozen=True):
    """Previous event."""

    key = "shift+arrowleft"
    repeats = True


class NextEvent(Command, frozen=True):
    """Next event."""

    key = "shift+arrowright"
    repeats = True


class GoToFirst(Command, frozen=True):
    """Go to the first moment."""

    key = "home"


class GoToLast(Command, frozen=True):
    """Go to live, or to the last moment of a recording."""

    key = "end"


class Seek(Command, frozen=True):
    """Show the state after this control step of the run or of the aligned recordings."""

    step: int
    episode_only: bool = False
    """Look for the step only in the shown episode of the selected env. The step at which an episode
    begins has the same number as the last step of the previous episode."""


class SeekBack(Command, frozen=True):
    """Show the state this many steps before the newest: -37; 0 is live."""

    steps: Annotated[int, msgspec.Meta(le=0)]


class SeekOnCurve(Command, frozen=True):
    """Show the state after this control step of the episode, which was clicked on a curve."""

    step: int


class UndoReset(Command, frozen=True):
    """Undo the last reset or rewind."""

    key = "shift+u"
    context = "live"


class ContinueFromHere(Command, frozen=True):
    """Continue from here, in the selected env."""

    key = "shift+g"
    context = "live"
    scope: Literal["this", "all", "into all"] = "this"
    """``this``: the selected env from its shown state; ``all``: each env from its own shown state;
    ``into all``: all envs from the shown state of the selected env."""


class ChooseStripCurve(Command, frozen=True):
    """Draw this entry on the strip."""

    curve: str


class ZoomTimeline(Command, frozen=True):
    """Show only this episode on the timeline, or the whole history."""

    episode_only: bool


class NextDifference(Command, frozen=True):
    """Next episode with a different result."""

    key = "j"
    context = "live"


class PreviousDifference(Command, frozen=True):
    """Previous episode with a different result."""

    key = "shift+j"
    context = "live"


class ShowRescored(Command, frozen=True):
    """Go to a run in the list of rescored runs."""

    run: str


class TurnRescored(Command, frozen=True):
    """Show the next (1) or the previous (-1) rows of the list of rescored runs."""

    by: int


class StopRescoring(Command, frozen=True):
    """Stop rescoring; results so far stay."""


class ChooseRescoredCurve(Command, frozen=True):
    """Plot this quantity of the history, as recorded and with the new code."""

    curve: str
