"""Commands of the recordings that are open in the review."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from workbench.page.command import Command


class NextRecording(Command, frozen=True):
    """Next recording."""

    key = "n"
    context = "review"
    repeats = True


class PreviousRecording(Command, frozen=True):
    """Previous recording."""

    key = "p"
    context = "review"
    repeats = True


class SelectRecording(Command, frozen=True):
    """Select this open recording."""

    id: str


class CloseRecording(Command, frozen=True):
    """Close this open recording."""

    id: str


class ToggleOverlaid(Command, frozen=True):
    """Switch between overlaid and side by side."""

    key = "o"
    context = "review"


class RescoreChosen(Command, frozen=True):
    """Rescore the selected recordings, or the open ones."""

    key = "j"
    context = "review"


class ContinueLive(Command, frozen=True):
    """Continue live from here."""

    key = "shift+g"
    context = "review"


class ShowSweepPoint(Command, frozen=True):
    """Show the episodes of this point of a sweep."""

    index: int


class SortSweep(Command, frozen=True):
    """Sort the points of a sweep by a column; the same column again reverses the order."""

    column: str


class FilterSweep(Command, frozen=True):
    """Add or remove a filter: list only the points of a sweep with this value of a setting."""

    name: str
    value: str


class ClearSweepFilter(Command, frozen=True):
    """List all points of a sweep."""


class OpenSweepEpisode(Command, frozen=True):
    """Watch this episode of a sweep."""

    id: str


class TurnSweep(Command, frozen=True):
    """Show the next (1) or the previous (-1) points of a sweep."""

    by: int


class ChoosePlaybackSpeed(Command, frozen=True):
    """Play the recordings at this multiple of real time."""

    speed: Annotated[float, msgspec.Meta(gt=0, lt=1000)]


class LoopPlayback(Command, frozen=True):
    """Play the recordings in a loop, or once."""

    on: bool


class OpenAgain(Command, frozen=True):
    """Retry the recordings that could not be opened: the first try may have timed out."""


class ArrangeRecordings(Command, frozen=True):
    """Draw the open recordings overlaid or side by side."""

    layout: Literal["overlaid", "side by side"]


class AlignRecordings(Command, frozen=True):
    """Align the open recordings at their starts, or at the first event of this name."""

    at: str


class CompareWith(Command, frozen=True):
    """Compare the first of the open recordings with this one."""

    index: Annotated[int, msgspec.Meta(ge=1)]


class SwapWithFirst(Command, frozen=True):
    """Swap the first of the open recordings with this one."""

    index: Annotated[int, msgspec.Meta(ge=1)]


class ChooseTolerance(Command, frozen=True):
    """Set the distance, in metres, from which a body counts as different between two recordings."""

    metres: Annotated[float, msgspec.Meta(gt=0)]


class ChooseReviewCurve(Command, frozen=True):
    """Plot this entry of the recordings below their reward."""

    curve: str


class RescoreOpen(Command, frozen=True):
    """Rescore the open recordings."""


class ChooseRescoreCode(Command, frozen=True):
    """Choose the code that recordings are rescored with."""

    code: str


class RestoreRecordedStates(Command, frozen=True):
    """Restore the recorded state after every rescored step, or let the bodies move by themselves."""

    on: bool


class ChooseLiveCode(Command, frozen=True):
    """Continue recordings live with the current code of their task, or with the recorded code."""

    code: Literal["today's", "as recorded"]


class ChooseLiveEnvs(Command, frozen=True):
    """Continue recordings live in the selected env, or in all envs."""

    envs: Literal["the selected env", "all envs"]


class ReturnToFirstTask(Command, frozen=True):
    """Go back to the first task, and close the one that was opened for a recording."""
