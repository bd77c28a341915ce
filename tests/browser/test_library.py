"""The table of recordings in a real Chromium, used as by a user."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import pytest
from playwright.sync_api import Browser, Locator, Page, expect

from tests.drive.page import page_at
from tests.drive.served import redrawn, served
from tests.drive.waiting import until
from tests.episodes.library_files import describe
from workbench.library.folder import Library
from workbench.library.panel import LibraryPanel
from workbench.page.command import Command
from workbench.page.commands import CloseDialog
from workbench.page.widgets.keys_and_palette import register
from workbench.page.widgets.visitors import Visitor

pytestmark = pytest.mark.browser
COUNT = 60


@dataclass
class Shown:
    page: Page
    panel: LibraryPanel
    library: Library
    opened: list[tuple[str, ...]]

    def row(self, place: int) -> Locator:
        return self.page.locator(".wb-library tbody[data-row]").nth(place)

    def seeds(self) -> list[int]:
        """Seeds of the listed rows, in the order of the page."""
        script = "() => [...document.querySelectorAll('.wb-library tbody')].map(b => +b.rows[0].cells[4].innerText)"
        return self.page.evaluate(script)

    def selects(self, *seeds: int) -> None:
        ids = tuple(f"id{seed:02}" for seed in seeds)
        until(lambda: self.panel.selected() == ids, f"{seeds} selected")


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory, browser: Browser) -> Iterator[Shown]:
    folder = tmp_path_factory.mktemp("recordings")
    for k in range(COUNT):
        when = f"2026-11-21T10:{k:02}:00"
        describe(folder, f"r{k:02}", id=f"id{k:02}", seed=k, written_at=when, tags=["even"] * (k % 2 == 0))
    library, opened = Library(folder), []
    library.watch()
    with served() as (gated_server, visitors):
        server = gated_server.server
        window = server.gui.add_panel()
        with window.add_tab("Library"):
            panel = LibraryPanel(server, library, opened.append)

        def do(command: Command, visitor: Visitor) -> None:
            if isinstance(command, CloseDialog):
                panel.close()
            else:
                panel.do(command, visitor)

        visitors.do = do
        register(server, visitors, frozenset({*panel.does, CloseDialog}), "page")
        window.dock_left()
        window.set_width(520)
        with redrawn(panel.draw, 1 / 30), page_at(browser, gated_server.url) as (page, errors):
            page.set_default_timeout(15_000)
            page.wait_for_selector(".wb-library tbody")
            yield Shown(page, panel, library, opened)
            assert not errors
    library.close()


@pytest.fixture
def shown(opened: Shown) -> Shown:
    """The page with all recordings, newest first, none selected."""
    opened.page.keyboard.press("Escape")
    while opened.seeds()[0] != COUNT - 1 or len(opened.seeds()) != 50:
        before = opened.seeds()
        opened.page.locator("[data-do]", has_text="date").first.click()
        until(lambda before=before: opened.seeds() != before, "another order")
    opened.panel.select(())
    opened.opened.clear()
    return opened


def test_rows_are_selected_by_mouse_and_keys_and_opened(shown: Shown) -> None:
    assert shown.seeds()[:2] == [59, 58]
    shown.row(1).click()
    shown.selects(58)
    shown.row(3).click(modifiers=["Shift"])
    shown.selects(58, 57, 56)
    shown.row(5).locator(".wb-tick").click()
    shown.selects(58, 57, 56, 54)
    shown.row(2).click(modifiers=["Control"])
    shown.selects(58, 56, 54)
    # The table is not sent again: the same element is there, now coloured.
    expect(shown.row(5)).to_have_css("background-color", "rgba(34, 139, 230, 0.22)")
    expect(shown.row(4)).not_to_have_css("background-color", "rgba(34, 139, 230, 0.22)")
    shown.page.keyboard.press("Enter")
    until(lambda: shown.opened == [("id58", "id56", "id54")], "opened", seen=lambda: shown.opened)
    shown.row(0).dblclick()
    until(lambda: shown.opened[1:] == [("id59",)], "opened by pressing twice", seen=lambda: shown.opened)


def test_a_key_right_after_a_press_acts_on_the_pressed_row(shown: Shown) -> None:
    for k in range(6):
        shown.row(k + 1).click()
        shown.row(k).click()
        shown.page.keyboard.press("Enter")
    wanted = [(f"id{COUNT - 1 - k:02}",) for k in range(6)]
    until(lambda: shown.opened == wanted, "opened", seen=lambda: shown.opened)


def test_keys_move_down_and_the_page_scrolls_along(shown: Shown) -> None:
    shown.row(0).click()
    shown.selects(59)
    for seed in range(58, 39, -1):
        shown.page.keyboard.press("ArrowDown")
        shown.selects(seed)
    expect(shown.row(19)).to_be_in_viewport(ratio=0.95)
    expect(shown.page.locator(".wb-library-tools")).to_be_in_viewport(ratio=0.95)
    shown.page.keyboard.press("PageDown")
    until(lambda: len(shown.seeds()) == COUNT - 50, "the second page")
    shown.page.keyboard.press("PageUp")
    until(lambda: shown.seeds()[0] == 59, "the first page")


def test_the_search_updates_while_typing(shown: Shown) -> None:
    field = shown.page.get_by_role("textbox").first
    field.fill("even r1")
    until(lambda: shown.seeds() == [18, 16, 14, 12, 10], "the rows with those words")
    field.fill("zebra")
    expect(shown.page.get_by_text("No recording contains “zebra”.")).to_be_visible()
    shown.page.get_by_text("Clear the filter").click()
    until(lambda: len(shown.seeds()) == 50, "all of them")
    expect(field).to_have_value("")
    pill = shown.page.locator(".wb-library-pills .wb-on")
    field.click()
    shown.page.keyboard.type("even")
    expect(pill).to_have_text(f"all {COUNT // 2} of {COUNT}")
    shown.panel.select(())
    shown.page.keyboard.press("Enter")  # back to the table
    shown.page.keyboard.press("ArrowDown")
    until(lambda: len(shown.panel.selected()) == 1, "one selected")
    shown.page.keyboard.press("Escape")
    expect(pill).to_have_text(f"all {COUNT}")
    expect(field).to_have_value("")
    field.click()
    shown.page.keyboard.type("even")
    expect(pill).to_have_text(f"all {COUNT // 2} of {COUNT}")
    shown.page.keyboard.press("Escape")
    expect(pill).to_have_text(f"all {COUNT}")
    expect(field).to_have_value("")


@pytest.mark.slow
def test_a_recording_is_tagged_deleted_and_restored(shown: Shown) -> None:
    page = shown.page
    page.locator("[data-do]", has_text="seed").first.click()
    until(lambda: shown.seeds()[0] == 0, "sorted by seed")
    shown.row(1).click()
    shown.selects(1)
    page.keyboard.press("t")
    save = page.get_by_role("button", name="Save", exact=True)
    expect(save).to_be_visible()
    # Letters and Enter in quick succession: all of them count.
    page.get_by_role("dialog").get_by_role("textbox").focus()
    page.keyboard.type("wobbly, good")
    page.keyboard.press("Enter")
    expect(shown.row(1).locator(".wb-library-tag")).to_have_text(["wobbly", "good"])
    expect(shown.row(1).locator(".wb-library-name")).to_have_text("r01")
    expect(save).to_be_hidden()
    page.keyboard.press("Shift+T")
    expect(page.get_by_role("dialog").get_by_role("textbox")).to_be_focused()
    page.keyboard.press("Escape")
    expect(save).to_be_hidden()
    page.keyboard.press("Delete")
    expect(page.get_by_text("Delete 1 recording (3 files")).to_be_visible()
    # While the question is open, Enter goes to its focused button and opens no recording.
    opened = len(shown.opened)
    page.get_by_role("button", name="Cancel").focus()
    page.keyboard.press("Enter")
    expect(page.get_by_text("Delete 1 recording (3 files")).to_be_hidden()
    assert len(shown.opened) == opened and len(shown.library.view().rows) == COUNT
    page.keyboard.press("Delete")
    expect(page.get_by_text("Delete 1 recording (3 files")).to_be_visible()
    page.keyboard.press("Escape")
    expect(page.get_by_text("Delete 1 recording (3 files")).to_be_hidden()
    page.keyboard.press("Delete")
    page.get_by_role("dialog").get_by_role("button", name="Delete", exact=True).click()
    until(lambda: shown.seeds()[:2] == [0, 2], "one row fewer")
    page.locator("[data-do]", has_text="undo delete").click()
    until(lambda: shown.seeds()[:2] == [0, 1], "the row again")


@pytest.mark.slow
def test_a_new_recording_appears_automatically_with_all_of_its_seed(shown: Shown) -> None:
    largest = 2**31 - 1
    describe(shown.library.folder, "new", id="new", seed=largest, written_at="2026-11-21T12:00:00")
    until(lambda: shown.seeds()[0] == largest, "the new row")
    assert shown.row(0).locator("td").nth(4).evaluate("cell => cell.scrollWidth <= cell.clientWidth")
    shown.row(0).click()
    shown.page.keyboard.press("Delete")
    shown.page.get_by_role("dialog").get_by_role("button", name="Delete", exact=True).click()
    until(lambda: shown.seeds()[0] == COUNT - 1, "the others alone")
