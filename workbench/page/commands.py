"""Commands of the pages themselves: which page is shown, tabs, folds, dialogs, the view."""

from __future__ import annotations

from typing import Literal

from workbench.page.command import Command

ShownOn = Literal["off", "on this tab", "on all tabs"]
"""Where something is drawn in the view: nowhere, while a page has its tab open, or always."""


class ShowRecordings(Command, frozen=True):
    """Review recordings."""

    key = "v"
    context = "live"


class ShowLive(Command, frozen=True):
    """Back to the live env."""

    key = "v"
    context = "review"


class ShowTab(Command, frozen=True):
    """Open a tab, and a fold in it, on this page."""

    tab: str = ""
    fold: str = ""


class TellOpenTab(Command, frozen=True):
    """Report from the page which tab is open."""

    tab: str


class TellUnfolded(Command, frozen=True):
    """Report from the page that a panel was unfolded."""

    panel: str


class TellDrawnInSoftware(Command, frozen=True):
    """Report from the page that the browser renders the view in software."""


class ToggleTable(Command, frozen=True):
    """Open or close the table of envs, or the library."""

    key = "b"


class ToggleTimeline(Command, frozen=True):
    """Open or close the timeline under the transport, on this page."""

    key = "t"


class FrameScene(Command, frozen=True):
    """Frame the scene."""

    key = "f"


class ShowFrames(Command, frozen=True):
    """Show the frames of the env and of its objects: x red, y green, z blue."""

    on: bool


class ShowCollisions(Command, frozen=True):
    """Show the collision shapes in place of the visuals: robot blue, objects orange, kinematic violet."""

    on: bool


class ShowFrustums(Command, frozen=True):
    """Show or hide the camera frustums with their pictures in the 3D view."""

    on: bool


class ToggleTheme(Command, frozen=True):
    """Switch between the dark and the light theme."""

    key = "d"


class CloseHints(Command, frozen=True):
    """Close the hints for good."""


class OpenHelp(Command, frozen=True):
    """Help: open the documents."""


class OpenInEditor(Command, frozen=True):
    """Open a file of the task in the editor."""

    file: str
    """Absolute path."""


class RenewToken(Command, frozen=True):
    """Renew the token and close every page."""


class CloseDialog(Command, frozen=True):
    """Close the open dialog."""

    key = "escape"
    context = "dialog"


class TypeAnswer(Command, frozen=True):
    """Type into the open dialog."""

    text: str


class AnswerDialog(Command, frozen=True):
    """Accept the text typed into the open dialog."""

    context = "dialog"


class AnswerTrust(Command, frozen=True):
    """Answer whether code may run."""

    question: str
    """Id of the question: another one may be open when the answer arrives."""
    answer: Literal["no", "none", "once", "always"]


class ChooseDetail(Command, frozen=True):
    """Choose the level of detail of shapes."""

    detail: Literal["fine", "normal", "coarse"]


class ChooseTheme(Command, frozen=True):
    """Choose the dark or the light theme."""

    theme: Literal["dark", "light"]
