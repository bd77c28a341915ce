"""Commands of the table of recordings."""

from __future__ import annotations

from typing import Literal

from workbench.page.command import Command


class PressRow(Command, frozen=True):
    """Select a recording; ctrl adds or removes it, shift selects the range up to it."""

    id: str
    held: Literal["", "ctrl", "shift", "ctrl+shift"] = ""


class OpenRow(Command, frozen=True):
    """Open this recording."""

    id: str


class NextRow(Command, frozen=True):
    """Next recording in the table."""

    key = "arrowdown"
    context = "library"
    repeats = True


class PreviousRow(Command, frozen=True):
    """Previous recording in the table."""

    key = "arrowup"
    context = "library"
    repeats = True


class AlsoNextRow(Command, frozen=True):
    """Also select the next recording."""

    key = "shift+arrowdown"
    context = "library"
    repeats = True


class AlsoPreviousRow(Command, frozen=True):
    """Also select the previous recording."""

    key = "shift+arrowup"
    context = "library"
    repeats = True


class NextRows(Command, frozen=True):
    """Next page of recordings."""

    key = "pagedown"
    context = "library"
    repeats = True


class PreviousRows(Command, frozen=True):
    """Previous page of recordings."""

    key = "pageup"
    context = "library"
    repeats = True


class ToggleRow(Command, frozen=True):
    """Select or deselect this recording."""

    key = "x"
    context = "library"


class SelectAllRows(Command, frozen=True):
    """Select all listed recordings."""

    key = "ctrl+a"
    context = "library"


class SelectNoRows(Command, frozen=True):
    """Select no recording."""


class OpenSelected(Command, frozen=True):
    """Open the selected recordings."""

    key = "enter"
    context = "library"


class TagSelected(Command, frozen=True):
    """Tag the selected recordings."""

    key = "t"
    context = "library"


class NoteSelected(Command, frozen=True):
    """Edit the note of the selected recordings."""

    key = "shift+t"
    context = "library"


class DeleteSelected(Command, frozen=True):
    """Delete the selected recordings."""

    key = "delete"
    context = "library"


class OpenSideBySide(Command, frozen=True):
    """Open the selected recordings side by side."""

    key = "shift+enter"
    context = "library"


class RescoreSelected(Command, frozen=True):
    """Run the current reward and evaluate over the selected recordings."""


class UndoDelete(Command, frozen=True):
    """Undo the last deletion."""

    key = "z"
    context = "library"


class EmptyTrash(Command, frozen=True):
    """Empty the trash."""


class SortRows(Command, frozen=True):
    """Sort the table of recordings by a column; the same column again reverses the order."""

    column: Literal["task", "date", "seed", "steps", "return", "success", "version", "tags", "note", "name"]


class FilterRows(Command, frozen=True):
    """List only the recordings with this outcome."""

    outcome: Literal["all", "success", "no success", "broken"]


class ClearRowFilter(Command, frozen=True):
    """Show all recordings again."""

    key = "escape"
    context = "library"


class LookForRows(Command, frozen=True):
    """List only the recordings that contain all of these words."""

    words: str


class FilterTask(Command, frozen=True):
    """List only the recordings of this task; null lists those of all tasks."""

    task: str | None
