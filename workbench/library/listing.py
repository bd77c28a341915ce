"""Filter, order, pages and selection of the library's list, and the actions on selected recordings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from workbench.episodes.row import LibraryRow
from workbench.library import commands
from workbench.library.rows import Column, Outcome, begins_descending, chosen, ordered
from workbench.page.command import Command
from workbench.page.widgets.paged import Paged

ROWS_PER_PAGE = 50
MAX_SEARCH_CHARACTERS = 200
_FIRST_PAGE = Paged(ROWS_PER_PAGE)
DOES: tuple[type[Command], ...] = (
    commands.PressRow,
    commands.OpenRow,
    commands.NextRow,
    commands.PreviousRow,
    commands.AlsoNextRow,
    commands.AlsoPreviousRow,
    commands.NextRows,
    commands.PreviousRows,
    commands.ToggleRow,
    commands.SelectAllRows,
    commands.SelectNoRows,
    commands.SortRows,
    commands.FilterRows,
    commands.FilterTask,
    commands.LookForRows,
    commands.ClearRowFilter,
)
"""Commands that `apply` handles; for any other command it returns `Listing.list` unchanged."""


@dataclass(frozen=True)
class RowArrangement:
    """Filter and order of the listed rows."""

    column: Column = "date"
    descending: bool = True
    outcome: Outcome = "all"
    words: str = ""
    task: str | None = None

    def of(self, rows: tuple[LibraryRow, ...]) -> tuple[LibraryRow, ...]:
        """The rows that pass the filter, in order."""
        return tuple(ordered(chosen(rows, self.words, self.outcome, self.task), self.column, self.descending))


@dataclass(frozen=True)
class LibraryList:
    """The user's choices in the list.

    Selection works as in a file manager: a press selects one row, ctrl toggles a row, shift selects the range
    from the anchor. Only listed rows can be selected: a deletion must not include rows that a filter hides.
    """

    arrangement: RowArrangement = RowArrangement()
    pages: Paged = _FIRST_PAGE
    selected: frozenset[str] = frozenset()
    """Ids of the selected rows."""
    cursor: str | None = None
    """Id of the row that was last pressed or reached by keys."""
    follow: bool = False
    """Whether browsers scroll to the cursor: true after a key, which may move the cursor out of view."""
    anchor: str | None = None
    """Id of the row from which shift selects."""
    place: int = 0
    """Row number of the cursor when it was set. If that row is deleted, the next arrow key goes to the row at
    this number."""


@dataclass(frozen=True, eq=False)
class Listing:
    """The list of the library's rows at one moment, as the page draws it; commands apply to it."""

    library: tuple[LibraryRow, ...]
    """All rows of the library."""
    wanted: LibraryList
    list: LibraryList
    """`wanted`, after deselecting rows that are not listed, removing the cursor from such a row, and dropping
    a filter for a task without recordings."""
    rows: tuple[LibraryRow, ...]
    """The listed rows, in order."""

    @property
    def page(self) -> tuple[LibraryRow, ...]:
        """The rows of the shown page."""
        places = self.list.pages.places(len(self.rows))
        return self.rows[places.start : places.stop]

    @property
    def selected(self) -> tuple[str, ...]:
        """Ids of the selected rows, in the order of the list."""
        selected = self.list.selected
        return tuple(row.id for row in self.rows if row.id in selected) if selected else ()


def make_listing(
    wanted: LibraryList, library: tuple[LibraryRow, ...], before: Listing | None = None
) -> Listing:
    """Filter and sort the library's rows, and drop choices that no longer apply.

    Args:
        library: all rows of the library.
        before: an earlier listing, whose unchanged parts are reused.
    """
    if before is not None and before.library is not library:
        before = None
    if before is not None and before.wanted is wanted:
        return before
    listed, arranged = wanted, wanted.arrangement
    if arranged.task is not None and all(row.task != arranged.task for row in library):
        arranged = replace(arranged, task=None)
        listed = replace(listed, arrangement=arranged, pages=_FIRST_PAGE)
    if before is not None and before.list.arrangement == arranged:
        rows = before.rows
    else:
        rows = arranged.of(library)
    ids = {row.id for row in rows}
    cursor = wanted.cursor if wanted.cursor in ids else None
    listed = replace(listed, selected=wanted.selected & ids, cursor=cursor)
    return Listing(library, wanted, listed, rows)


