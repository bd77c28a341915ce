"""The library of recordings as a table: sort, filter, select, open, tag, note, delete."""

from __future__ import annotations

import datetime
import os
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial

import viser

from workbench.recording.episode.row import LibraryRow
from workbench.recording.library.library import Library, LibraryView
from workbench.ui.library.dialogs import LibraryEdits
from workbench.ui.library.listing import RANGE, TOGGLE, Action, LibraryList, walking
from workbench.ui.library.rows import (
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
from workbench.ui.widgets.click_targets import Presses
from workbench.ui.widgets.hotkeys import Command
from workbench.ui.widgets.images import address_of_jpeg
from workbench.ui.widgets.inputs import Control, tell_all
from workbench.ui.widgets.parts import Clock, PagePart
from workbench.ui.widgets.templates import render

MOST_JOBS = 6
"""Jobs that are shown at once."""
MOST_OPEN = 4
"""Recordings that a review shows at once."""
TYPING = 0.2
"""Seconds without a keystroke after which the search runs."""
ALL_TASKS = "all tasks"
OPEN = 4
"""Bit of ``choosable.html`` for the second press of a double click, next to `TOGGLE` and `RANGE`."""


class LibraryPanel(PagePart[object]):
    """The table in the present container, the same for all open pages.

    A page of rows with pictures is 150 KB, and the selection changes with every press: so the selection is a style
    sheet of its own that marks rows by their numbers, and only that is sent. A row keeps its number for as long as the
    page lives: a press selects the pressed row even if the table has moved meanwhile.

    Args:
        on_open: gets the ids of one to `MOST_OPEN` recordings, in the order of the table.
            Called on any thread, and must not block.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        library: Library,
        on_open: Callable[[tuple[str, ...]], None],
        clock: Clock = time.monotonic,
        running: Callable[[], OpenVersion | None] = lambda: None,
    ) -> None:
        self._server, self._library, self._running = server, library, running
        self._folder = os.fsencode(library.folder).decode(errors="replace")
        self._list = LibraryList(library)
        self._edits = LibraryEdits(server, library, self.leave_keys)
        self._lock = threading.RLock()
        self._actions = [
            Action(
                "Open",
                "Open it in the review (Enter, or double-click)",
                on_open,
                MOST_OPEN,
                "Open the selected recordings",
                "enter",
                salvages=True,
            ),
            Action(
                "Tag",
                "Add or remove tags (T)",
                self._edits.ask_tags,
                reads=False,
                named="Tag the selected recordings",
                key="T",
            ),
            Action(
                "Note",
                "Edit its note (Shift+T)",
                self._edits.ask_note,
                reads=False,
                named="Edit the note of the selected recordings",
                key="T",
                modifier="shift",
            ),
            Action(
                "Delete",
                "Move its files to the trash (Delete)",
                self._edits.ask_delete,
                reads=False,
                named="Delete the selected recordings",
                key="delete",
            ),
        ]
        self._jobs = server.gui.add_html("", visible=False)
        self._filters = server.gui.add_html("")
        self._find = Control(
            server.gui.add_text(
                "Find",
                "",
                hint="Words to find in task, tags, note, name or version; seed:3 for a seed",
            ),
            send=lambda words: self._list.look_for(words, self._list.task),
            settle=TYPING,
            clock=clock,
        )
        self._tasks: viser.GuiDropdownHandle = server.gui.add_dropdown("Task", (ALL_TASKS,), visible=False)
        self._tools = server.gui.add_html("")
        self._marks = server.gui.add_html("")
        self._table = server.gui.add_html("")
        self._trash = server.gui.add_html("")
        self._presses = Presses(server)
        self._numbers = self._presses.number_id("rows", self._on_row)

        self._number_of: dict[str, int] = {}
        """Number of each recording's row, from 1 on, in the order in which they came."""
        self._drawn: object = None
        self._jobs_drawn: object = None
        self._filters_drawn: object = None
        """What the filters were counted for: with thousands of rows counting takes long."""
        self._table_drawn: object = None

        self._keys: list[viser.CommandHandle] = []
        self._escapes: list[viser.CommandHandle] = []
        self.keys: tuple[str, ...] = ()
        """Combinations of the commands that need the table to be visible."""
        self._asking = False
        self._tasks.on_update(lambda _: self._on_task())

    # --- for the page that has it ----------------------------------------------------------------------

    def selected(self) -> tuple[str, ...]:
        """Ids of the selected recordings, in the order of the table."""
        return self._list.selected_ids()

    def select(self, ids: Iterable[str]) -> None:
        """Select those of these recordings that are listed."""
        self._list.select(ids)

    def add_action(self, action: Action) -> None:
        """Add a button for the selected recordings; it runs on any thread and must not block."""
        with self._lock:
            self._actions.append(action)

    def leave_keys(self, asking: bool) -> None:
        """Disable the keys while a dialog is open, of the library or of another part."""
        # viser's keys act before a focused button: Enter on Cancel would open a recording.
        self._asking = asking
        for key in self._keys:
            key.disabled = asking
        self._can_escape()

    def close(self) -> None:
        """Close the dialog, if there is one. Called when the page goes, and its keys with it."""
        self._edits.close()
        self._keys, self._escapes = [], []

    def commands(self) -> list[Command]:
        """Commands of the table; register them after the last `add_action`."""
        commands = [
            *walking(self._list),
            *(
                Command(action.named, partial(self._run, action), action.key, action.modifier)
                for action in self._actions
                if action.named
            ),
            Command("Undo the last deletion", self._edits.undo_delete, "Z"),
        ]
        self.keys = tuple(command.combination for command in commands)
        commands = [replace(command, registered=self._keys.append) for command in commands]
        escape = Command("Cancel, or show all recordings again", self._escape, "escape")
        return [*commands, replace(escape, registered=self._escapes.append)]

    def _escape(self) -> None:
        if self._asking:
            self._edits.close()
        else:
            self._clear_filter()

    def _can_escape(self) -> None:
        """Enable Escape while a dialog is open or a filter is set."""
        listed = self._list
        of_use = self._asking or bool(listed.words or listed.task) or listed.outcome != "all"
        for handle in self._escapes:
            handle.disabled = not of_use

    # --- drawing ---------------------------------------------------------------------------------------

    def draw(self, view: object = None) -> None:
        """Draw what has changed; the page's own `view` is not used."""
        view = self._library.view()
        with self._lock, self._list.lock:
            self._find.show(self._list.words)
            self._draw_jobs(view)
            wanted = (view.serial, self._list.state(), len(self._actions), self._running())
            if wanted == self._drawn:
                return
            self._drawn = wanted
            self._can_escape()
            page = self._list.page(view)
            self._draw_filters(view)
            self._draw_table(view, page)
            self._draw_tools(view)
            self._draw_marks(page)
            empty = self._press("empty", self._edits.ask_empty)
            self._trash.content = render("library_trash", trash=view.trash, empty=empty)

    def _draw_jobs(self, view: LibraryView) -> None:
        """How far the jobs are that record into the folder, each with what failed."""
        now = time.time()
        wanted = (view.jobs, [job.is_silent(now) for job in view.jobs])
        if wanted == self._jobs_drawn:
            return
        self._jobs_drawn = wanted
        shown = [
            {"of": job, "how": job_text(job, now), "runs": job.state == "running" and not job.is_silent(now)}
            for job in view.jobs[:MOST_JOBS]
        ]
        self._jobs.content = render("library_jobs", jobs=shown)
        self._jobs.visible = bool(shown)

    def _draw_filters(self, view: LibraryView) -> None:
        listed = self._list
        wanted = (view.serial, listed.words, listed.task, listed.outcome)
        if wanted == self._filters_drawn:
            return
        self._filters_drawn = wanted
        tasks = tuple(sorted({row.task for row in view.rows if row.task}))
        if self._tasks.options != (ALL_TASKS, *tasks):
            listed.look_for(listed.words, listed.task)  # its task may have gone
            self._tasks.options = (ALL_TASKS, *tasks)
            self._tasks.value = ALL_TASKS if listed.task is None else listed.task
        self._tasks.visible = len(tasks) > 1
        self._find.handle.visible = bool(view.rows)
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
                    "press": self._press(
                        ("outcome", outcome), lambda outcome=outcome: listed.choose(outcome)
                    ),
                }
                for outcome, means in MEANS.items()
                if outcome != "broken" or counts["broken"] or listed.outcome == "broken"
            ]
            if view.rows
            else [],
        )

    def _draw_table(self, view: LibraryView, page: Sequence[LibraryRow]) -> None:
        now = datetime.datetime.now().astimezone()
        running = self._running()
        wanted = (
            page,
            running,
            bool(view.rows),
            self._none_so(view),
            self._list.column,
            self._list.descending,
            now.date(),
        )
        if wanted == self._table_drawn:
            return
        self._table_drawn = wanted
        pictures = self._library.thumbnails([row.id for row in page])
        self._table.content = render(
            "library",
            numbers=self._numbers,
            some=bool(view.rows),
            none_so=self._none_so(view),
            clear=self._press("clear", self._clear_filter),
            head=[self._head(column) for column in COLUMNS],
            second=[self._head(column) for column in SECOND_LINE],
            rows=[
                {
                    "number": self._number(row.id),
                    "of": row,
                    "cells": cells(row, running, now),
                    "picture": address_of_jpeg(pictures[row.id]) if row.id in pictures else "",
                }
                for row in page
            ],
        )

    def _none_so(self, view: LibraryView) -> str:
        if view.rows:
            return none_like_that(self._list.words, self._list.outcome, self._list.task)
        if view.problem is not None or view.reading is not None:
            return ""
        return (
            f"There are no recordings in {self._folder} yet. Recordings made there, on the Episodes tab of "
            "a task or with workbench record, appear here."
        )

    def _head(self, column: Column) -> dict[str, str]:
        listed = self._list
        arrow = "" if column != listed.column else " ↓" if listed.descending else " ↑"
        press = self._press(("sort", column), lambda: listed.sort_by(column))
        return {
            "name": column,
            "arrow": arrow,
            "press": press,
            "hint": f"{HINTS[column]}. Click to sort",
        }

    def _draw_tools(self, view: LibraryView) -> None:
        listed, rows = self._list, self._list.rows(view)
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
                    "press": self._press(("action", k), lambda k=k: self._run(self._actions[k]))
                    if 0 < count <= (action.most or count)
                    else "",
                }
                for k, action in enumerate(self._actions)
            ],
            summary=f"{count} selected" if count else "Click a row to select it" if rows else "",
            count=len(rows),
            select_all=self._press(("select", "all"), listed.select_all) if count < len(rows) else "",
            select_none=self._press(("select", "none"), lambda: self.select(())) if count else "",
            undo=self._press("undo", self._edits.undo_delete) if view.trash.files else "",
            pages=listed.pages.shown(self._press),
        )

    def _draw_marks(self, page: Sequence[LibraryRow]) -> None:
        listed = self._list
        selected = [self._number(row.id) for row in page if row.id in listed.selected]
        cursor = None if listed.cursor is None else self._number(listed.cursor)
        self._marks.content = render("library_marks", selected=selected, cursor=cursor, follow=listed.follow)

    def _number(self, id: str) -> int:
        return self._number_of.setdefault(id, len(self._number_of) + 1)

    # --- presses and inputs ------------------------------------------------------------------------------

    def _press(self, key: object, do: Callable[[], None]) -> str:
        return self._presses.id_of(("library", key), lambda _client: do())

    def _on_row(self, sent: int) -> None:
        number, held = divmod(sent, 8)
        with self._lock:
            id = next(iter(list(self._number_of)[max(0, number - 1) : number]), "")
        if self._list.press(id, held & (TOGGLE | RANGE)) and held & OPEN:
            self._run(self._actions[0])

    def _on_task(self) -> None:
        self._list.look_for(self._list.words, self._tasks.value)

    def _clear_filter(self) -> None:
        self._find.handle.value, self._tasks.value = "", ALL_TASKS
        self._list.choose("all")
        self._list.look_for("", None)

    # --- actions on the selected recordings ----------------------------------------------------------------

    def _run(self, action: Action) -> None:
        ids = self.selected()
        if not ids:
            body = f"Select a row of the library first: {action.label} applies to the selection."
            tell_all(self._server, "Nothing is selected", body, seconds=8.0)
        elif action.most is not None and len(ids) > action.most:
            body = f"{action.label} takes at most {action.most} at once."
            tell_all(self._server, f"{len(ids)} are selected", body, seconds=8.0)
        elif action.reads and (why := self._why_unreadable(ids, action.salvages)):
            tell_all(self._server, f"{action.label} needs a recording that is not damaged", why, "red")
        else:
            action.run(ids)
            for row in self._library.view().rows if action.salvages else ():
                if row.id in ids and row.problem:
                    body = f"{row.problem} What can be read of it is shown."
                    tell_all(self._server, "This recording is damaged", body, "orange")

    def _why_unreadable(self, ids: tuple[str, ...], salvages: bool) -> str:
        """Why none of these can be read; empty if one can.

        Args:
            salvages: what is left of a damaged recording of the workbench is enough.
        """
        rows = [row for row in self._library.view().rows if row.id in ids]
        broken = [row for row in rows if row.problem and not (salvages and row.kind == "workbench")]
        if len(broken) < len(rows) or not rows:
            return ""
        return (
            f"{broken[0].problem} Copy it again from where it was recorded, or open it to see what is left."
        )
