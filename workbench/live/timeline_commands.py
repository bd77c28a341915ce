"""The past of the run, and the steps of a recording."""

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
    """Show the moment after this control step: of the run, or of the aligned recordings."""

    step: int
    episode_only: bool = False
    """Within the shown episode of the selected env: where it begins there is the last step of the one before, too."""


class SeekBack(Command, frozen=True):
    """Show the moment this many steps before the newest: -37; 0 is live."""

    steps: Annotated[int, msgspec.Meta(le=0)]


class SeekOnCurve(Command, frozen=True):
    """Show the moment after this control step, which was pressed on a curve."""

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
    """The selected env from its moment; all envs, each from its own; or all from the selected one's."""


class ZoomTimeline(Command, frozen=True):
    """Show this episode on the timeline, or all that is kept."""

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
    """Go to a run of the list of rescored ones."""

    run: str


class TurnRescored(Command, frozen=True):
    """Show the next (1) or the previous (-1) rows of the list of rescored runs."""

    by: int


class StopRescoring(Command, frozen=True):
    """Stop rescoring; results so far stay."""


class ChooseRescoredCurve(Command, frozen=True):
    """Plot this number of the history, as recorded and with the new code."""

    curve: str
