"""What the pages themselves do: which one is shown, tabs, folds, the view."""

from __future__ import annotations

from typing import Literal

from workbench.page.command import Command


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
    """The page says which tab it has open."""

    tab: str


class TellUnfolded(Command, frozen=True):
    """The page says that a panel was unfolded."""

    panel: str


class TellDrawnInSoftware(Command, frozen=True):
    """The page says that it draws its view in software."""


class ToggleTable(Command, frozen=True):
    """Open or close the table: of envs, or the library."""

    key = "b"


class FrameScene(Command, frozen=True):
    """Frame the scene."""

    key = "f"


class ToggleTheme(Command, frozen=True):
    """Switch between the dark and the light theme."""

    key = "d"


class CloseHints(Command, frozen=True):
    """Close the hints for good."""


class OpenHelp(Command, frozen=True):
    """Help: open the documents."""


class RenewToken(Command, frozen=True):
    """Renew the token and close every page."""


class CloseDialog(Command, frozen=True):
    """Close what is open over the page."""

    key = "escape"
    context = "dialog"


class TypeAnswer(Command, frozen=True):
    """Type into the question that is open over the page."""

    text: str


class AnswerDialog(Command, frozen=True):
    """Accept what was typed into the question that is open over the page."""

    context = "dialog"


class AnswerTrust(Command, frozen=True):
    """Answer the question whether code may run."""

    question: str
    """Which one: another may be open by the time of the answer."""
    answer: Literal["no", "none", "once", "always"]


class ChooseDetail(Command, frozen=True):
    """Choose how finely shapes are drawn."""

    detail: Literal["fine", "normal", "coarse"]


class ChooseTheme(Command, frozen=True):
    """Choose the dark or the light theme."""

    theme: Literal["dark", "light"]
