"""The library of recordings as a table: sort and filter it, select, open, tag, note, delete.

What the rows say is in `library_rows`. Thousands of rows are shown a page at a time. Which are selected changes with
every press, and a page of rows with their pictures is 150 KB; so the selection is not part of the table but a style
sheet of its own that marks rows by their numbers, and only it is sent.

A row has a number for as long as the page lives, and what a browser sends is such a number: if the table has moved
meanwhile because a recording came in, the row that was pressed is still the one that is selected. Like everything on
the page, selection, sorting and filter are the same for all who look at it.
"""

from __future__ import annotations

import base64
import datetime
import logging
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import viser

from workbench.recording.library import Library, LibraryError, LibraryView
from workbench.recording.library_row import LONGEST_NOTE, LibraryRow, clean_tags
from workbench.ui.changed import fill, show
from workbench.ui.commands import Command
from workbench.ui.fragments import render
from workbench.ui.library_forms import Question, ask_text, ask_whether
from workbench.ui.library_rows import (
    COLUMNS,
    HINTS,
    MEANS,
    OUTCOMES,
    SECOND_LINE,
    Column,
    Outcome,
    begins_descending,
    cells,
    chosen,
    has_outcome,
    in_words,
    newest_sources,
    ordered,
    size_in_words,
)
from workbench.ui.presses import Presses

log = logging.getLogger(__name__)

MOST_ROWS = 50
"""On one page of the table."""
MOST_OPEN = 4
"""Recordings that a review shows at once."""
TYPING = 0.2
"""Seconds without a keystroke after which the words that are looked for are taken."""
LONGEST_WORDS = 200
ALL_TASKS = "all tasks"
TOGGLE, RANGE, OPEN = 1, 2, 4
"""What was held, or done, with a press on a row (``choosable.html``)."""


@dataclass(frozen=True)
class Action:
    """Something to be done with the selected recordings."""

    label: str
    hint: str
    run: Callable[[tuple[str, ...]], None]
    most: int | None = None
    """Recordings that it can take at once."""


