"""The table's HTML and what its hidden buttons do, on real files without a browser."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.drive.panels import Clock, Panels, told_so_far
from tests.drive.waiting import until
from tests.recording.library_files import describe
from workbench.recording.library.library import Library
from workbench.ui.library.listing import MOST_ROWS, RANGE, TOGGLE, Action
from workbench.ui.library.panel import OPEN, LibraryPanel
from workbench.ui.widgets.click_targets import NUMBERS
from workbench.ui.widgets.hotkeys import register

COUNT = MOST_ROWS + 5


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


class Told:
    """What the host of the panel was told."""

    def __init__(self) -> None:
        self.opened: list[tuple[str, ...]] = []


@pytest.fixture
def told() -> Told:
    return Told()


class Table:
    """The library on a page, with a hand on it."""

    def __init__(self, panel: LibraryPanel, panels: Panels, clock: Clock) -> None:
        self.panel, self.panels, self.clock = panel, panels, clock
        self.presses = 0

    def draw(self) -> None:
        self.clock.passes()
        self.panel.draw()

    def press(self, key: str) -> None:
        self.panels.press(f"library {key}")
        self.draw()

    def command(self, label: str) -> None:
        self.panels.command(label)
        self.draw()

    def look_for(self, words: str) -> None:
        self.panels.set("Find", words)
        self.draw()

    def numbers(self) -> dict[str, int]:
        """Of the rows that are shown, by id, in their order."""
        rows = re.findall(
            r'<tbody data-row="(\d+)".*?wb-library-name">(\w+)<', self.panels.html("wb-library"), re.DOTALL
        )
        return {re.sub(r"^r(?=\d)", "id", name): int(number) for number, name in rows}

    def send_row(self, sent: int) -> None:
        """As `choosable.html` writes it: with a running part, since the same number says nothing."""
        self.presses += 1
        self.panels.set("rows", NUMBERS * self.presses + sent)
        self.draw()

    def press_row(self, id: str, held: int = 0) -> None:
        self.send_row(self.numbers()[id] * 8 + held)

    def shown(self) -> list[str]:
        return list(self.numbers())

    def marked(self) -> list[str]:
        ids = {number: id for id, number in self.numbers().items()}
        marks = re.findall(r'data-row="(\d+)"\] \.wb-tick i \{', self.panels.html("<style"))
        return [ids[int(number)] for number in marks]

    def selected(self) -> tuple[str, ...]:
        return self.panel.selected()


@pytest.fixture
def table(panels: Panels, library: Library, told: Told, clock: Clock) -> Table:
    panel = LibraryPanel(panels.server, library, told.opened.append, clock)
    register(panels.server, panel.commands())
    panel.draw()
    return Table(panel, panels, clock)


NEXT = "Next recording in the table"
DELETE = "Delete the selected recordings"
ESCAPE = "Cancel, or show all recordings again"


def newest(first: int, last: int) -> list[str]:
    return [f"id{k:02}" for k in range(COUNT - 1, -1, -1)][first:last]


def test_pages_sorting_and_filters_are_pressed(table: Table) -> None:
    assert table.shown() == newest(0, MOST_ROWS)
    table.press("on")
    assert table.shown() == newest(MOST_ROWS, COUNT)
    table.press("sort seed")
    assert table.shown()[:3] == ["id00", "id01", "id02"]
    table.press("sort seed")
    assert table.shown()[0] == newest(0, 1)[0]
    table.press("outcome no success")
    assert len(table.shown()) == COUNT // 2 and table.shown()[0] == "id53"
    table.look_for("seed:7")
    assert table.shown() == ["id07"]
    table.look_for("nothing has this")
    assert table.shown() == [] and "nothing has this" in table.panels.html("wb-library")


def test_another_search_filter_or_order_begins_on_the_first_page(table: Table) -> None:
    for arrange in (
        lambda: table.look_for("r"),  # all of them have it
        lambda: table.look_for(""),
        lambda: table.press("outcome all"),
        lambda: table.press("sort seed"),
        lambda: table.press("sort seed"),
    ):
        table.press("on")
        assert len(table.shown()) == COUNT - MOST_ROWS
        arrange()
        assert len(table.shown()) == MOST_ROWS


def test_all_selects_what_is_listed_and_leaves_the_filter(table: Table) -> None:
    table.press("outcome no success")
    failed = table.shown()
    table.press_row(failed[0])
    table.press("select all")
    assert table.shown() == failed and len(table.selected()) == COUNT // 2
    table.press("select none")
    assert table.selected() == () and table.shown() == failed


def test_what_cannot_be_read_is_not_opened_and_says_why(
    table: Table, library: Library, told: Told, tmp_path: Path
) -> None:
    (tmp_path / "cut.rrd").write_bytes(b"RRF2 and nothing more")
    library.refresh()
    until(lambda: any(row.problem for row in library.view().rows), "the damaged file")
    table.draw()
    (damaged,) = (row for row in library.view().rows if row.problem)
    table.panel.select([damaged.id])
    table.command("Open the selected recordings")
    assert told.opened == []


def test_of_a_damaged_recording_what_is_left_is_opened(
    table: Table, library: Library, told: Told, tmp_path: Path
) -> None:
    for file in (Path(__file__).parents[2] / "golden/v1/damaged").glob("*seed0008*"):
        shutil.copy(file, tmp_path)
    library.refresh()
    until(lambda: any(row.problem for row in library.view().rows), "the damaged recording")
    table.draw()
    (damaged,) = (row for row in library.view().rows if row.problem)
    table.panel.select([damaged.id])
    table.command("Open the selected recordings")
    assert told.opened == [(damaged.id,)]


def test_rows_are_selected_as_in_a_list_of_files(table: Table, told: Told) -> None:
    ids = newest(0, 9)
    table.press_row(ids[2])
    assert table.selected() == (ids[2],) and table.marked() == [ids[2]]
    table.press_row(ids[5], RANGE)
    assert table.selected() == tuple(ids[2:6]) == tuple(table.marked())
    table.press_row(ids[3], TOGGLE)
    table.press_row(ids[8], TOGGLE)
    assert table.selected() == (ids[2], ids[4], ids[5], ids[8])
    table.press_row(ids[6], TOGGLE | RANGE)
    assert table.selected() == (ids[2], *ids[4:9])
    table.press_row(ids[0])
    assert table.selected() == (ids[0],)
    table.press_row(ids[1], OPEN)
    assert told.opened == [(ids[1],)] and table.selected() == (ids[1],)


def test_keys_walk_over_the_pages(table: Table) -> None:
    table.command(NEXT)
    assert table.selected() == (newest(0, 1)[0],)
    for _ in range(MOST_ROWS):
        table.command(NEXT)
    table.draw()
    assert table.selected() == tuple(newest(MOST_ROWS, MOST_ROWS + 1))
    assert table.shown() == newest(MOST_ROWS, COUNT) and "wb.follow" in table.panels.html("<style")
    table.command("Also select the previous recording")
    table.command("Also select the previous recording")
    assert table.selected() == tuple(newest(MOST_ROWS - 2, MOST_ROWS + 1))


def test_what_is_no_longer_listed_is_no_longer_selected(table: Table, library: Library, told: Told) -> None:
    table.command("Select all listed recordings")
    assert len(table.selected()) == COUNT
    table.press("outcome success")
    assert len(table.selected()) == (COUNT + 1) // 2
    library.delete(table.selected()[:3])
    table.draw()
    assert len(table.selected()) == (COUNT + 1) // 2 - 3


def test_a_press_on_a_row_that_has_moved_selects_that_row_and_made_up_numbers_select_nothing(
    table: Table, library: Library, tmp_path: Path
) -> None:
    wanted = newest(3, 4)[0]
    number = table.numbers()[wanted]
    describe(tmp_path, "new", id="new", written_at="2026-11-21T11:00:00")
    library.refresh()
    table.draw()
    assert table.shown()[0] == "new"
    table.send_row(number * 8)
    assert table.selected() == (wanted,)
    for made_up in (0, 7, 10**7, (COUNT + 2) * 8):
        table.send_row(made_up)
    assert table.selected() == (wanted,)


def test_buttons_are_there_for_as_many_as_they_take(table: Table, told: Told) -> None:
    rescored: list[tuple[str, ...]] = []
    table.panel.add_action(Action("Rescore", "With today's code", rescored.append))
    table.draw()
    assert table.panels.html("wb-pill").count("wb-off") >= 5
    ids = newest(0, 5)
    table.press_row(ids[0])
    table.press_row(ids[4], RANGE)
    assert '<span class="wb-pill wb-off" title="At most 4 at once">Open' in table.panels.html("wb-pill")
    table.press("action 4")
    assert rescored == [tuple(ids)]
    table.press_row(ids[4], TOGGLE)
    table.press("action 0")
    assert told.opened == [tuple(ids[:4])]


def test_tags_note_and_deletion_are_asked_for_and_done(
    table: Table, library: Library, tmp_path: Path
) -> None:
    first, second = newest(0, 2)
    library.set_tags([first], add=["mine", "both"])
    library.set_tags([second], add=["both"])
    table.draw()
    table.press_row(first)
    table.press_row(second, RANGE)
    table.press("action 1")
    assert not any(map(table.panels.takes, (NEXT, DELETE))) and table.panels.takes(ESCAPE)
    table.panels.set("", "good, new <b>")
    table.panels.press("Save")
    assert all(map(table.panels.takes, (NEXT, DELETE))) and not table.panels.takes(ESCAPE)
    assert [library.row(id).tags for id in (first, second)] == [  # type: ignore[union-attr]
        ("mine", "good", "new <b>"),
        ("good", "new <b>"),
    ]
    table.draw()
    assert "new &lt;b&gt;" in table.panels.html("wb-library") and "<b>" not in table.panels.html("wb-library")
    table.press("action 2")
    table.panels.set("", "look again")
    table.panels.press("Save")
    assert json.loads((tmp_path / f"r{second[2:]}.json").read_text())["workbench"]["note"] == "look again"
    table.press("action 3")
    table.panels.press("Cancel")
    assert len(library.view().rows) == COUNT
    table.press("action 3")
    table.panels.press("Delete")
    table.draw()
    assert len(library.view().rows) == COUNT - 2 and table.selected() == ()
    assert "In the trash: 6 files" in table.panels.html()
    table.press("undo")
    assert len(library.view().rows) == COUNT and "In the trash" not in table.panels.html()


def test_a_table_that_has_not_changed_is_not_sent_again(table: Table, library: Library) -> None:
    table.press_row(newest(0, 1)[0])
    library.refresh()
    before = told_so_far(table.panels.server)
    table.draw()
    assert told_so_far(table.panels.server) == before
    shown = [html.content for html in table.panels.htmls()]
    table.press_row(newest(1, 2)[0])
    now = [html.content for html in table.panels.htmls()]
    (marks,) = (new for old, new in zip(shown, now, strict=True) if new != old)
    assert marks.startswith("<style"), "which are selected, and not the table"
