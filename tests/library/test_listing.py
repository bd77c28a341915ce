"""The library's list as a state machine: the effect of each command, with rows that appear and disappear."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st

from workbench.episodes.row import LibraryRow
from workbench.library.commands import (
    AlsoNextRow,
    AlsoPreviousRow,
    ClearRowFilter,
    FilterRows,
    FilterTask,
    LookForRows,
    NextRow,
    NextRows,
    OpenRow,
    PressRow,
    PreviousRow,
    PreviousRows,
    SelectAllRows,
    SelectNoRows,
    SortRows,
    ToggleRow,
    UndoDelete,
)
from workbench.library.listing import ROWS_PER_PAGE, LibraryList, Listing, apply, make_listing
from workbench.page.command import Command

Rows = tuple[LibraryRow, ...]
ROWS: Rows = tuple(
    LibraryRow(
        kind="workbench",
        id=f"r{k}",
        name=f"r{k}",
        place=(f"r{k}", 0),
        paths=(Path(f"r{k}.json"),),
        size=1,
        written=float(-k),
        seed=k,
        task="push" if k % 3 else "pick",
        success=k % 2 == 0,
    )
    for k in range(ROWS_PER_PAGE + 3)
)


def after(commands: Iterable[Command], rows: Rows = ROWS) -> Listing:
    """The list after these commands."""
    listed = LibraryList()
    for command in commands:
        listed = apply(make_listing(listed, rows), command)
    return make_listing(listed, rows)


def without(*ids: str) -> Rows:
    return tuple(row for row in ROWS if row.id not in ids)


def test_the_cursor_continues_from_the_place_of_a_deleted_row() -> None:
    listed = after([PressRow(id="r4")])
    there = make_listing(listed.list, without("r4"))
    assert there.selected == () and there.list.cursor is None
    assert make_listing(apply(there, NextRow()), there.library).selected == ("r5",)


def test_an_arrow_key_without_a_cursor_starts_on_the_shown_page() -> None:
    assert after([NextRows(), NextRow()]).selected == (f"r{ROWS_PER_PAGE}",)
    assert after([NextRows(), NextRows(), PreviousRows(), NextRow()]).selected == ("r0",)


def test_rows_hidden_by_a_filter_are_not_selected_when_shown_again() -> None:
    chosen = [SelectAllRows(), FilterRows(outcome="no success")]
    assert len(after(chosen).selected) == len(after(chosen).rows) == len(ROWS) // 2
    shown = after([*chosen, ClearRowFilter()])
    assert len(shown.rows) == len(ROWS) and len(shown.selected) == len(ROWS) // 2


def test_the_filter_of_a_task_is_removed_with_its_last_recording() -> None:
    listed = after([FilterTask(task="pick")])
    assert {row.task for row in listed.rows} == {"pick"}
    rest = tuple(row for row in ROWS if row.task != "pick")
    there = make_listing(listed.list, rest)
    assert there.rows == rest and there.list.arrangement.task is None
    assert make_listing(apply(there, UndoDelete()), ROWS).rows == ROWS


ids = st.sampled_from([*(row.id for row in ROWS[:9]), "gone"])
commands: st.SearchStrategy[Command] = st.one_of(
    st.builds(PressRow, id=ids, held=st.sampled_from(["", "ctrl", "shift", "ctrl+shift"])),
    st.builds(OpenRow, id=ids),
    st.sampled_from([NextRow(), PreviousRow(), AlsoNextRow(), AlsoPreviousRow(), NextRows(), PreviousRows()]),
    st.sampled_from([ToggleRow(), SelectAllRows(), SelectNoRows(), ClearRowFilter(), UndoDelete()]),
    st.builds(SortRows, column=st.sampled_from(["seed", "task", "date"])),
    st.builds(FilterRows, outcome=st.sampled_from(["all", "success", "no success", "broken"])),
    st.builds(LookForRows, words=st.sampled_from(["", "r1", "nothing has this"])),
    st.builds(FilterTask, task=st.sampled_from([None, "push", "pick", "none"])),
)
libraries = st.sampled_from([ROWS, without("r1", "r2"), tuple(row for row in ROWS if row.task == "push"), ()])


@given(st.lists(st.tuples(commands, libraries), max_size=30))
def test_any_commands_select_only_listed_rows(happened: list[tuple[Command, Rows]]) -> None:
    listed, before = LibraryList(), None
    for command, rows in happened:
        before = make_listing(listed, rows, before)
        listed = apply(before, command)
        there = make_listing(listed, rows, before)
        again = make_listing(listed, rows)
        assert (there.rows, there.list) == (again.rows, again.list), (
            "the list must not depend on an older one"
        )
        shown = {row.id for row in there.rows}
        assert there.list.selected == set(there.selected) <= shown
        assert there.list.cursor is None or there.list.cursor in shown
        assert bool(there.page) == bool(there.rows) and set(there.page) <= set(there.rows)
        before = there


def test_each_command_selects_orders_and_turns_as_it_says() -> None:
    """Rows are newest first: r0, r1, r2 ..."""

    def chosen(*commands: Command) -> tuple[str, ...]:
        return after(commands).selected

    three, five = PressRow(id="r3"), PressRow(id="r5", held="shift")
    assert chosen(three) == ("r3",) == chosen(PressRow(id="r9"), OpenRow(id="r3"))
    assert chosen(three, five) == ("r3", "r4", "r5")
    assert chosen(PressRow(id="r5"), PressRow(id="r3", held="shift")) == ("r3", "r4", "r5")
    assert chosen(three, five, PressRow(id="r4", held="shift")) == ("r3", "r4"), "the anchor stays"
    assert chosen(three, PressRow(id="r7", held="ctrl")) == ("r3", "r7")
    assert chosen(three, five, PressRow(id="r4", held="ctrl")) == ("r3", "r5")
    assert chosen(three, PressRow(id="r7", held="ctrl"), PressRow(id="r9", held="ctrl+shift")) == (
        "r3",
        "r7",
        "r8",
        "r9",
    )
    assert chosen(three, ToggleRow()) == () and chosen(three, ToggleRow(), ToggleRow()) == ("r3",)
    assert chosen(ToggleRow()) == () and chosen(three, PressRow(id="absent")) == ("r3",)
    assert chosen(three, NextRow()) == ("r4",) and chosen(three, PreviousRow()) == ("r2",)
    assert chosen(three, AlsoNextRow(), AlsoNextRow(), AlsoPreviousRow()) == ("r3", "r4")
    assert chosen(three, AlsoPreviousRow()) == ("r2", "r3")
    assert chosen(PressRow(id="r0"), PreviousRow()) == ("r0",)
    last = ROWS[-1].id
    assert chosen(PressRow(id=last), NextRow()) == (last,)
    assert len(chosen(SelectAllRows())) == len(ROWS) and chosen(SelectAllRows(), SelectNoRows()) == ()
    successes = chosen(FilterRows(outcome="success"), SelectAllRows())
    assert successes == tuple(row.id for row in ROWS if row.success)
    assert chosen(SelectAllRows(), FilterTask(task="pick"))[:2] == ("r0", "r3")
    found = after([LookForRows(words="seed:7"), SelectAllRows()])
    assert found.selected == ("r7",) == tuple(row.id for row in found.rows)
    assert len(after([LookForRows(words="seed:7"), FilterTask(task="pick"), ClearRowFilter()]).rows) == len(
        ROWS
    )


def test_pages_are_turned_and_begin_anew_with_another_order() -> None:
    def first(*commands: Command) -> str:
        return after(commands).page[0].id

    second = f"r{ROWS_PER_PAGE}"
    assert first() == "r0" and first(NextRows()) == second == first(NextRows(), NextRows())
    assert first(NextRows(), PreviousRows()) == "r0" == first(PreviousRows())
    assert len(after([NextRows()]).page) == 3
    assert first(NextRows(), SortRows(column="seed")) == "r0"
    assert first(SortRows(column="seed"), SortRows(column="seed")) == ROWS[-1].id, "the other direction"
    assert first(SortRows(column="date")) == ROWS[-1].id and first(SortRows(column="steps")) == "r0"
    for change in (FilterRows(outcome="success"), FilterRows(outcome="all"), LookForRows(words="r")):
        assert first(NextRows(), change) == "r0"
    assert after([NextRows(), LookForRows(words="")]).page[0].id == second, "nothing has changed"
    at = after([PressRow(id=f"r{ROWS_PER_PAGE - 1}"), NextRow()])
    assert at.page[0].id == second and at.list.follow and at.list.cursor == second
    assert not after([PressRow(id="r1")]).list.follow
