"""The table's HTML and the effects of its rows and pills, on real files without a browser."""

from __future__ import annotations

import json
import re
import shutil
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Literal

import pytest

from tests.drive.panels import Clock, Panels, messages_sent
from tests.drive.waiting import until
from tests.episodes.library_files import describe
from workbench.library.commands import (
    DeleteSelected,
    FilterRows,
    NextRow,
    NextRows,
    NoteSelected,
    OpenRow,
    OpenSelected,
    PressRow,
    RescoreSelected,
    SelectAllRows,
    SelectNoRows,
    SortRows,
    TagSelected,
    UndoDelete,
)
from workbench.library.folder import Library
from workbench.library.listing import ROWS_PER_PAGE, Action
from workbench.library.panel import LibraryPanel
from workbench.library.rows import OpenVersion
from workbench.page.command import Command
from workbench.page.commands import AnswerDialog, CloseDialog
from workbench.page.widgets.visitors import Visitor

COUNT = ROWS_PER_PAGE + 5


@pytest.fixture
def library(child_process: None, tmp_path: Path) -> Iterator[Library]:
    for k in range(COUNT):
        describe(
            tmp_path,
            f"r{k:02}",
            id=f"id{k:02}",
            seed=k,
            written_at=f"2026-11-21T10:00:{k:02}",
            success=k % 2 == 0,
        )
    library = Library(tmp_path)
    library.refresh()
    yield library
    library.close()


class Host:
    """Records the recordings that the panel asks its host to open."""

    def __init__(self) -> None:
        self.opened: list[tuple[str, ...]] = []


@pytest.fixture
def host() -> Host:
    return Host()


class Table:
    """The library on a page, with methods to operate it."""

    def __init__(self, panel: LibraryPanel, panels: Panels, clock: Clock) -> None:
        self.panel, self.panels, self.clock = panel, panels, clock

    def draw(self) -> None:
        self.clock.passes()
        self.panel.draw()

    def ask(self, command: Command) -> None:
        """Press the part of the table that sends this command."""
        self.panels.ask(command)
        self.draw()

    def key(self, command: Command) -> None:
        self.panels.do(command)
        self.draw()

    def look_for(self, words: str) -> None:
        self.panels.type("Find", words)
        self.draw()

    def numbers(self) -> dict[str, int]:
        """Row numbers of the shown rows by id, in their order."""
        rows = re.findall(
            r'<tbody data-row="(\d+)".*?wb-library-name">(\w+)<', self.panels.html("wb-library"), re.DOTALL
        )
        return {re.sub(r"^r(?=\d)", "id", name): int(number) for number, name in rows}

    def press_row(self, id: str, held: Literal["", "ctrl", "shift", "ctrl+shift"] = "") -> None:
        assert self.panels.presses(PressRow(id=id))
        self.key(PressRow(id=id, held=held))

    def shown(self) -> list[str]:
        return list(self.numbers())

    def marked(self) -> list[str]:
        ids = {number: id for id, number in self.numbers().items()}
        marks = re.findall(r'data-row="(\d+)"\] \.wb-tick i \{', self.panels.html("<style"))
        return [ids[int(number)] for number in marks]

    def pictures(self) -> int:
        """Number of rows that show a thumbnail."""
        return self.panels.html("wb-library").count("<img")

    def selected(self) -> tuple[str, ...]:
        return self.panel.selected()


@pytest.fixture
def table(panels: Panels, library: Library, host: Host, clock: Clock) -> Iterator[Table]:
    panel = LibraryPanel(panels.server, library, host.opened.append)

    def do(command: Command, visitor: Visitor) -> None:
        if isinstance(command, CloseDialog):
            panel.close()
        else:
            panel.do(command, visitor)

    panels.visitors.do = do
    table = Table(panel, panels, clock)
    until(lambda: table.draw() or table.pictures() == ROWS_PER_PAGE, "the pictures")
    yield table
    panel.end()


def newest(first: int, last: int) -> list[str]:
    return [f"id{k:02}" for k in range(COUNT - 1, -1, -1)][first:last]


def test_pages_sorting_and_filters_work_by_press(table: Table) -> None:
    assert table.shown() == newest(0, ROWS_PER_PAGE)
    table.ask(NextRows())
    assert table.shown() == newest(ROWS_PER_PAGE, COUNT)
    table.ask(SortRows(column="seed"))
    assert table.shown()[:3] == ["id00", "id01", "id02"]
    table.ask(SortRows(column="seed"))
    assert table.shown()[0] == newest(0, 1)[0]
    table.ask(FilterRows(outcome="no success"))
    assert len(table.shown()) == COUNT // 2 and table.shown()[0] == "id53"
    table.look_for("seed:7")
    assert table.shown() == ["id07"]
    table.look_for("nothing has this")
    assert table.shown() == [] and "nothing has this" in table.panels.html("wb-library")


