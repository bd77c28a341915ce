"""The list of tasks on a page: search, sections, texts of empty lists, and refusals."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from tests.drive.panels import Panels
from tests.drive.waiting import until
from workbench.start.catalogue import Catalogue, CatalogueView, Entry, Section
from workbench.start.commands import (
    ClearTaskSearch,
    OpenFoundTask,
    OpenListedTask,
    OpenTaskList,
    TemplateName,
)
from workbench.start.panel import (
    CREATE,
    OPEN,
    OpenDialog,
    Search,
    TaskList,
    best_row,
    picture_route,
    tasks_html,
)
from workbench.start.recents import RecentTasks
from workbench.start.registered import RegisteredTasks
from workbench.task.description import TaskOptions
from workbench.task.new_task import TEMPLATES

PUSH = Entry(1, Section.FOLDER, "push.py", "Push-v1", "/w/push.py", Path("/w/push.py"))
PICK = Entry(2, Section.REGISTERED, "PickCube-v1", "", "PickCube-v1", env_id="PickCube-v1")
EVIL = Entry(3, Section.RECENT, "<b>x.py", "a & b", '/w/"><script>.py', Path("/w/x.py"), gone=True)


class Chosen:
    """Records the chosen entries."""

    def __init__(self, catalogue: Catalogue) -> None:
        self.catalogue, self.numbers = catalogue, list[int]()
        self.says, self.done = "", list[bool]()
        self.created: list[tuple[str, TemplateName]] = []

    def choose(self, number: int) -> None:
        self.numbers.append(number)

    async def create(self, name: str, template: TemplateName) -> None:
        if name == "taken":
            raise ValueError("There is a file taken.py already.")
        self.created.append((name, template))

    def doing(self) -> str:
        return self.says

    def is_open(self, entry: Entry) -> bool:
        return entry.name == "push.py"


@pytest.fixture
def chosen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Chosen]:
    monkeypatch.setattr(RegisteredTasks, "start", lambda self: None)
    for name in ("push.py", "pull.py"):
        (tmp_path / name).write_text("class Task(BaseEnv): pass\n")
    recents = RecentTasks(lambda: tmp_path / "state")
    catalogue = Catalogue(tmp_path, tmp_path / "recordings", recents, RegisteredTasks(), TaskOptions())
    catalogue.refresh()
    until(lambda: not catalogue.view().searching, "the first search")
    yield Chosen(catalogue)
    catalogue.close()


@pytest.fixture
def listed(panels: Panels, chosen: Chosen) -> TaskList:
    listed = TaskList(panels.server, chosen, lambda: chosen.done.append(True))
    panels.visitors.do = listed.do
    return listed


def number_of(chosen: Chosen, name: str) -> int:
    return next(one.number for one in chosen.catalogue.view().entries if one.name == name)


def test_a_press_on_a_row_chooses_it_and_an_unlisted_number_chooses_nothing(
    panels: Panels, chosen: Chosen, listed: TaskList
) -> None:
    listed.draw()
    push = number_of(chosen, "push.py")
    assert f'data-row="{push}"' in panels.html("wb-tasks")
    for number in (0, push + 500, 10**6):
        panels.do(OpenListedTask(number=number))
    assert chosen.numbers == [] and chosen.done == [] and len(panels.client.notices) == 3
    panels.ask(OpenListedTask(number=push))
    assert chosen.numbers == [push] and chosen.done == [True]


def test_the_search_keeps_entries_with_all_words_and_can_be_cleared(
    panels: Panels, chosen: Chosen, listed: TaskList
) -> None:
    panels.type("Search", "PUSH .py")
    listed.draw()
    html = panels.html("wb-tasks")
    assert "push.py" in html and "pull.py" not in html
    panels.type("Search", "nothing like it")
    listed.draw()
    listed.draw()
    assert "Nothing in the list has" in panels.html("wb-tasks")
    panels.ask(ClearTaskSearch())
    listed.draw()
    assert "pull.py" in panels.html("wb-tasks") and panels.typed("Search") == ""


def test_enter_opens_the_first_unopened_match_or_reports_that_there_is_none(
    panels: Panels, chosen: Chosen, listed: TaskList
) -> None:
    panels.type("Search", ".py")
    panels.do(OpenFoundTask())
    assert chosen.numbers == [number_of(chosen, "pull.py")]
    panels.type("Search", "push.py")
    panels.do(OpenFoundTask())
    assert chosen.numbers[1:] == [number_of(chosen, "push.py")]
    panels.type("Search", "nothing like it")
    panels.do(OpenFoundTask())
    assert len(chosen.numbers) == 2 and len(panels.client.notices) == 1


def test_a_path_is_searched_and_enter_opens_the_current_match(
    panels: Panels, chosen: Chosen, listed: TaskList, tmp_path: Path
) -> None:
    file = tmp_path / "elsewhere" / "other.py"

    def html() -> str:
        listed.draw()
        return panels.html("wb-tasks")

    panels.type("Search", str(file))
    until(lambda: "does not exist" in html(), "what is wrong with the path", seen=html)
    file.parent.mkdir()
    file.write_text("class Other(BaseEnv): pass\n")
    panels.do(OpenFoundTask())
    entry = chosen.catalogue.entry(chosen.numbers[0])
    assert entry is not None and entry.file == file
    panels.type("Search", f"{file}:Other")
    until(lambda: f"{file}:Other</b>" in html(), "the row of the path", seen=html)
    # The newest typed text counts, not the finished search.
    for words in (f"{file}", "push.py"):
        panels.type("Search", words)
    panels.do(OpenFoundTask())
    assert chosen.numbers[1:] == [number_of(chosen, "push.py")]
    assert panels.client.notices == []


@pytest.mark.parametrize("words", ["a/\0.py", "/\x1b[31m\0", "file://[/x.py"])
def test_words_that_are_no_valid_path_do_not_break_the_list(
    panels: Panels, chosen: Chosen, listed: TaskList, words: str
) -> None:
    panels.type("Search", words)
    panels.do(OpenFoundTask())
    listed.draw()
    assert chosen.numbers == [] and len(panels.client.notices) == 1


def test_the_best_match_is_an_existing_file() -> None:
    gone, there, other = replace(PUSH, gone=True), PUSH, PICK
    assert best_row([gone, there, other], lambda row: False) == there
    assert best_row([gone, there, other], lambda row: row is there) == other
    assert best_row([gone, there], lambda row: row is there) == there
    assert best_row([gone], lambda row: False) == gone and best_row([], lambda row: False) is None


def test_a_new_task_is_requested_with_name_and_template(
    panels: Panels, chosen: Chosen, listed: TaskList
) -> None:
    panels.set("Name", "taken")
    panels.press(CREATE)
    assert panels.client.notices == ["There is a file taken.py already."]
    assert chosen.created == [] and chosen.done == []
    panels.set("Name", " stack_two ")
    assert list(panels.field("Template").options.values()) == [one.name for one in TEMPLATES]
    panels.set("Template", next(one for one in panels.field("Template").options if "table" in one))
    panels.press(CREATE)
    assert chosen.created == [("stack_two", "tabletop")] and chosen.done == [True]
    listed.draw()
    assert panels.typed("Name") == " stack_two " and panels.field("Template").value.startswith("tabletop: ")


@pytest.mark.parametrize("name", ["x" * 201, "a\nb", "a\0b", "\u202eyp.kcats"])
def test_an_invalid_file_name_is_refused(panels: Panels, chosen: Chosen, listed: TaskList, name: str) -> None:
    panels.set("Name", name)
    listed.draw()
    assert len(panels.client.notices) == 1 and panels.typed("Name") == ""


def html(view: CatalogueView) -> str:
    return tasks_html(view, Search(), "")


def test_names_are_escaped_and_missing_files_are_marked() -> None:
    text = html(CatalogueView((EVIL,)))
    assert "&lt;b&gt;x.py" in text and "<script>" not in text and "gone · a &amp; b" in text


def test_the_dialog_opens_once_and_closes_on_a_choice(panels: Panels, chosen: Chosen) -> None:
    dialog = OpenDialog(panels.server, chosen)
    panels.visitors.do = dialog.do
    dialog.add_button()
    dialog.draw(None)
    panels.press(OPEN)
    dialog.draw(None)
    assert "push.py" in panels.html("wb-tasks")
    push = number_of(chosen, "push.py")
    panels.ask(OpenListedTask(number=push))
    dialog.draw(None)
    assert chosen.numbers == [push] and panels.html("wb-tasks") == ""
    panels.do(OpenListedTask(number=push))
    assert chosen.numbers == [push], "the dialog is closed"
    panels.do(OpenTaskList())
    dialog.draw(None)
    assert "push.py" in panels.html("wb-tasks")
    panels.do(OpenTaskList())
    panels.do(OpenListedTask(number=push))
    assert chosen.numbers == [push], "the dialog is closed, though it is still on the page"
    dialog.draw(None)
    assert panels.html("wb-tasks") == "", "the key that opened the dialog closes it"


def test_a_thumbnail_is_served_only_for_the_id_of_a_listed_task(
    chosen: Chosen, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: Callable[[str], bytes | None] = {"PickCube-v1": b"\xff\xd8\xff"}.get
    monkeypatch.setattr(chosen.catalogue.registered, "picture", given)
    reply = picture_route(chosen.catalogue)
    assert reply("PickCube-v1.jpg", {}) == (200, "image/jpeg", b"\xff\xd8\xff")
    for name in ("../tasks.json", "PickCube-v1.jpg/..", "", ".jpg", "/etc/passwd"):
        assert reply(name, {})[0] == 404
