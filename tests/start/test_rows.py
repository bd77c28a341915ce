"""The rows of the list of tasks: their texts, their order, and which of them a search shows."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.drive.waiting import until
from workbench.machine.loop import result_of
from workbench.start.catalogue import Catalogue, CatalogueView, Entry, Section
from workbench.start.panel import MAX_RECENT, Search, shown_rows, tasks_html
from workbench.start.recents import RecentTasks
from workbench.start.registered import NotDrawn, RegisteredView
from workbench.task.description import TaskOptions

TASK = "class Task(BaseEnv): pass\n"


class Registered:
    """A list of registered tasks that never changes."""

    def __init__(self, view: RegisteredView) -> None:
        self.view = view
        self.started = 0
        self.on_change: Any = None

    def start(self) -> None:
        self.started += 1

    def close(self) -> None: ...


BASE = TaskOptions(3, seed=7, rules="stop", env_kwargs={"robot_uids": "panda"})


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[SimpleNamespace]:
    home = tmp_path / "home"
    (home / "lab" / "sub").mkdir(parents=True)
    (home / "other").mkdir()
    monkeypatch.setenv("HOME", str(home))
    why = {"Bad-v1": NotDrawn("it broke"), "Ycb-v1": NotDrawn("needs ycb", True)}
    registered: Any = Registered(
        RegisteredView(("Bad-v1", "Good-v1", "New-v1", "Ycb-v1"), frozenset({"Good-v1"}), why)
    )
    recents = RecentTasks(lambda: tmp_path / "state")
    catalogue = Catalogue(home / "lab", tmp_path / "recordings", recents, registered, BASE)
    yield SimpleNamespace(
        catalogue=catalogue, lab=home / "lab", home=home, registered=registered, top=tmp_path
    )
    catalogue.close()


def rows(catalogue: Catalogue, section: Section) -> list[Entry]:
    catalogue.refresh()
    until(lambda: not catalogue.view().searching, "the search")
    return [one for one in catalogue.view().entries if one.section is section]


def test_a_recent_task_opens_with_its_own_envs_and_this_runs_other_options(place: SimpleNamespace) -> None:
    files = [
        place.lab / "a.py",
        place.lab / "sub" / "b.py",
        place.home / "other" / "c.py",
        place.top / "d.py",
    ]
    for number, file in enumerate(files, 1):
        file.write_text(TASK)
        place.catalogue.recents.add(str(file), TaskOptions(number, env_kwargs={"size": number}))
    place.catalogue.recents.add("PickCube-v1", TaskOptions(1))
    (place.top / "d.py").unlink()
    pick, *found = rows(place.catalogue, Section.RECENT)
    assert (pick.reference, pick.file, pick.env_id, pick.gone) == ("PickCube-v1", None, "PickCube-v1", False)
    assert pick.about == "1 env" and pick.options == replace(BASE, num_envs=1, env_kwargs={})
    assert [(one.name, one.file, one.gone, one.env_id) for one in found] == [
        ("d.py", files[3], True, ""),
        ("c.py", files[2], False, ""),
        ("b.py", files[1], False, ""),
        ("a.py", files[0], False, ""),
    ]
    assert [one.about.split(" · ") for one in found] == [
        [str(place.top), "4 envs, size=4"],
        ["~/other", "3 envs, size=3"],
        ["sub/", "2 envs, size=2"],
        ["this folder", "1 env, size=1"],
    ]
    assert [one.options for one in found] == [
        replace(BASE, num_envs=number, env_kwargs={"size": number}) for number in (4, 3, 2, 1)
    ]
    assert place.registered.started == 1


def test_registered_tasks_without_a_picture_come_last_with_the_reason(place: SimpleNamespace) -> None:
    found = rows(place.catalogue, Section.REGISTERED)
    assert [(one.reference, one.about, one.blank) for one in found] == [
        ("Good-v1", "", ""),
        ("New-v1", "", ""),
        ("Bad-v1", "it broke", "cannot be drawn here"),
        ("Ycb-v1", "needs ycb", "needs a download"),
    ]
    assert all(one.env_id == one.name == one.reference and one.options is None for one in found)
    html = tasks_html(place.catalogue.view(), Search(), "")
    assert html.count("/task_pictures/") == html.count('src="/task_pictures/Good-v1.jpg"') == 1
    assert html.index("Good-v1") < html.index("cannot be drawn here") < html.index("needs a download")


def test_files_of_the_folder_name_their_tasks_and_recordings_say_whether_there_are_any(
    place: SimpleNamespace,
) -> None:
    many = "".join(f"@register_env('T{k}-v1')\nclass T{k}(BaseEnv): pass\n" for k in range(4))
    (place.lab / "a\x1b.py").write_text("class One(BaseEnv): pass\nclass Two(BaseEnv): pass\n")
    (place.lab / "many.py").write_text(many)
    found = rows(place.catalogue, Section.FOLDER)
    assert [(one.name, one.about) for one in found] == [
        ("a\\x1b.py", "One, Two"),
        ("many.py", "T0-v1, T1-v1, T2-v1, …"),
    ]
    assert [one.file for one in found] == [place.lab / "a\x1b.py", place.lab / "many.py"]
    (none,) = rows(place.catalogue, Section.RECORDINGS)
    (place.top / "recordings").mkdir()
    (some,) = until(
        lambda: [one for one in rows(place.catalogue, Section.RECORDINGS) if one.about != none.about],
        "another text",
    )
    assert none.name == some.name == "recordings/"
    assert none.number == some.number and none.reference == ""


def test_a_task_just_written_is_a_row_at_once_and_stays_the_same_row(place: SimpleNamespace) -> None:
    (place.lab / "old.py").write_text(TASK)
    (old,) = rows(place.catalogue, Section.FOLDER)
    (place.lab / "new.py").write_text("@register_env('New-v2')\n" + TASK)
    for _ in range(2):
        entry = place.catalogue.add_file(place.lab / "new.py", "New-v2")
    listed = [one for one in place.catalogue.view().entries if one.section is Section.FOLDER]
    assert listed == [entry, old] and (entry.name, entry.about) == ("new.py", "New-v2")
    assert place.catalogue.entry(entry.number) == entry
    assert [one.number for one in rows(place.catalogue, Section.FOLDER)] == [entry.number, old.number]


def test_a_typed_class_of_a_file_or_a_module_is_named(
    place: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    (place.lab / "envs.py").write_text(TASK)
    monkeypatch.chdir(place.lab)

    def typed(text: str) -> Entry | None:
        return result_of(place.catalogue.typed(text))

    by_file, by_module = typed("./envs.py:Task"), typed("envs:Other")
    assert by_file is not None and by_file.reference == f"{place.lab / 'envs.py'}:Task"
    assert by_file.file == place.lab / "envs.py" and by_file.about == "Task"
    assert by_module is not None and by_module.reference == f"{place.lab / 'envs.py'}:Other"
    assert by_file.number != by_module.number and by_file.lasting == by_file.reference
    again = typed("envs.py:Task")
    assert again is not None and again.number == by_file.number
    assert all(place.catalogue.entry(one.number) == one for one in (by_file, by_module))
    assert [typed(text) for text in ("push cube", "", "gone_module:Task", "PickCube-v1")] == [None] * 4


def entry(number: int, section: Section, name: str, about: str = "", **more: Any) -> Entry:
    return Entry(number, section, name, about, f"/w/{name}", **more)


ROWS = (
    *(entry(k, Section.RECENT, f"recent{k}.py", "~/lab · 2 envs") for k in range(MAX_RECENT + 2)),
    entry(20, Section.FOLDER, "push_cube.py", "Push-v1, Pull-v1"),
    entry(21, Section.EXAMPLES, "minimal.py", "The least that a task can be"),
    entry(22, Section.REGISTERED, "PushCube-v1", env_id="PushCube-v1"),
)


@pytest.mark.parametrize(
    ("words", "found"),
    [
        ("cube", [20, 22]),
        ("CUBE push", [20, 22]),
        ("cube pull", [20]),
        ("ush-v1", []),
        ("pull", [20]),
        ("least", [21]),
        ("east", []),
        ("maniskill", [22]),
        ("folder", [20]),
        ("  ", [*range(MAX_RECENT), 20, 21, 22]),
        ("recent", [*range(MAX_RECENT + 2)]),
    ],
)
def test_a_search_looks_into_names_and_at_the_beginning_of_other_words(words: str, found: list[int]) -> None:
    shown = shown_rows(CatalogueView(ROWS), Search(words))
    assert [one.number for rows in shown.values() for one in rows] == found


def test_a_typed_file_is_a_row_of_its_own_unless_it_is_listed() -> None:
    typed = entry(30, Section.TYPED, "elsewhere.py")
    shown = shown_rows(CatalogueView(ROWS), Search("/w/elsewhere.py", typed))
    assert shown[Section.TYPED] == [typed]
    listed = replace(typed, reference=ROWS[-3].reference)
    shown = shown_rows(CatalogueView(ROWS), Search("push_cube.py", listed))
    assert not shown[Section.TYPED] and [one.number for one in shown[Section.FOLDER]] == [20]


def section_of(view: CatalogueView, words: str = "") -> str:
    """The page's text of sections without rows, for comparisons."""
    return tasks_html(view, Search(words), "")


