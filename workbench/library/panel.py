"""The library of recordings as a table: sort, filter, select, open, tag, note, delete."""

from __future__ import annotations

import asyncio
import datetime
import os
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace

import viser

from workbench.episodes.row import LibraryRow
from workbench.library.commands import (
    ClearRowFilter,
    DeleteSelected,
    EmptyTrash,
    FilterRows,
    FilterTask,
    LookForRows,
    NextRows,
    NoteSelected,
    OpenRow,
    OpenSelected,
    PressRow,
    PreviousRows,
    SelectAllRows,
    SelectNoRows,
    SortRows,
    TagSelected,
    UndoDelete,
)
from workbench.library.dialogs import LibraryEdits
from workbench.library.folder import Library, LibraryView
from workbench.library.listing import DOES, Action, LibraryList, Listing, RowArrangement, apply, make_listing
from workbench.library.rows import (
    COLUMNS,
    HINTS,
    MEANS,
    SECOND_LINE,
    Column,
    OpenVersion,
    cells,
    chosen,
    count_recordings,
    has_outcome,
    job_text,
    none_like_that,
)
from workbench.machine.loop import BlockingPool, begin, on_loop, post
from workbench.page.command import Command
from workbench.page.commands import AnswerDialog, TypeAnswer
from workbench.page.widgets.fields import Field, choice
from workbench.page.widgets.modality_colours import address_of_jpeg
from workbench.page.widgets.notices import notify_all
from workbench.page.widgets.parts import PagePart
from workbench.page.widgets.templates import render
from workbench.page.widgets.visitors import Visitor

MAX_JOBS = 6
"""Maximum number of jobs that are shown at once."""
MAX_SIDE_BY_SIDE = 4
"""Maximum number of recordings that a review shows at once."""
ALL_TASKS = "all tasks"
LIST = (*DOES, UndoDelete, EmptyTrash, TypeAnswer, AnswerDialog)
"""Commands of the list itself."""


