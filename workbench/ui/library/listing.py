"""Which recordings the library lists, in which order, on which page, which are selected, and what is done with those.

Selection works as in every list of files: a press selects a row alone, control adds it or takes it away, shift takes
all from the last one on. What is not listed is not selected, or a filter would hide what a deletion then takes. What is
done is a button and a command with a key, of one description. Methods are called from any thread.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from viser._messages import HotkeyKey, KeyModifier  # the types of add_command's arguments (viser 1.1.1)

from workbench.recording.episode.row import LibraryRow
from workbench.recording.library.library import Library, LibraryView
from workbench.ui.library.rows import Column, Outcome, begins_descending, chosen, ordered
from workbench.ui.widgets.click_targets import Paged
from workbench.ui.widgets.hotkeys import Command

MOST_ROWS = 50
"""On one page of the table."""
LONGEST_WORDS = 200
TOGGLE, RANGE = 1, 2
"""What was held with a press on a row; both together take a range along with what is selected."""


class LibraryList:
    """Of one `Library`."""

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
        """The row that was taken last, by mouse or keys."""
        self.follow = False
        """Whether a browser shall scroll to the cursor: after keys, which may go where it does not look."""
        self._anchor: str | None = None
        self._place = 0
        """Of the cursor when it was set: where to go on from when its row is deleted."""
        self._arranged: tuple[object, list[LibraryRow]] = (None, [])

    # --- what there is -------------------------------------------------------------------------------

    def rows(self, view: LibraryView | None = None) -> list[LibraryRow]:
        """What is listed, in its order."""
        with self.lock:
            view = self._library.view() if view is None else view
            key = (view.serial, self.words, self.outcome, self.task, self.column, self.descending)
            if self._arranged[0] != key:
                rows = chosen(view.rows, self.words, self.outcome, self.task)
                self._arranged = (key, ordered(rows, self.column, self.descending))
            return self._arranged[1]

    def page(self, view: LibraryView) -> list[LibraryRow]:
        """The rows of the page. What is not listed any more is let go of."""
        with self.lock:
            rows = self.rows(view)
            listed = {row.id for row in rows}
            self.selected &= listed
            if self.cursor not in listed:
                self.cursor = None
            places = self.pages.places(len(rows))
            return rows[places.start : places.stop]

    def state(self) -> object:
        """Differs when anything here is another."""
        with self.lock:
            self.rows()
            return self._arranged[0], self.pages.first, self.selected, self.cursor

    def selected_ids(self) -> tuple[str, ...]:
        """In the order of the list."""
        with self.lock:
            return tuple(row.id for row in self.rows() if row.id in self.selected)

    # --- selecting -----------------------------------------------------------------------------------

    def select(self, ids: Iterable[str]) -> None:
        """Select these, of those that are listed."""
        with self.lock:
            self.selected = frozenset(ids) & {row.id for row in self.rows()}

    def select_all(self) -> None:
        self.select(row.id for row in self.rows())

    def press(self, id: str, held: int = 0) -> bool:
        """Select as a press on this row does; False if it is not listed.

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
        """As an arrow key does: from the cursor, or from where it was."""
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
        """By another column, or the same one the other way round."""
        with self.lock:
            self.descending = not self.descending if column == self.column else begins_descending(column)
            self.column = column
            self.pages.go_to(0)

    def choose(self, outcome: Outcome) -> None:
        with self.lock:
            self.outcome = outcome
            self.pages.go_to(0)

    def look_for(self, words: str, task: str | None) -> None:
        """List what has these words, and is of this task, if there still is one of it."""
        with self.lock:
            known = {row.task for row in self._library.rows()}
            words = words[:LONGEST_WORDS]
            task = task if task in known else None
            if (words, task) != (self.words, self.task):
                self.words, self.task = words, task
                self.pages.go_to(0)


@dataclass(frozen=True)
class Action:
    """Something to be done with the selected recordings."""

    label: str
    hint: str
    run: Callable[[tuple[str, ...]], None]
    most: int | None = None
    """Recordings that it can take at once."""
    named: str = ""
    """Its name among the commands; empty leaves it to the buttons."""
    key: HotkeyKey | None = None
    modifier: KeyModifier | None = None


def walking(listed: LibraryList) -> list[Command]:
    """To go through the table and select in it."""

    def move(by: int, held: int = 0) -> Callable[[], None]:
        return lambda: listed.move(by, held)

    return [
        Command("The next recording of the table", move(1), "arrowdown"),
        Command("The recording before it", move(-1), "arrowup"),
        Command("Select the next recording too", move(1, RANGE), "arrowdown", "shift"),
        Command("Select the one before it too", move(-1, RANGE), "arrowup", "shift"),
        Command("The next page of recordings", lambda: listed.pages.turn(1), "pagedown"),
        Command("The page of recordings before it", lambda: listed.pages.turn(-1), "pageup"),
        Command("Select this recording, or no longer", listed.toggle_cursor, "X"),
        Command("Select all recordings that are listed", listed.select_all, "A", "cmd/ctrl"),
    ]
