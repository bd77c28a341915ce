"""Filter, order, pages and selection of the library's list, and the actions on selected recordings."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from workbench.commands.command import Command
from workbench.recording.episode.row import LibraryRow
from workbench.recording.library.library import Library, LibraryView
from workbench.ui.library.rows import Column, Outcome, begins_descending, chosen, ordered
from workbench.ui.widgets.paged import Paged

MOST_ROWS = 50
"""Rows of one page of the table."""
LONGEST_WORDS = 200
TOGGLE, RANGE = 1, 2
"""Modifiers of a press on a row; both together add a range to the selection."""


class LibraryList:
    """The list of one `Library`. Thread-safe.

    Selection works as in a file manager: a press selects one row, control toggles it, shift selects all from the last
    one on. Rows that are not listed are not selected, or a deletion would take what a filter hides.
    """

    def __init__(self, library: Library) -> None:
        self._library = library
        self.lock = threading.RLock()
        self.column: Column = "date"
        self.descending = True
        self.outcome: Outcome = "all"
        self.words = ""
        self.task: str | None = None
        self.pages = Paged(MOST_ROWS)
        self.selected: frozenset[str] = frozenset()
        self.cursor: str | None = None
        """Id of the row that was pressed or moved to last."""
        self.follow = False
        """Whether browsers scroll to the cursor: after keys, which may leave the visible rows."""
        self._anchor: str | None = None
        self._place = 0
        """Row number of the cursor when it was set; the cursor goes there when its row is deleted."""
        self._arranged: tuple[object, list[LibraryRow]] = (None, [])

    # --- rows ----------------------------------------------------------------------------------------

    def rows(self, view: LibraryView | None = None) -> list[LibraryRow]:
        """The listed rows, in order."""
        with self.lock:
            view = self._library.view() if view is None else view
            key = (view.serial, self.words, self.outcome, self.task, self.column, self.descending)
            if self._arranged[0] != key:
                rows = chosen(view.rows, self.words, self.outcome, self.task)
                self._arranged = (key, ordered(rows, self.column, self.descending))
            return self._arranged[1]

    def page(self, view: LibraryView) -> list[LibraryRow]:
        """The rows of the present page. Drops selected rows that are no longer listed."""
        with self.lock:
            rows = self.rows(view)
            listed = {row.id for row in rows}
            self.selected &= listed
            if self.cursor not in listed:
                self.cursor = None
            places = self.pages.places(len(rows))
            return rows[places.start : places.stop]

    def state(self) -> object:
        """A value that changes whenever anything here changes."""
        with self.lock:
            self.rows()
            return self._arranged[0], self.pages.first, self.selected, self.cursor

    def selected_ids(self) -> tuple[str, ...]:
        """Ids of the selected rows, in the order of the list."""
        with self.lock:
            return tuple(row.id for row in self.rows() if row.id in self.selected)

    # --- selecting -----------------------------------------------------------------------------------

    def select(self, ids: Iterable[str]) -> None:
        """Select the rows of these ids that are listed."""
        with self.lock:
            self.selected = frozenset(ids) & {row.id for row in self.rows()}

    def select_all(self) -> None:
        self.select(row.id for row in self.rows())

    def press(self, id: str, held: int = 0) -> bool:
        """Press this row; False if it is not listed.

        Args:
            held: `TOGGLE`, `RANGE`, both or neither.
        """
        with self.lock:
            order = [row.id for row in self.rows()]
            if id not in order:
                return False
            self._take(order, order.index(id), held)
            self.follow = False
            return True

    def move(self, by: int, held: int = 0) -> None:
        """Move the cursor as an arrow key does, from its row or from where it last was."""
        with self.lock:
            order = [row.id for row in self.rows()]
            if not order:
                return
            if self.cursor in order:
                place = order.index(self.cursor) + by
            else:
                place = max(self._place, self.pages.first)
            place = min(max(place, 0), len(order) - 1)
            self._take(order, place, held)
            self.pages.go_to(place)
            self.follow = True

    def toggle_cursor(self) -> None:
        with self.lock:
            if self.cursor is not None:
                self.press(self.cursor, TOGGLE)

    def _take(self, order: list[str], place: int, held: int) -> None:
        id = order[place]
        self.cursor, self._place = id, place
        if held & RANGE and self._anchor in order:
            a, b = sorted((order.index(self._anchor), place))
            between = frozenset(order[a : b + 1])
            self.selected = between | self.selected if held & TOGGLE else between
            return
        self.selected = self.selected ^ {id} if held & TOGGLE else frozenset((id,))
        self._anchor = id

    # --- arranging -----------------------------------------------------------------------------------

    def sort_by(self, column: Column) -> None:
        """Sort by a column; if it is the present one, reverse the order."""
        with self.lock:
            self.descending = not self.descending if column == self.column else begins_descending(column)
            self.column = column
            self.pages.go_to(0)

    def choose(self, outcome: Outcome) -> None:
        with self.lock:
            self.outcome = outcome
            self.pages.go_to(0)

    def look_for(self, words: str, task: str | None) -> None:
        """List the rows with these words and of this task, if it still has recordings."""
        with self.lock:
            known = {row.task for row in self._library.view().rows}
            words = words[:LONGEST_WORDS]
            task = task if task in known else None
            if (words, task) != (self.words, self.task):
                self.words, self.task = words, task
                self.pages.go_to(0)


@dataclass(frozen=True)
class Action:
    """An operation on the selected recordings."""

    label: str
    command: Command
    hint: str
    run: Callable[[tuple[str, ...]], None]
    most: int | None = None
    """Maximum number of recordings at once; None for any number."""
    reads: bool = True
    """Whether it reads the recordings; False for what also applies to files that cannot be read."""
    salvages: bool = False
    """Whether it uses the readable part of a damaged recording."""
