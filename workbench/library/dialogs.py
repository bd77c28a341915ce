"""Dialogs of the library for tags, notes and deletion."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import viser

from workbench.episodes.row import MAX_NOTE_CHARACTERS, LibraryRow, clean_tags
from workbench.library.folder import Library, LibraryError
from workbench.library.rows import in_words
from workbench.machine.loop import BlockingPool, begin
from workbench.machine.processes.watched_thread import report_failure
from workbench.page.commands import AnswerDialog, CloseDialog, TypeAnswer
from workbench.page.widgets.dialog import Dialog
from workbench.page.widgets.fields import Field
from workbench.page.widgets.notices import notify_all
from workbench.page.widgets.templates import counted, render, size
from workbench.page.widgets.tools import Tool, tools_html

MAX_NAMES = 6


MAX_LISTED_TAGS = 12
"""Maximum number of tags in use that the dialog lists."""


@dataclass(frozen=True)
class _Question:
    """A question in a dialog, with the text typed so far."""

    dialog: Dialog
    answered: Callable[[str], object]
    """Performs the operation with the typed text; blocks. Raises LibraryError."""
    typed: str


class LibraryEdits:
    """Dialogs for tags, notes and deletion, and their operations; one dialog at a time. Used on the loop.

    A dialog covers the page, because a form in the scrolled table could be out of view. It edits the
    recordings for which it was opened, even if others are selected when the user answers.
    """

    def __init__(self, server: viser.ViserServer, library: Library) -> None:
        self._server, self._library = server, library
        self._question: _Question | None = None
        self._disk = BlockingPool("library-edits")

    def close(self) -> bool:
        """Close the dialog; returns False if there is none."""
        return self._question is not None and self._question.dialog.close()

    def end(self) -> None:
        """Close the dialog, and end the thread when the requested edits are done."""
        self.close()
        self._disk.end()

    def ask_tags(self, ids: tuple[str, ...]) -> None:
        rows = self._rows(ids)
        if not rows:
            return
        shared = [tag for tag in rows[0].tags if all(tag in row.tags for row in rows)]

        def answered(typed: str) -> None:
            tags = clean_tags(typed.split(","))
            removed = [tag for tag in shared if tag not in tags]
            self._library.set_tags(ids, [tag for tag in tags if tag not in shared], removed)

        known = sorted({tag for row in self._library.view().rows for tag in row.tags})
        explained = "Words, separated by commas."
        if len(rows) > 1:
            explained += " The field shows the tags that all of these recordings have; their other tags stay."
        if known:
            explained += f" In use: {', '.join(known[:MAX_LISTED_TAGS])}."
        self._ask("Tags", "", rows, explained, "Save", answered, ", ".join(shared))

    def ask_note(self, ids: tuple[str, ...]) -> None:
        rows = self._rows(ids)
        if not rows:
            return
        notes = {row.note for row in rows}
        explained = (
            ""
            if len(notes) == 1
            else "These recordings have different notes; this note replaces all of them."
        )

        def answered(typed: str) -> None:
            self._library.set_note(ids, typed[:MAX_NOTE_CHARACTERS])

        self._ask("Note", "", rows, explained, "Save", answered, notes.pop() if len(notes) == 1 else "")

    def ask_delete(self, ids: tuple[str, ...]) -> None:
        rows = self._rows(ids)
        if not rows:
            return
        try:
            self._library.check_delete(ids)
        except LibraryError as error:
            self._notify(error)
            return
        self._ask(
            "Delete recordings",
            f"Delete {in_words(rows)}?",
            rows,
            "All their files move to the folder .trash in the library and can be restored from there.",
            "Delete",
            lambda _: self._library.delete(ids),
        )

    def ask_empty(self) -> None:
        trash = self._library.view().trash
        self._ask(
            "Empty the trash",
            f"Delete {counted(trash.files, 'file')} ({size(trash.size)}) for good?",
            [],
            "This cannot be undone.",
            "Delete for good",
            lambda _: self._library.empty_trash(),
        )

    def undo_delete(self) -> None:
        begin(self._do(self._library.undo_delete))

    def _ask(
        self,
        title: str,
        asked: str,
        rows: Sequence[LibraryRow],
        explained: str,
        do: str,
        answered: Callable[[str], object],
        value: str | None = None,
    ) -> None:
        """Open a dialog.

        Args:
            do: label of the button that accepts.
            answered: see `_Question`; the text is unchecked.
            value: initial text of the input, in which Enter accepts too. None: no input, and the accept button is red.
        """
        gui, names = self._server.gui, [row.name for row in rows]
        shown = names if len(names) <= MAX_NAMES else names[: MAX_NAMES - 1]
        self.close()
        dialog = Dialog(self._server, title)
        self._question = _Question(dialog, answered, value or "")
        with dialog.modal:
            more = len(names) - len(shown)
            gui.add_html(render("library_question", question=asked, names=shown, more=more, answer=explained))
            if value is not None:
                Field(
                    self._server,
                    "",
                    TypeAnswer,
                    "text",
                    value,
                    live=True,
                    enter=AnswerDialog(),
                    longest=MAX_NOTE_CHARACTERS,
                )
            tone = "danger" if value is None else "main"
            gui.add_html(tools_html([Tool(do, AnswerDialog(), tone=tone), Tool("Cancel", CloseDialog())]))

    def type(self, text: str) -> None:
        """Store the text typed so far."""
        if self._question is not None:
            self._question = replace(self._question, typed=text)

    def answer(self) -> None:
        """Perform the operation; only the first answer counts."""
        question = self._question
        if question is not None and self.close():
            begin(self._do(lambda: question.answered(question.typed)))

    def _rows(self, ids: Sequence[str]) -> list[LibraryRow]:
        rows = (self._library.row(id) for id in ids)
        return [row for row in rows if row is not None]

    async def _do(self, work: Callable[[], object]) -> None:
        """Do the work after all earlier work. A LibraryError is shown on every page."""
        try:
            await self._disk.run(work)
        except LibraryError as error:
            self._notify(error)
        except Exception as error:
            report_failure("An edit of the library failed", error)
            notify_all(
                self._server,
                "Failed",
                "The change to the library failed; the reason is in the terminal.",
                "red",
            )

    def _notify(self, error: LibraryError) -> None:
        notify_all(self._server, "Not possible", str(error), seconds=8.0)