def apply(listing: Listing, command: Command) -> LibraryList:
    """The list after a command."""
    listed, rows = listing.list, listing.rows
    arranged = listed.arrangement
    match command:
        case commands.PressRow(id=id, held=held):
            return _press(listing, id, "ctrl" in held, "shift" in held)
        case commands.OpenRow(id=id):
            return _press(listing, id)
        case commands.ToggleRow() if listed.cursor is not None:
            return _press(listing, listed.cursor, toggle=True)
        case commands.NextRow():
            return _move(listing, 1)
        case commands.PreviousRow():
            return _move(listing, -1)
        case commands.AlsoNextRow():
            return _move(listing, 1, to_anchor=True)
        case commands.AlsoPreviousRow():
            return _move(listing, -1, to_anchor=True)
        case commands.NextRows():
            return replace(listed, pages=listed.pages.turned(1, len(rows)))
        case commands.PreviousRows():
            return replace(listed, pages=listed.pages.turned(-1, len(rows)))
        case commands.SelectAllRows():
            return replace(listed, selected=frozenset(row.id for row in rows))
        case commands.SelectNoRows():
            return replace(listed, selected=frozenset())
        case commands.SortRows(column=column):
            down = not arranged.descending if column == arranged.column else begins_descending(column)
            return _arrange(listed, replace(arranged, column=column, descending=down))
        case commands.FilterRows(outcome=outcome):
            return _arrange(listed, replace(arranged, outcome=outcome))
        case commands.LookForRows(words=words) if words[:MAX_SEARCH_CHARACTERS] != arranged.words:
            return _arrange(listed, replace(arranged, words=words[:MAX_SEARCH_CHARACTERS]))
        case commands.FilterTask(task=task) if task != arranged.task:
            return _arrange(listed, replace(arranged, task=task))
        case commands.ClearRowFilter():
            return _arrange(listed, replace(arranged, outcome="all", words="", task=None))
        case _:
            return listed


def _arrange(listed: LibraryList, arrangement: RowArrangement) -> LibraryList:
    return replace(listed, arrangement=arrangement, pages=_FIRST_PAGE)


def _press(listing: Listing, id: str, toggle: bool = False, to_anchor: bool = False) -> LibraryList:
    """Press this row; no effect if it is not listed."""
    ids = [row.id for row in listing.rows]
    if id not in ids:
        return listing.list
    return replace(_take(listing.list, ids, ids.index(id), toggle, to_anchor), follow=False)


def _move(listing: Listing, by: int, to_anchor: bool = False) -> LibraryList:
    """Move the cursor by `by` rows and select its row. Without a cursor, put it at its last row number, or at
    the first row of the shown page if that is further down."""
    listed, ids = listing.list, [row.id for row in listing.rows]
    if not ids:
        return listed
    if listed.cursor is not None:
        place = ids.index(listed.cursor) + by
    else:
        place = max(listed.place, listed.pages.places(len(ids)).start)
    place = min(max(place, 0), len(ids) - 1)
    return replace(_take(listed, ids, place, False, to_anchor), pages=listed.pages.at(place), follow=True)


def _take(listed: LibraryList, ids: list[str], place: int, toggle: bool, to_anchor: bool) -> LibraryList:
    """Put the cursor on a row and select it.

    Args:
        ids: ids of the listed rows.
        toggle: keep the selection of the other rows; deselect this row if it was selected.
        to_anchor: select all rows from the anchor to this row.
    """
    id = ids[place]
    listed = replace(listed, cursor=id, place=place)
    if to_anchor and listed.anchor in ids:
        first, last = sorted((ids.index(listed.anchor), place))
        between = frozenset(ids[first : last + 1])
        return replace(listed, selected=between | listed.selected if toggle else between)
    return replace(listed, selected=listed.selected ^ {id} if toggle else frozenset((id,)), anchor=id)


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
    """Whether the action reads the recordings; False if it also works for files that cannot be read."""
    salvages: bool = False
    """Whether the action uses the readable part of a damaged recording."""