def test_rows_of_other_versions_are_marked_as_soon_as_the_open_version_changes(
    panels: Panels, library: Library, clock: Clock
) -> None:
    (recorded,) = {(row.task, row.source_hash) for row in library.view().rows}
    open_version = OpenVersion(*recorded)
    panel = LibraryPanel(panels.server, library, lambda ids: None, lambda: open_version)
    panel.draw()
    assert "another version of its source" not in panels.html("wb-library")
    open_version = OpenVersion(recorded[0], "edited")
    clock.passes()
    panel.draw()
    assert panels.html("wb-library").count("another version of its source") == ROWS_PER_PAGE


def test_a_task_filter_stays_until_it_has_no_recordings(
    table: Table, library: Library, tmp_path: Path
) -> None:
    assert not table.panels.shows("Task")
    describe(tmp_path, "other", id="other", task="Other-v1")
    library.refresh()
    table.draw()
    (first,) = {row.task for row in library.view().rows} - {"Other-v1"}
    tasks = {"all tasks": None, first: first, "Other-v1": "Other-v1"}
    assert table.panels.field("Task").options == tasks
    table.panels.set("Task", "Other-v1")
    table.draw()
    assert table.shown() == ["other"] and table.panels.field("Task").value == "Other-v1"
    library.delete(["other"])
    table.draw()
    table.draw()
    assert len(table.shown()) == ROWS_PER_PAGE and not table.panels.shows("Task")


@pytest.mark.parametrize("intact", [False, True])
def test_of_a_damaged_recording_the_intact_part_is_opened(
    table: Table, library: Library, host: Host, tmp_path: Path, intact: bool
) -> None:
    if intact:
        for file in (Path(__file__).parents[1] / "golden/v1/damaged").glob("*seed0008*"):
            shutil.copy(file, tmp_path)
    else:
        (tmp_path / "cut.rrd").write_bytes(b"RRF2 and nothing more")
    library.refresh()
    table.draw()
    (damaged,) = (row for row in library.view().rows if row.problem)
    table.panel.select([damaged.id])
    table.key(OpenSelected())
    assert host.opened == ([(damaged.id,)] if intact else [])


def test_pressed_rows_are_marked_and_opened(table: Table, host: Host) -> None:
    ids = newest(0, 9)
    table.press_row(ids[2])
    assert table.selected() == (ids[2],) and table.marked() == [ids[2]]
    table.press_row(ids[5], "shift")
    assert table.selected() == tuple(ids[2:6]) == tuple(table.marked())
    table.ask(OpenRow(id=ids[1]))
    assert host.opened == [(ids[1],)] and table.selected() == (ids[1],)


def test_keys_move_the_cursor_across_pages(table: Table) -> None:
    table.press_row(newest(0, ROWS_PER_PAGE)[-1])
    table.key(NextRow())
    assert table.selected() == tuple(newest(ROWS_PER_PAGE, ROWS_PER_PAGE + 1))
    assert table.shown() == newest(ROWS_PER_PAGE, COUNT) and "data-follow" in table.panels.html("<style")


def test_all_listed_rows_are_selected_and_only_listed_ones(table: Table, library: Library) -> None:
    table.press_row(newest(0, 1)[0])
    table.ask(SelectAllRows())
    assert len(table.selected()) == COUNT
    table.ask(FilterRows(outcome="success"))
    assert len(table.selected()) == (COUNT + 1) // 2
    library.delete(table.selected()[:3])
    table.draw()
    assert len(table.selected()) == (COUNT + 1) // 2 - 3
    shown = table.shown()
    table.ask(SelectNoRows())
    assert table.selected() == () and table.shown() == shown


def test_buttons_are_shown_for_valid_numbers_of_selected_rows(table: Table, host: Host) -> None:
    rescored: list[tuple[str, ...]] = []
    table.panel.add_action(Action("Rescore", RescoreSelected(), "With today's code", rescored.append))
    table.draw()
    assert table.panels.html("wb-pill").count("wb-off") >= 5
    ids = newest(0, 5)
    table.press_row(ids[0])
    table.press_row(ids[4], "shift")
    assert '<span class="wb-pill wb-off" title="At most 4 at once">Open' in table.panels.html("wb-pill")
    table.ask(RescoreSelected())
    assert rescored == [tuple(ids)]
    table.press_row(ids[4], "ctrl")
    table.ask(OpenSelected())
    assert host.opened == [tuple(ids[:4])]


