"""The table's HTML and what its hidden buttons do, on real files without a browser."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
import viser

from tests.recording.library_files import describe
from workbench.recording.library import Library
from workbench.ui.commands import register
from workbench.ui.library_commands import Action
from workbench.ui.library_list import MOST_ROWS, RANGE, TOGGLE
from workbench.ui.library_panel import OPEN, LibraryPanel

COUNT = MOST_ROWS + 5


@pytest.fixture
def library(tmp_path: Path) -> Iterator[Library]:
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
        self.selections: list[tuple[str, ...]] = []


@pytest.fixture
def told() -> Told:
    return Told()


@pytest.fixture
def panel(server: viser.ViserServer, library: Library, told: Told) -> LibraryPanel:
    panel = LibraryPanel(server, library, told.opened.append, told.selections.append)
    register(server, panel.commands())
    panel.draw()
    return panel


def press(panel: LibraryPanel, server: viser.ViserServer, key: object) -> None:
    """As the browser does: the button with this id."""
    handle = server.gui._gui_input_handle_from_uuid[panel._presses._ids["library", key]]
    for callback in handle._impl.update_cb:
        callback(viser.GuiEvent(None, None, handle))  # type: ignore[arg-type]
    panel.draw()


def press_row(panel: LibraryPanel, id: str, held: int = 0) -> None:
    panel._on_row(panel._number_of[id] * 8 + held, None)
    panel.draw()


def shown(panel: LibraryPanel) -> list[str]:
    return [
        panel._ids[int(number) - 1] for number in re.findall(r'<tbody data-row="(\d+)"', panel._table.content)
    ]


def marked(panel: LibraryPanel) -> list[str]:
    numbers = re.findall(r'data-row="(\d+)"\] \.wb-tick i \{', panel._marks.content)
    return [panel._ids[int(number) - 1] for number in numbers]


def newest(first: int, last: int) -> list[str]:
    return [f"id{k:02}" for k in range(COUNT - 1, -1, -1)][first:last]


def test_pages_sorting_and_filters_are_pressed(panel: LibraryPanel, server: viser.ViserServer) -> None:
    assert shown(panel) == newest(0, MOST_ROWS)
    press(panel, server, "on")
    assert shown(panel) == newest(MOST_ROWS, COUNT)
    press(panel, server, ("sort", "seed"))
    assert shown(panel)[:3] == ["id00", "id01", "id02"]
    press(panel, server, ("sort", "seed"))
    assert shown(panel)[0] == newest(0, 1)[0]
    press(panel, server, "failed")
    assert len(shown(panel)) == COUNT // 2 and shown(panel)[0] == "id53"
    panel._list.look_for("seed:7", None)
    panel.draw()
    assert shown(panel) == ["id07"]
    panel._list.look_for("nothing has this", None)
    panel.draw()
    assert shown(panel) == [] and "nothing has this" in panel._table.content


def test_rows_are_selected_as_in_a_list_of_files(panel: LibraryPanel, told: Told) -> None:
    ids = newest(0, 9)
    press_row(panel, ids[2])
    assert panel.selected() == (ids[2],) and marked(panel) == [ids[2]]
    press_row(panel, ids[5], RANGE)
    assert panel.selected() == tuple(ids[2:6]) == tuple(marked(panel))
    press_row(panel, ids[3], TOGGLE)
    press_row(panel, ids[8], TOGGLE)
    assert panel.selected() == (ids[2], ids[4], ids[5], ids[8])
    press_row(panel, ids[6], TOGGLE | RANGE)
    assert panel.selected() == (ids[2], *ids[4:9])
    press_row(panel, ids[0])
    assert panel.selected() == (ids[0],) == told.selections[-1]
    assert told.selections[:2] == [(ids[2],), tuple(ids[2:6])]
    press_row(panel, ids[1], OPEN)
    assert told.opened == [(ids[1],)] and panel.selected() == (ids[1],)


def test_keys_walk_over_the_pages(panel: LibraryPanel) -> None:
    panel._list.move(1)
    assert panel.selected() == (newest(0, 1)[0],)
    for _ in range(MOST_ROWS):
        panel._list.move(1)
    panel.draw()
    assert panel.selected() == tuple(newest(MOST_ROWS, MOST_ROWS + 1))
    assert shown(panel) == newest(MOST_ROWS, COUNT) and "wb.follow" in panel._marks.content
    panel._list.move(-1, RANGE)
    panel._list.move(-1, RANGE)
    assert panel.selected() == tuple(newest(MOST_ROWS - 2, MOST_ROWS + 1))


def test_what_is_no_longer_listed_is_no_longer_selected(
    panel: LibraryPanel, server: viser.ViserServer, library: Library, told: Told
) -> None:
    panel._list.select_all()
    assert len(panel.selected()) == COUNT
    press(panel, server, "success")
    assert len(panel.selected()) == (COUNT + 1) // 2 == len(told.selections[-1])
    library.delete(panel.selected()[:3])
    panel.draw()
    assert len(panel.selected()) == (COUNT + 1) // 2 - 3


def test_a_press_on_a_row_that_has_moved_selects_that_row_and_made_up_numbers_select_nothing(
    panel: LibraryPanel, library: Library, tmp_path: Path
) -> None:
    wanted = newest(3, 4)[0]
    number = panel._number_of[wanted]
    describe(tmp_path, "new", id="new", written_at="2026-11-21T11:00:00")
    library.refresh()
    panel.draw()
    assert shown(panel)[0] == "new"
    panel._on_row(number * 8, None)
    assert panel.selected() == (wanted,)
    for made_up in (0, 7, 10**7, (len(panel._ids) + 1) * 8):
        panel._on_row(made_up, None)
    assert panel.selected() == (wanted,)


def test_buttons_are_there_for_as_many_as_they_take(
    panel: LibraryPanel, server: viser.ViserServer, told: Told
) -> None:
    judged: list[tuple[str, ...]] = []
    panel.add_action(Action("Judge again", "With today's code", judged.append))
    panel.draw()
    assert panel._tools.content.count("wb-off") >= 5
    ids = newest(0, 5)
    press_row(panel, ids[0])
    press_row(panel, ids[4], RANGE)
    assert '<span class="wb-pill wb-off" title="At most 4 at once">Open' in panel._tools.content
    press(panel, server, ("action", 4))
    assert judged == [tuple(ids)]
    press_row(panel, ids[4], TOGGLE)
    press(panel, server, ("action", 0))
    assert told.opened == [tuple(ids[:4])]


def answer(server: viser.ViserServer, label: str, typed: str | None = None) -> None:
    handles = list(server.gui._gui_input_handle_from_uuid.values())
    if typed is not None:
        field = next(h for h in handles if isinstance(h, viser.GuiTextHandle) and h.label == "")
        field.value = typed
    button = next(h for h in handles if isinstance(h, viser.GuiButtonHandle) and h.label == label)
    for callback in button._impl.update_cb:
        callback(viser.GuiEvent(None, None, button))  # type: ignore[arg-type]


def test_tags_note_and_deletion_are_asked_for_and_done(
    panel: LibraryPanel, server: viser.ViserServer, library: Library, tmp_path: Path
) -> None:
    first, second = newest(0, 2)
    library.set_tags([first], add=["mine", "both"])
    library.set_tags([second], add=["both"])
    panel.draw()
    press_row(panel, first)
    press_row(panel, second, RANGE)
    press(panel, server, ("action", 1))
    assert all(key.disabled for key in panel._keys) and not panel._escapes[0].disabled
    answer(server, "Save", "good, new <b>")
    assert panel._keys and not any(key.disabled for key in panel._keys) and panel._escapes[0].disabled
    assert [library.row(id).tags for id in (first, second)] == [  # type: ignore[union-attr]
        ("mine", "good", "new <b>"),
        ("good", "new <b>"),
    ]
    panel.draw()
    assert "new &lt;b&gt;" in panel._table.content and "<b>" not in panel._table.content
    press(panel, server, ("action", 2))
    answer(server, "Save", "look again")
    assert json.loads((tmp_path / f"r{second[2:]}.json").read_text())["workbench"]["note"] == "look again"
    press(panel, server, ("action", 3))
    answer(server, "Cancel")
    assert len(library.rows()) == COUNT
    press(panel, server, ("action", 3))
    answer(server, "Delete")
    panel.draw()
    assert len(library.rows()) == COUNT - 2 and panel.selected() == ()
    assert "In the trash: 6 files" in panel._trash.content
    press(panel, server, "undo")
    assert len(library.rows()) == COUNT and panel._trash.content == ""


def test_a_table_that_has_not_changed_is_not_sent_again(
    panel: LibraryPanel, library: Library, monkeypatch: pytest.MonkeyPatch
) -> None:
    press_row(panel, newest(0, 1)[0])
    sent: list[str] = []
    real = viser.GuiHtmlHandle.__setattr__

    def spy(handle: viser.GuiHtmlHandle, name: str, value: object) -> None:
        sent.append(name)
        real(handle, name, value)

    monkeypatch.setattr(viser.GuiHtmlHandle, "__setattr__", spy)
    library.refresh()
    panel.draw()
    assert sent == []
    press_row(panel, newest(1, 2)[0])
    assert sent == ["content"]  # which are selected, and not the table


def test_states_of_the_folder_are_said(server: viser.ViserServer, tmp_path: Path) -> None:
    library = Library(tmp_path / "none")
    panel = LibraryPanel(server, library, lambda ids: None)
    panel.draw()
    assert "Looking through the folder" in panel._filters.content
    library.refresh()
    panel.draw()
    assert "is not there" in panel._filters.content
    (tmp_path / "none").mkdir()
    library.refresh()
    panel.draw()
    assert (
        "There are no recordings in" in panel._table.content and "wb-bad-text" not in panel._filters.content
    )
    library.close()