class LibraryPanel:
    """The table in the present container.

    Args:
        on_open: gets the ids of one to `MOST_OPEN` recordings, in the order of the table.
        on_selection: gets the ids that are selected, whenever they change.
    Both are called on any thread, one call at a time or several at once, and must not block.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        library: Library,
        on_open: Callable[[tuple[str, ...]], None],
        on_selection: Callable[[tuple[str, ...]], None] | None = None,
    ) -> None:
        self._server, self._library = server, library
        self._on_selection = on_selection
        self._lock = threading.RLock()
        self._actions = [
            Action("Open", "Show it in the review (Enter, or press it twice)", on_open, MOST_OPEN),
            Action("Tag", "Add tags or take them away (T)", self._ask_tags),
            Action("Note", "Write a note to it", self._ask_note),
            Action("Delete", "Move its files to the trash (Delete)", self._ask_delete),
        ]
        self._filters = server.gui.add_html("")
        self._find = server.gui.add_text(
            "Find",
            "",
            hint="Words in task, tags, note, name or version, all of which must be found; seed:3 for a seed",
        )
        self._tasks: viser.GuiDropdownHandle = server.gui.add_dropdown("Task", (ALL_TASKS,), visible=False)
        self._tools = server.gui.add_html("")
        self._marks = server.gui.add_html("")
        self._table = server.gui.add_html("")
        self._trash = server.gui.add_html("")
        self._presses = Presses(server)
        self._numbers = self._presses.number_id("rows", self._on_row)

        self._column: Column = "date"
        self._descending = True
        self._outcome: Outcome = "all"
        self._words, self._task = "", None
        self._typed_at: float | None = None
        self._first = 0
        self._selected: frozenset[str] = frozenset()
        self._cursor: str | None = None
        self._anchor: str | None = None
        self._follow = False
        """Whether the page shall scroll to the cursor."""
        self._ids: list[str] = []
        """By the number of its row."""
        self._number_of: dict[str, int] = {}
        self._arranged: tuple[object, list[LibraryRow]] = (None, [])
        self._drawn: dict[str, object] = {}
        self._told: tuple[str, ...] = ()
        self._question: Question | None = None

        self._find.on_update(lambda _: self._on_typed())
        self._tasks.on_update(lambda _: self._on_task())

    # --- for whoever hosts it --------------------------------------------------------------------------

    def selected(self) -> tuple[str, ...]:
        """Ids of the selected recordings, in the order of the table."""
        with self._lock:
            return tuple(row.id for row in self._rows() if row.id in self._selected)

    def select(self, ids: Iterable[str]) -> None:
        """Select these recordings, of those that are listed."""
        with self._lock:
            listed = {row.id for row in self._rows()}
            self._selected = frozenset(ids) & listed
        self._tell()

    def add_action(
        self, label: str, hint: str, run: Callable[[tuple[str, ...]], None], most: int | None = None
    ) -> None:
        """One more button for the selected recordings.

        Args:
            run: gets their ids; called on any thread, must not block.
            most: recordings that it can take at once.
        """
        with self._lock:
            self._actions.append(Action(label, hint, run, most))

    def commands(self) -> list[Command]:
        """Keys of the table, for the page to register."""
        actions = {action.label: action for action in self._actions}
        return [
            Command("The next recording of the table", lambda: self._move(1), "arrowdown"),
            Command("The recording before it", lambda: self._move(-1), "arrowup"),
            Command("Select the next recording too", lambda: self._move(1, RANGE), "arrowdown", "shift"),
            Command("Select the one before it too", lambda: self._move(-1, RANGE), "arrowup", "shift"),
            Command("The next page of recordings", lambda: self._turn(1), "pagedown"),
            Command("The page of recordings before it", lambda: self._turn(-1), "pageup"),
            Command("Select this recording, or no longer", self._toggle_cursor, "X"),
            Command("Select all recordings that are listed", self._select_all, "A", "cmd/ctrl"),
            Command("Open the selected recordings", lambda: self._run(actions["Open"]), "enter"),
            Command("Tag the selected recordings", lambda: self._run(actions["Tag"]), "T"),
            Command("Delete the selected recordings", lambda: self._run(actions["Delete"]), "delete"),
            Command("Take back the last deletion", self._undo_delete, "Z"),
        ]

    def close(self) -> None:
        """Close the window with a question, if there is one. For when the page goes."""
        with self._lock:
            if self._question is not None:
                self._question.close()

    # --- drawing ---------------------------------------------------------------------------------------

    def draw(self) -> None:
        """Draw what has changed. To be called often; costs nothing while nothing has."""
        view = self._library.view()
        with self._lock:
            if self._typed_at is not None and time.monotonic() - self._typed_at > TYPING:
                self._typed_at = None
                self._look_for(self._find.value, self._task)
            rows = self._rows(view)
            state = (self._arranged[0], self._first, self._selected, self._cursor, len(self._actions))
            if not self._is_new("all", state):
                return
            listed = {row.id for row in rows}
            self._selected &= listed
            if self._cursor not in listed:
                self._cursor = None
            self._first = min(self._first, max(0, (len(rows) - 1) // MOST_ROWS * MOST_ROWS))
            page = rows[self._first : self._first + MOST_ROWS]
            self._draw_filters(view)
            self._draw_table(view, rows, page)
            self._draw_tools(view, rows, page)
            self._draw_marks(page)
            if self._is_new("trash", view.trash):
                fill(self._trash, self._trash_html(view))
        self._tell()

    def _is_new(self, part: str, wanted: object) -> bool:
        if part in self._drawn and self._drawn[part] == wanted:
            return False
        self._drawn[part] = wanted
        return True

    def _rows(self, view: LibraryView | None = None) -> list[LibraryRow]:
        """What is listed, in its order."""
        view = self._library.view() if view is None else view
        key = (view.serial, self._words, self._outcome, self._task, self._column, self._descending)
        if self._arranged[0] != key:
            rows = chosen(view.rows, self._words, self._outcome, self._task)
            self._arranged = (key, ordered(rows, self._column, self._descending))
        return self._arranged[1]

    def _draw_filters(self, view: LibraryView) -> None:
        if not self._is_new("filters", (view.serial, self._words, self._task, self._outcome)):
            return
        tasks = tuple(sorted({row.task for row in view.rows if row.task}))
        options = (ALL_TASKS, *tasks)
        if self._tasks.options != options:
            self._tasks.options = options
            self._tasks.value = ALL_TASKS if self._task is None else self._task
            if self._task not in tasks:
                self._task, self._tasks.value = None, ALL_TASKS
        show(self._tasks, len(tasks) > 1)
        show(self._find, bool(view.rows))
        others = chosen(view.rows, self._words, "all", self._task)
        counts = {outcome: sum(has_outcome(row, outcome) for row in others) for outcome in OUTCOMES}
        done, total = view.reading or (0, 0)
        fill(
            self._filters,
            render(
                "library_filters",
                problem=view.problem or "",
                reading=""
                if view.reading is None
                else f"Reading {done} of {total} recordings"
                if total
                else "Looking through the folder",
                percent=f"{100 * done / max(1, total):.0f}",
                pills=[
                    {
                        "name": outcome,
                        "hint": MEANS[outcome],
                        "count": counts[outcome],
                        "on": outcome == self._outcome,
                        "press": self._press(outcome, lambda outcome=outcome: self._choose_outcome(outcome)),
                    }
                    for outcome in OUTCOMES
                    if outcome != "broken" or counts["broken"] or self._outcome == "broken"
                ]
                if view.rows
                else [],
            ),
        )

    def _draw_table(self, view: LibraryView, rows: Sequence[LibraryRow], page: Sequence[LibraryRow]) -> None:
        now = datetime.datetime.now().astimezone()
        newest = newest_sources(view.rows)
        here = {row.task: newest.get(row.task) for row in page}
        wanted = (
            page,
            here,
            bool(view.rows),
            view.reading is None,
            self._column,
            self._descending,
            now.date(),
        )
        if not self._is_new("table", wanted):
            return
        pictures = self._library.thumbnails([row.id for row in page])
        fill(
            self._table,
            render(
                "library",
                numbers=self._numbers,
                some=bool(view.rows),
                none_so=self._none_so(view),
                head=[self._head(column) for column in COLUMNS],
                second=[self._head(column) for column in SECOND_LINE],
                rows=[
                    {
                        "number": self._number(row.id),
                        "cells": cells(row, newest, now),
                        "picture": data_address_of_jpeg(pictures.get(row.id)),
                    }
                    for row in page
                ],
            ),
        )

    def _none_so(self, view: LibraryView) -> str:
        if view.rows:
            return "No recording is like that. Press all, or look for something else."
        if view.problem is not None or view.reading is not None:
            return ""
        return (
            f"There are no recordings in {self._library.folder} yet. Those that are made there, on the Episodes tab of "
            "a task or with workbench record, appear here."
        )

    def _head(self, column: Column) -> dict[str, str]:
        arrow = "" if column != self._column else " ↓" if self._descending else " ↑"
        press = self._press(("sort", column), lambda: self._choose_column(column))
        return {
            "name": column,
            "arrow": arrow,
            "press": press,
            "hint": f"{HINTS[column]}. Press to sort by it",
        }

    def _draw_tools(self, view: LibraryView, rows: Sequence[LibraryRow], page: Sequence[LibraryRow]) -> None:
        count = len(self._selected)
        wanted = (count, len(rows), self._first, len(page), bool(view.rows), len(self._actions))
        if not self._is_new("tools", wanted):
            return
        if not view.rows:
            fill(self._tools, "")
            return
        last = self._first + len(page)
        fill(
            self._tools,
            render(
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
                summary=f"{count} selected" if count else "Press a row to select it",
                count=len(rows),
                all=self._press("all", self._select_all) if count < len(rows) else "",
                none=self._press("none", lambda: self.select(())) if count else "",
                pages=None
                if len(rows) <= MOST_ROWS
                else {
                    "first": self._first + 1,
                    "last": last,
                    "of": len(rows),
                    "back": self._press("back", lambda: self._turn(-1)) if self._first else "",
                    "on": self._press("on", lambda: self._turn(1)) if last < len(rows) else "",
                },
            ),
        )

    def _draw_marks(self, page: Sequence[LibraryRow]) -> None:
        selected = [self._number(row.id) for row in page if row.id in self._selected]
        cursor = None if self._cursor is None else self._number(self._cursor)
        if self._is_new("marks", (selected, cursor)):
            content = render("library_marks", selected=selected, cursor=cursor, follow=self._follow)
            fill(self._marks, content)

    def _trash_html(self, view: LibraryView) -> str:
        return render(
            "library_trash",
            files=view.trash.files,
            size=size_in_words(view.trash.size),
            undo=self._press("undo", self._undo_delete),
            empty=self._press("empty", self._ask_empty),
        )

    def _number(self, id: str) -> int:
        """Of its row, from 1 on."""
        if id not in self._number_of:
            self._ids.append(id)
            self._number_of[id] = len(self._ids)
        return self._number_of[id]

    # --- what is pressed, typed and chosen ---------------------------------------------------------------

    def _press(self, key: object, do: Callable[[], None]) -> str:
        return self._presses.id_of(("library", key), lambda _client: do())

    def _on_row(self, sent: int, _client: viser.ClientHandle | None) -> None:
        number, held = divmod(sent, 8)
        with self._lock:
            if not 1 <= number <= len(self._ids):
                return
            id = self._ids[number - 1]
            if id not in {row.id for row in self._rows()}:
                return
            self._take(id, held & (TOGGLE | RANGE))
        self._tell()
        if held & OPEN:
            self._run(self._actions[0])

    def _take(self, id: str, held: int, follow: bool = False) -> None:
        """Select as lists of files do: alone, with control this one too, with shift all from the last one on."""
        if held & RANGE and self._anchor is not None:
            order = [row.id for row in self._rows()]
            if self._anchor in order:
                a, b = sorted((order.index(self._anchor), order.index(id)))
                between = frozenset(order[a : b + 1])
                self._selected = between | self._selected if held & TOGGLE else between
                self._cursor, self._follow = id, follow
                return
        if held & TOGGLE:
            self._selected = self._selected ^ {id}
        else:
            self._selected = frozenset((id,))
        self._cursor, self._anchor, self._follow = id, id, follow

    def _move(self, by: int, held: int = 0) -> None:
        with self._lock:
            order = [row.id for row in self._rows()]
            if not order:
                return
            if self._cursor in order:
                place = min(max(order.index(self._cursor) + by, 0), len(order) - 1)
            else:
                place = self._first
            self._take(order[place], held, follow=True)
            self._first = place // MOST_ROWS * MOST_ROWS
        self._tell()

    def _turn(self, by: int) -> None:
        with self._lock:
            last = max(0, (len(self._rows()) - 1) // MOST_ROWS * MOST_ROWS)
            self._first = min(max(0, self._first + by * MOST_ROWS), last)

    def _toggle_cursor(self) -> None:
        with self._lock:
            if self._cursor is not None:
                self._take(self._cursor, TOGGLE)
        self._tell()

    def _select_all(self) -> None:
        self.select(row.id for row in self._rows())

    def _choose_column(self, column: Column) -> None:
        with self._lock:
            self._descending = not self._descending if column == self._column else begins_descending(column)
            self._column, self._first = column, 0

    def _choose_outcome(self, outcome: Outcome) -> None:
        with self._lock:
            self._outcome, self._first = outcome, 0

    def _on_typed(self) -> None:
        with self._lock:
            self._typed_at = time.monotonic()

    def _on_task(self) -> None:
        with self._lock:
            # What a page sends may be anything: only a task of the table is one.
            tasks = {row.task for row in self._library.rows()}
            self._look_for(self._words, self._tasks.value if self._tasks.value in tasks else None)

    def _look_for(self, words: object, task: str | None) -> None:
        words = words[:LONGEST_WORDS] if isinstance(words, str) else ""
        if (words, task) != (self._words, self._task):
            self._words, self._task, self._first = words, task, 0

    def _tell(self) -> None:
        """Say which are selected, if others are."""
        with self._lock:
            selected = self.selected()
            if selected == self._told:
                return
            self._told = selected
        if self._on_selection is not None:
            self._on_selection(selected)

    # --- what is done with the selected ones ---------------------------------------------------------------

    def _run(self, action: Action) -> None:
        ids = self.selected()
        if not ids:
            self._notify("Nothing is selected", f"Select a recording to {action.label.lower()} it.")
        elif action.most is not None and len(ids) > action.most:
            self._notify(f"{len(ids)} are selected", f"{action.label} takes at most {action.most} at once.")
        else:
            action.run(ids)

    def _ask(self, make: Callable[[], Question]) -> None:
        with self._lock:
            if self._question is not None:
                self._question.close()
            self._question = make()

    def _ask_tags(self, ids: tuple[str, ...]) -> None:
        rows = self._rows_of(ids)
        if not rows:
            return
        shared = [tag for tag in rows[0].tags if all(tag in row.tags for row in rows)]

        def answered(typed: str) -> None:
            tags = clean_tags(typed.split(","))
            removed = [tag for tag in shared if tag not in tags]
            self._do(lambda: self._library.set_tags(ids, [tag for tag in tags if tag not in shared], removed))

        known = sorted({tag for row in self._library.rows() for tag in row.tags})
        explained = "Words, with commas between them."
        if len(rows) > 1:
            explained += " Those that all of them have stand here; others that they have stay."
        if known:
            explained += f" In use: {', '.join(known[:12])}."
        names = [row.name for row in rows]
        self._ask(lambda: ask_text(self._server, "Tags", explained, names, ", ".join(shared), answered))

    def _ask_note(self, ids: tuple[str, ...]) -> None:
        rows = self._rows_of(ids)
        if not rows:
            return
        notes = {row.note for row in rows}
        explained = "" if len(notes) == 1 else "They have different notes; this one takes their place."
        names = [row.name for row in rows]
        value = notes.pop() if len(notes) == 1 else ""

        def answered(typed: str) -> None:
            self._do(lambda: self._library.set_note(ids, typed[:LONGEST_NOTE]))

        self._ask(lambda: ask_text(self._server, "Note", explained, names, value, answered))

    def _ask_delete(self, ids: tuple[str, ...]) -> None:
        rows = self._rows_of(ids)
        if not rows:
            return
        self._ask(
            lambda: ask_whether(
                self._server,
                "Delete recordings",
                f"Delete {in_words(rows)}?",
                [row.name for row in rows],
                "All their files go to the folder .trash in the library, and can be taken back from there.",
                "Delete",
                lambda: self._do(lambda: self._library.delete(ids)),
            )
        )

    def _ask_empty(self) -> None:
        trash = self._library.view().trash
        self._ask(
            lambda: ask_whether(
                self._server,
                "Empty the trash",
                f"Delete {trash.files} files ({size_in_words(trash.size)}) for good?",
                [],
                "This cannot be undone.",
                "Delete for good",
                lambda: self._do(self._library.empty_trash),
            )
        )

    def _undo_delete(self) -> None:
        self._do(self._library.undo_delete)

    def _rows_of(self, ids: Sequence[str]) -> list[LibraryRow]:
        rows = (self._library.row(id) for id in ids)
        return [row for row in rows if row is not None]

    def _do(self, work: Callable[[], object]) -> None:
        try:
            work()
        except LibraryError as error:
            self._notify("Not possible", str(error))

    def _notify(self, title: str, body: str) -> None:
        for client in self._server.get_clients().values():
            client.add_notification(title, body, color="orange", auto_close_seconds=8.0)


def data_address_of_jpeg(jpeg: bytes | None) -> str:
    """``data:image/jpeg;base64,...``; empty for none."""
    return "" if jpeg is None else "data:image/jpeg;base64," + base64.b64encode(jpeg).decode("ascii")