class LibraryPanel(PagePart[object]):
    """The library's table in the current container; all open pages show the same table.

    A separate style sheet marks the selected rows by their numbers. Each press changes only this style sheet:
    sending the rows with their pictures would take 150 KB. A row keeps its number as long as the page exists,
    so the marks stay on their rows if the table changes meanwhile.

    Thumbnails are read on a separate thread when the rows of the shown page change; rows are shown before their thumbnails.

    Args:
        on_open: gets the ids of one to `MAX_SIDE_BY_SIDE` recordings, in the order of the table.
            Called on the loop, and must not block.
        running: returns the version of the open task; None if no task is open.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        library: Library,
        on_open: Callable[[tuple[str, ...]], None],
        running: Callable[[], OpenVersion | None] = lambda: None,
    ) -> None:
        self._server, self._library, self._running = server, library, running
        self._folder = os.fsencode(library.folder).decode(errors="replace")
        self._list = LibraryList()
        self._listed: Listing | None = None
        """Cache: the last listing."""
        self._edits = LibraryEdits(server, library)
        self._actions: tuple[Action, ...] = (
            Action(
                "Open",
                OpenSelected(),
                "Open in the review (Enter, or double-click)",
                on_open,
                MAX_SIDE_BY_SIDE,
                salvages=True,
            ),
            Action("Tag", TagSelected(), "Add or remove tags (T)", self._edits.ask_tags, reads=False),
            Action("Note", NoteSelected(), "Edit the note (Shift+T)", self._edits.ask_note, reads=False),
            Action(
                "Delete",
                DeleteSelected(),
                "Move the files to the trash (Delete)",
                self._edits.ask_delete,
                reads=False,
            ),
        )
        server.gui.add_html(render("context", context="library"))
        self._jobs = server.gui.add_html("", visible=False)
        self._filters = server.gui.add_html("")
        self._find = Field(
            server,
            "Find",
            LookForRows,
            "words",
            hint="Words to find in task, tags, note, name or version; seed:3 for a seed",
            live=True,
        )
        self._tasks = choice(server, "Task", FilterTask, "task", {ALL_TASKS: None}, None)
        self._tasks.visible = False
        self._tools = server.gui.add_html("")
        self._marks = server.gui.add_html("")
        self._table = server.gui.add_html("")
        self._trash = server.gui.add_html("")

        self._disk = BlockingPool("thumbnails")
        self._reading: asyncio.Task[None] | None = None
        self._pictured: tuple[LibraryRow, ...] = ()
        """Rows whose thumbnails are being read or were read last."""
        self._thumbnails: Mapping[str, bytes | None] = {}
        """JPEGs by row id; None for a recording without a JPEG. An id is missing until its thumbnail is
        read."""
        library.on_change.add(self._library_changed)
        self._library_changed()

        self._number_of: dict[str, int] = {}
        """Number of each recording's row, from 1, in order of arrival."""
        self._drawn: object = None
        self._jobs_drawn: object = None
        self._filters_drawn: object = None
        """Key of the data for which the rows of each filter were counted; counting thousands of rows takes
        long."""
        self._table_drawn: object = None

    # --- interface for the page ------------------------------------------------------------------------

    def selected(self) -> tuple[str, ...]:
        """Ids of the selected recordings, in the order of the table."""
        return self._listing(self._library.view()).selected

    @on_loop
    def select(self, ids: Iterable[str]) -> None:
        """Select these recordings, if they are listed."""
        self._list = replace(self._list, selected=frozenset(ids))

    def add_action(self, action: Action) -> None:
        """Add a button for the selected recordings. The action runs on the loop and must not block."""
        self._actions = (*self._actions, action)

    @property
    def does(self) -> tuple[type[Command], ...]:  # type: ignore[override]
        """Commands that the panel carries out, including those of the actions added so far."""
        return (*LIST, *(type(action.command) for action in self._actions))

    @on_loop
    def close(self) -> None:
        """Close the dialog, if there is one."""
        self._edits.close()

    @on_loop
    def end(self) -> None:
        """Close the dialog and stop following the library, because the page is removed."""
        self._library.on_change.discard(self._library_changed)
        if self._reading is not None:
            self._reading.cancel()
        self._disk.end()
        self._edits.end()

    def do(self, command: Command, visitor: Visitor) -> None:
        before = self._listing(self._library.view())
        self._list = apply(before, command)
        self._read_thumbnails()
        match command:
            case OpenRow(id=id):
                if any(row.id == id for row in before.rows):
                    self._run(self._actions[0])
            case UndoDelete():
                self._edits.undo_delete()
            case EmptyTrash():
                self._edits.ask_empty()
            case TypeAnswer(text=text):
                self._edits.type(text)
            case AnswerDialog():
                self._edits.answer()
            case _:
                for action in self._actions:
                    if type(action.command) is type(command):
                        self._run(action)

    # --- listing ---------------------------------------------------------------------------------------

    def _listing(self, view: LibraryView) -> Listing:
        listing = make_listing(self._list, view.rows, self._listed)
        self._listed = listing
        return listing

    def _library_changed(self) -> None:
        post(self._read_thumbnails)

    def _read_thumbnails(self) -> None:
        """Read the thumbnails of the shown rows if the rows changed; on the loop."""
        rows = self._listing(self._library.view()).page
        if rows == self._pictured:
            return
        self._pictured = rows
        if self._reading is not None:
            self._reading.cancel()
        self._reading = begin(self._read([row.id for row in rows]))

    async def _read(self, ids: list[str]) -> None:
        jpegs = await self._disk.run(lambda: self._library.thumbnails(ids))
        self._thumbnails = {id: jpegs.get(id) for id in ids}

    # --- drawing ---------------------------------------------------------------------------------------

    def draw(self, view: object = None) -> None:
        """Draw changed parts; the page's own `view` is not used."""
        view, thumbnails, running = self._library.view(), self._thumbnails, self._running()
        listing = self._listing(view)
        self._find.show(listing.list.arrangement.words)
        self._draw_jobs(view)
        wanted = (view, listing, thumbnails, running, self._actions)
        if wanted == self._drawn:
            return
        self._drawn = wanted
        self._draw_filters(view, listing)
        self._draw_table(view, listing, thumbnails, running)
        self._draw_tools(view, listing)
        self._draw_marks(listing)
        self._trash.content = render("library_trash", trash=view.trash, empty=EmptyTrash())

    def _draw_jobs(self, view: LibraryView) -> None:
        """Draw the progress and the failures of the jobs that record into the folder."""
        now = time.time()
        wanted = (view.jobs, [job.is_silent(now) for job in view.jobs])
        if wanted == self._jobs_drawn:
            return
        self._jobs_drawn = wanted
        shown = [
            {"of": job, "how": job_text(job, now), "runs": job.state == "running" and not job.is_silent(now)}
            for job in view.jobs[:MAX_JOBS]
        ]
        self._jobs.content = render("library_jobs", jobs=shown)
        self._jobs.visible = bool(shown)

    def _draw_filters(self, view: LibraryView, listing: Listing) -> None:
        listed = listing.list.arrangement
        wanted = (view, listed.words, listed.task, listed.outcome)
        if wanted == self._filters_drawn:
            return
        self._filters_drawn = wanted
        tasks = sorted({row.task for row in view.rows if row.task})
        self._tasks.show(listed.task, options={ALL_TASKS: None, **{task: task for task in tasks}})
        self._tasks.visible = len(tasks) > 1
        self._find.visible = bool(view.rows)
        others = chosen(view.rows, listed.words, "all", listed.task)
        counts = {
            outcome: count_recordings(row for row in others if has_outcome(row, outcome)) for outcome in MEANS
        }
        everything = count_recordings(view.rows)
        self._filters.content = render(
            "library_filters",
            view=view,
            pills=[
                {
                    "name": outcome,
                    "hint": means,
                    "count": f"{counts['all']} of {everything}"
                    if outcome == "all" and counts["all"] < everything
                    else counts[outcome],
                    "on": outcome == listed.outcome,
                    "press": FilterRows(outcome=outcome),
                }
                for outcome, means in MEANS.items()
                if outcome != "broken" or counts["broken"] or listed.outcome == "broken"
            ]
            if view.rows
            else [],
        )

    def _draw_table(
        self,
        view: LibraryView,
        listing: Listing,
        thumbnails: Mapping[str, bytes | None],
        running: OpenVersion | None,
    ) -> None:
        now = datetime.datetime.now().astimezone()
        page, arranged = listing.page, listing.list.arrangement
        none_so = self._none_so(view, arranged)
        jpegs = [thumbnails.get(row.id, b"") for row in page]  # empty until the thumbnail is read
        wanted = (
            page,
            jpegs,
            running,
            bool(view.rows),
            none_so,
            arranged.column,
            arranged.descending,
            now.date(),
        )
        if wanted == self._table_drawn:
            return
        self._table_drawn = wanted
        self._table.content = render(
            "library",
            some=bool(view.rows),
            none_so=none_so,
            clear=ClearRowFilter(),
            press_row=lambda id: PressRow(id=id),
            also=lambda id: PressRow(id=id, held="ctrl"),
            open_row=lambda id: OpenRow(id=id),
            head=[_head(column, arranged) for column in COLUMNS],
            second=[_head(column, arranged) for column in SECOND_LINE],
            rows=[
                {
                    "number": self._number(row.id),
                    "of": row,
                    "cells": cells(row, running, now),
                    "picture": address_of_jpeg(jpeg) if jpeg else "",
                    "unread": jpeg == b"",
                }
                for row, jpeg in zip(page, jpegs, strict=True)
            ],
        )

    def _none_so(self, view: LibraryView, arranged: RowArrangement) -> str:
        if view.rows:
            return none_like_that(arranged.words, arranged.outcome, arranged.task)
        if view.problem is not None or view.reading is not None:
            return ""
        return (
            f"There are no recordings in {self._folder} yet. Recordings that are made in this folder, on the "
            "Episodes tab of a task or with workbench record, appear here."
        )

    def _draw_tools(self, view: LibraryView, listing: Listing) -> None:
        listed, rows = listing.list, listing.rows
        count = len(listed.selected)
        if not view.rows and not view.trash.files:
            self._tools.content = ""
            return
        self._tools.content = render(
            "library_tools",
            tools=[
                {
                    "name": action.label,
                    "hint": f"At most {action.most} at once"
                    if action.most is not None and count > action.most
                    else action.hint,
                    "press": action.command if 0 < count <= (action.most or count) else None,
                }
                for action in self._actions
            ],
            summary=f"{count} selected" if count else "Click a row to select it" if rows else "",
            count=len(rows),
            select_all=SelectAllRows() if count < len(rows) else None,
            select_none=SelectNoRows() if count else None,
            undo=UndoDelete() if view.trash.files else None,
            pages=listed.pages.shown(len(rows), lambda by: NextRows() if by > 0 else PreviousRows()),
        )

    def _draw_marks(self, listing: Listing) -> None:
        listed = listing.list
        selected = [self._number(row.id) for row in listing.page if row.id in listed.selected]
        cursor = None if listed.cursor is None else self._number(listed.cursor)
        self._marks.content = render("library_marks", selected=selected, cursor=cursor, follow=listed.follow)

    def _number(self, id: str) -> int:
        return self._number_of.setdefault(id, len(self._number_of) + 1)

    # --- actions on the selected recordings ----------------------------------------------------------------

    def _run(self, action: Action) -> None:
        ids = self.selected()
        if not ids:
            body = f"Select a row of the library first: {action.label} applies to the selection."
            notify_all(self._server, "Nothing is selected", body, seconds=8.0)
        elif action.most is not None and len(ids) > action.most:
            body = f"{action.label} works for at most {action.most} recordings at once: select fewer."
            notify_all(self._server, f"{len(ids)} recordings are selected", body, seconds=8.0)
        elif action.reads and (why := self._why_unreadable(ids, action.salvages)):
            notify_all(self._server, f"{action.label} needs a recording that is not damaged", why, "red")
        else:
            action.run(ids)
            for row in self._library.view().rows if action.salvages else ():
                if row.id in ids and row.problem:
                    body = f"{row.problem} The part that can be read is shown."
                    notify_all(self._server, "This recording is damaged", body, "orange")

    def _why_unreadable(self, ids: tuple[str, ...], salvages: bool) -> str:
        """Reason why none of these recordings can be read; empty if at least one of them can be read.

        Args:
            salvages: whether the readable part of a damaged recording of the workbench is enough.
        """
        rows = [row for row in self._library.view().rows if row.id in ids]
        broken = [row for row in rows if row.problem and not (salvages and row.kind == "workbench")]
        if len(broken) < len(rows) or not rows:
            return ""
        return (
            f"{broken[0].problem} Copy it again from where it was recorded, or open it to see what is left."
        )


def _head(column: Column, arranged: RowArrangement) -> dict[str, object]:
    arrow = "" if column != arranged.column else " ↓" if arranged.descending else " ↑"
    return {
        "name": column,
        "arrow": arrow,
        "press": SortRows(column=column),
        "hint": f"{HINTS[column]}. Click to sort",
    }
