"""Recordings that are open in the review."""

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
    """Select this one of the open recordings."""

    id: str


class CloseRecording(Command, frozen=True):
    """Close this one of the open recordings."""

    id: str


class ToggleOverlaid(Command, frozen=True):
    """Overlaid or side by side."""

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
    """Sort the points of a sweep by a column; by the same again in reverse order."""

    column: str


class FilterSweep(Command, frozen=True):
    """List the points of a sweep with this value of a setting, or no longer."""

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
    """Play the recordings round and round, or once."""

    on: bool


class OpenAgain(Command, frozen=True):
    """Read once more what could not be opened: it may only have taken too long."""


class ArrangeRecordings(Command, frozen=True):
    """Draw the open recordings over each other, or side by side."""

    layout: Literal["overlaid", "side by side"]


class AlignRecordings(Command, frozen=True):
    """Align the open recordings at their starts, or at the first event of a name."""

    at: str


class CompareWith(Command, frozen=True):
    """Compare the first of the open recordings with this one."""

    index: Annotated[int, msgspec.Meta(ge=1)]


class SwapWithFirst(Command, frozen=True):
    """Swap the first of the open recordings with this one."""

    index: Annotated[int, msgspec.Meta(ge=1)]


class ChooseTolerance(Command, frozen=True):
    """Count a body of two recordings as different where it is further apart than this."""

    metres: Annotated[float, msgspec.Meta(gt=0)]


class ChooseReviewCurve(Command, frozen=True):
    """Draw this entry of the recordings below their reward."""

    curve: str


class RescoreOpen(Command, frozen=True):
    """Rescore the open recordings."""


class ChooseRescoreCode(Command, frozen=True):
    """Rescore recordings with this one of the listed codes."""

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
