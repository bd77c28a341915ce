"""The list of tasks on a page: search, sections, what is said where nothing is, and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.drive.panels import Clock, Panels
from workbench.jobs.task import TaskOptions
from workbench.session.tasks.catalogue import Catalogue, CatalogueView, Entry, Section
from workbench.session.tasks.recents import RecentTasks
from workbench.session.tasks.registered import NotDrawn, RegisteredTasks, RegisteredView
from workbench.ui.tasks.task_list import (
    CREATE,
    OPEN,
    OpenDialog,
    TaskList,
    picture_route,
    tasks_html,
)

PUSH = Entry(1, Section.FOLDER, "push.py", "Push-v1", "/w/push.py", Path("/w/push.py"))
PICK = Entry(2, Section.REGISTERED, "PickCube-v1", "", "PickCube-v1", env_id="PickCube-v1")
EVIL = Entry(3, Section.RECENT, "<b>x.py", "a & b", '/w/"><script>.py', Path("/w/x.py"), gone=True)


class Chosen:
    """Keeps what was chosen."""

    def __init__(self, catalogue: Catalogue) -> None:
        self.catalogue, self.numbers = catalogue, list[int]()
        self.says = ""
        self.created: list[tuple[str, int]] = []

    def choose(self, number: int) -> None:
        self.numbers.append(number)

    def create(self, name: str, template: int) -> None:
        if name == "taken":
            raise ValueError("There is a file taken.py already.")
        self.created.append((name, template))

    def doing(self) -> str:
        return self.says

    def is_open(self, entry: Entry) -> bool:
        return entry.name == "push.py"


@pytest.fixture
def chosen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Chosen:
    monkeypatch.setattr(RegisteredTasks, "start", lambda self: None)
    for name in ("push.py", "pull.py"):
        (tmp_path / name).write_text("class Task(BaseEnv): pass\n")
    recents = RecentTasks(lambda: tmp_path / "state")
    catalogue = Catalogue(tmp_path, tmp_path / "recordings", recents, RegisteredTasks(), TaskOptions())
    catalogue._search()
    return Chosen(catalogue)


def number_of(chosen: Chosen, name: str) -> int:
    return next(one.number for one in chosen.catalogue.view().entries if one.name == name)


def sent(number: int, held: int = 0, press: int = 1) -> int:
    """As ``wb.choose`` of the page sends a press on a row."""
    return press * 10**8 + number * 8 + held


def test_a_press_on_a_row_chooses_it_and_what_is_not_listed_chooses_nothing(
    panels: Panels, chosen: Chosen, clock: Clock
) -> None:
    done: list[bool] = []
    listed = TaskList(panels.server, chosen, lambda: done.append(True), clock)
    listed.draw()
    push = number_of(chosen, "push.py")
    assert f'data-row="{push}"' in panels.html("wb-tasks")
    for number in (0, push + 500, 10**6):
        panels.claim("tasks", sent(number, press=number % 80 + 2))
    panels.claim("tasks", sent(push, held=4, press=5))  # the second press of a double click
    panels.settle()
    assert chosen.numbers == [] and done == []
    panels.claim("tasks", sent(push))
    panels.settle()
    assert chosen.numbers == [push] and done == [True]


def test_the_search_leaves_what_has_all_words_and_can_be_cleared(
    panels: Panels, chosen: Chosen, clock: Clock
) -> None:
    listed = TaskList(panels.server, chosen, clock=clock)
    panels.set("Search", "PUSH .py")
    clock.passes()
    listed.draw()
    html = panels.html("wb-tasks")
    assert 'data-words="PUSH .py"' in html and "push.py" in html and "pull.py" not in html
    panels.set("Search", "nothing like it")
    clock.passes()
    listed.draw()
    listed.draw()
    assert "Nothing in the list has" in panels.html("wb-tasks")
    panels.press("clear")
    clock.passes()
    listed.draw()
    assert "pull.py" in panels.html("wb-tasks") and panels.control("Search").value == ""


def test_a_new_task_is_asked_for_by_its_name_and_the_number_of_a_template(
    panels: Panels, chosen: Chosen, clock: Clock
) -> None:
    done: list[bool] = []
    TaskList(panels.server, chosen, lambda: done.append(True), clock)
    panels.set("Name", "taken")
    panels.press(CREATE)
    assert panels.client.notices == ["There is a file taken.py already."]
    assert chosen.created == [] and done == []
    panels.set("Name", " stack_two ")
    panels.set("Template", panels.control("Template").options[1])
    panels.press(CREATE)
    assert chosen.created == [("stack_two", 1)] and done == [True]


def html(view: CatalogueView, words: str = "", doing: str = "") -> str:
    return tasks_html(view, words, doing, "numbers", "clear")


def test_names_are_escaped_and_what_is_gone_says_so() -> None:
    text = html(CatalogueView((EVIL,)))
    assert "&lt;b&gt;x.py" in text and "<script>" not in text and "gone · a &amp; b" in text


def test_a_picture_or_the_reason_why_there_is_none_is_on_each_card() -> None:
    known = RegisteredView(("PickCube-v1", "Ycb-v1"), frozenset({"PickCube-v1"}), {"Ycb-v1": NotDrawn("x")})
    ycb = Entry(
        4, Section.REGISTERED, "Ycb-v1", "needs ycb", "Ycb-v1", env_id="Ycb-v1", blank="needs a download"
    )
    text = html(CatalogueView((PICK, ycb), registered=known))
    assert 'src="/task_pictures/PickCube-v1.jpg"' in text and "needs a download" in text
    assert 'src="/task_pictures/Ycb-v1.jpg"' not in text


def test_the_dialog_opens_once_chooses_and_goes(panels: Panels, chosen: Chosen, clock: Clock) -> None:
    asking: list[bool] = []
    dialog = OpenDialog(panels.server, chosen, asking.append, clock)
    dialog.add_button()
    dialog.draw(None)
    panels.press(OPEN)
    dialog.draw(None)
    assert "push.py" in panels.html("wb-tasks") and asking == [True]
    push = number_of(chosen, "push.py")
    panels.claim("tasks", sent(push))
    panels.settle()
    dialog.draw(None)
    assert chosen.numbers == [push] and panels.html("wb-tasks") == "" and asking == [True, False]
    dialog.open()
    dialog.open()
    assert panels.html("wb-tasks") == "", "the key that opened it closes it"


def test_a_picture_is_given_by_the_name_of_a_listed_task_alone(
    chosen: Chosen, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: Callable[[str], bytes | None] = {"PickCube-v1": b"\xff\xd8\xff"}.get
    monkeypatch.setattr(chosen.catalogue.registered, "picture", given)
    reply = picture_route(chosen.catalogue)
    assert reply("PickCube-v1.jpg") == (200, "image/jpeg", b"\xff\xd8\xff")
    for name in ("../tasks.json", "PickCube-v1.jpg/..", "", ".jpg", "/etc/passwd"):
        assert reply(name)[0] == 404