def test_each_empty_section_says_what_happens() -> None:
    empty = CatalogueView(folder="/the/lab")
    searching, none = section_of(replace(empty, searching=True)), section_of(empty)
    assert "/the/lab" in searching and "/the/lab" in none and "BaseEnv" in none and "BaseEnv" not in searching
    assert "too deep" in section_of(replace(empty, left_out="too deep"))
    full = CatalogueView(ROWS, folder="/the/lab", left_out="too deep")
    assert "too deep" in section_of(full) and "too deep" not in section_of(full, "cube")
    assert "/the/lab" not in section_of(full) and "/the/lab" not in section_of(empty, "cube")
    with_ids = RegisteredView(("A-v1", "B-v1", "C-v1"), frozenset({"A-v1"}), {"B-v1": NotDrawn("x")})
    for view, said, not_said in (
        (RegisteredView(problem="It failed."), "It failed.", "Loading"),
        (RegisteredView(doing="listing"), "Loading", "of 0"),
        (replace(with_ids, doing="drawing C-v1"), "1 of 3", "Loading"),
    ):
        html = section_of(replace(full, registered=view))
        assert said in html and not_said not in html
        assert said not in section_of(replace(full, registered=view), "cube")
    done = replace(with_ids, pictures=frozenset({"A-v1", "C-v1"}), doing="drawing C-v1")
    assert done.waiting == 0 and with_ids.waiting == 1
    for view in (RegisteredView(), with_ids, done):
        html = section_of(replace(full, registered=view))
        assert "Loading" not in html and "of 3" not in html


def test_the_open_task_and_the_best_match_are_marked() -> None:
    view = CatalogueView(ROWS)
    plain = tasks_html(view, Search("cube"), "", lambda row: False, "search")
    opened = tasks_html(view, Search("cube"), "", lambda row: row.number == 20, "search")
    assert plain != opened, "the open task is marked, and Enter opens another"
    assert "loading Push" in tasks_html(view, Search("cube"), "loading Push")
    assert "not a file" in tasks_html(view, Search("/x.py", why_not="not a file"), "")