def test_tags_note_and_deletion_work_through_their_dialogs(
    table: Table, library: Library, tmp_path: Path
) -> None:
    first, second = newest(0, 2)
    library.set_tags([first], add=["mine", "both"])
    library.set_tags([second], add=["both"])
    table.draw()
    table.press_row(first)
    table.press_row(second, "shift")
    table.ask(TagSelected())
    table.panels.type("", "good, new <b>")
    table.panels.ask(AnswerDialog())
    tags = [("mine", "good", "new <b>"), ("good", "new <b>")]
    until(lambda: [library.row(id).tags for id in (first, second)] == tags, "the tags")  # type: ignore[union-attr]
    table.draw()
    assert "new &lt;b&gt;" in table.panels.html("wb-library") and "<b>" not in table.panels.html("wb-library")
    table.ask(NoteSelected())
    table.panels.type("", "look again")
    table.panels.ask(AnswerDialog())
    until(lambda: library.row(second).note == "look again", "the note")  # type: ignore[union-attr]
    assert json.loads((tmp_path / f"r{second[2:]}.json").read_text())["workbench"]["note"] == "look again"
    table.draw()
    table.ask(DeleteSelected())
    table.panels.press("Cancel")
    assert len(library.view().rows) == COUNT
    table.ask(DeleteSelected())
    table.panels.ask(AnswerDialog())
    until(lambda: len(library.view().rows) == COUNT - 2, "two rows fewer")
    table.draw()
    assert table.selected() == ()
    assert "In the trash: 6 files" in table.panels.html()
    table.ask(UndoDelete())
    until(lambda: len(library.view().rows) == COUNT, "the rows again")
    table.draw()
    assert "In the trash" not in table.panels.html()


def test_a_hanging_disk_blocks_neither_the_table_nor_its_commands(
    table: Table, library: Library, monkeypatch: pytest.MonkeyPatch
) -> None:
    goes_on, read, set_note = threading.Event(), library.thumbnails, library.set_note
    begun: list[str] = []

    def thumbnails(ids: Sequence[str]) -> dict[str, bytes]:
        goes_on.wait(60)
        return read(ids)

    def note(ids: Sequence[str], text: str) -> None:
        begun.append(text)
        goes_on.wait(60)
        set_note(ids, text)

    monkeypatch.setattr(library, "thumbnails", thumbnails)
    monkeypatch.setattr(library, "set_note", note)
    table.ask(SortRows(column="seed"))
    assert table.shown()[:3] == ["id00", "id01", "id02"]
    assert table.pictures() == COUNT - 10, "thumbnails of the rows that were shown before"
    assert "no picture" not in table.panels.html("wb-library")
    for id, text in (("id00", "first"), ("id01", "second")):
        table.press_row(id)
        table.ask(NoteSelected())
        table.panels.type("", text)
        table.panels.ask(AnswerDialog())
    assert table.selected() == ("id01",) and not table.panels.shows("", "field")
    until(lambda: begun == ["first"], "the first note")
    goes_on.set()
    until(lambda: [library.row(f"id0{k}").note for k in (0, 1)] == ["first", "second"], "the notes")  # type: ignore[union-attr]
    until(lambda: table.draw() or table.pictures() == ROWS_PER_PAGE, "the pictures")


def test_only_the_first_answer_to_a_dialog_counts(table: Table, library: Library) -> None:
    table.press_row(newest(0, 1)[0])
    table.ask(DeleteSelected())
    for _ in range(3):
        table.panels.do(AnswerDialog())
    until(lambda: len(library.view().rows) == COUNT - 1, "one row fewer")
    table.draw()
    table.ask(UndoDelete())
    until(lambda: len(library.view().rows) == COUNT, "the row again")
    table.draw()
    assert not table.panels.presses(UndoDelete())


def test_an_edit_that_is_no_longer_possible_shows_the_reason(
    table: Table, library: Library, monkeypatch: pytest.MonkeyPatch
) -> None:
    client = table.panels.client
    monkeypatch.setattr(table.panels.server, "get_clients", lambda: {client.client_id: client})
    deleted = newest(0, 1)[0]
    table.press_row(deleted)
    table.ask(NoteSelected())
    library.delete([deleted])
    table.panels.ask(AnswerDialog())
    until(lambda: "not in the library any more" in " ".join(client.notices), "the reason")


def test_an_unchanged_table_is_not_sent_again(table: Table, library: Library) -> None:
    table.press_row(newest(0, 1)[0])
    library.refresh()
    before = messages_sent(table.panels.server)
    table.draw()
    assert messages_sent(table.panels.server) == before
    shown = [html.content for html in table.panels.htmls()]
    table.press_row(newest(1, 2)[0])
    now = [html.content for html in table.panels.htmls()]
    (marks,) = (new for old, new in zip(shown, now, strict=True) if new != old)
    assert marks.startswith("<style"), "only the style of the selection is sent, not the table"
