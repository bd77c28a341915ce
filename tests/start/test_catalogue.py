"""The list of tasks: its entries, what it refuses, and ManiSkill's cached thumbnails."""

from __future__ import annotations

import asyncio
import io
import re
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from PIL import Image

from tests.drive.waiting import TIMEOUT_SECONDS, until
from workbench.machine.loop import do, result_of
from workbench.start import catalogue as catalogue_module
from workbench.start import registered as registered_module
from workbench.start.catalogue import Catalogue, Entry, Section
from workbench.start.recents import RecentTasks
from workbench.start.registered import LIST_FILE, RegisteredTasks
from workbench.start.typed_path import NotAPath
from workbench.task.description import TaskOptions

TASK = "class Task(BaseEnv): pass\n"


def cached(folder: Path, ids: list[str], **more: object) -> Path:
    """Write a complete thumbnail cache."""
    folder.mkdir(parents=True, exist_ok=True)
    gone = {
        one: {"text": "needs ycb", "needs_download": True, "tries": 9, "last": time.time()} for one in ids
    }
    (folder / LIST_FILE).write_bytes(msgspec.json.encode({"ids": ids, "not_drawn": gone, **more}))
    return folder


@pytest.fixture
def made(tmp_path: Path) -> Iterator[Callable[..., Catalogue]]:
    """Makes catalogues of the folder ``work``."""
    found: list[Catalogue] = []

    def make(ids: list[str] | None = None) -> Catalogue:
        pictures = RegisteredTasks(folder=cached(tmp_path / "cache", ["PickCube-v1"] if ids is None else ids))
        work = tmp_path / "work"
        work.mkdir(exist_ok=True)
        recents = RecentTasks(lambda: tmp_path / "state")
        found.append(Catalogue(work, tmp_path / "recordings", recents, pictures, TaskOptions(3)))
        return found[-1]

    yield make
    for one in found:
        one.close()


def rows_of(catalogue: Catalogue) -> dict[Section, list[Entry]]:
    rows = catalogue.view().entries
    return {section: [one for one in rows if one.section is section] for section in Section}


def listed(catalogue: Catalogue, *in_folder: str) -> dict[Section, list[Entry]]:
    """The rows, once these files of the folder and ManiSkill's tasks are listed."""
    catalogue.refresh()
    until(lambda: not catalogue.view().searching, "the first search")
    names = lambda: [one.name for one in rows_of(catalogue)[Section.FOLDER]]  # noqa: E731
    until(lambda: names() == list(in_folder), f"the rows {in_folder}", seen=names)
    registered = catalogue.registered
    until(lambda: registered.view.ids and not registered.view.doing, "the ids", seen=lambda: registered.view)
    return rows_of(catalogue)


def test_all_sections_are_listed_with_what_they_open(made: Callable[..., Catalogue], tmp_path: Path) -> None:
    catalogue = made()
    (tmp_path / "work/sub").mkdir()
    (tmp_path / "work/sub/push.py").write_text(f"@register_env('Push-v1')\n{TASK}")
    catalogue.recents.add(str(tmp_path / "work/sub/push.py"), TaskOptions(8, env_kwargs={"size": 2}))
    catalogue.recents.add(str(tmp_path / "gone.py:Task"), TaskOptions())
    rows = listed(catalogue, "sub/push.py")
    gone, recent = rows[Section.RECENT]
    assert gone.gone and gone.name == "gone.py:Task" and not recent.gone
    assert "sub/" in recent.about and "8 envs" in recent.about and "size=2" in recent.about
    assert recent.options == TaskOptions(8, env_kwargs={"size": 2})
    (in_folder,) = rows[Section.FOLDER]
    assert (in_folder.name, in_folder.about) == ("sub/push.py", "Push-v1") and in_folder.options is None
    assert {"minimal.py", "push_cube.py"} <= {one.name for one in rows[Section.EXAMPLES]}
    assert [one.reference for one in rows[Section.RECORDINGS]] == [""]
    (pick,) = rows[Section.REGISTERED]
    assert (pick.reference, pick.file, pick.blank) == ("PickCube-v1", None, "needs a download")


def test_only_a_listed_number_is_an_entry_and_numbers_are_not_reused(
    made: Callable[..., Catalogue], tmp_path: Path
) -> None:
    catalogue = made()
    file = tmp_path / "work/push.py"
    file.write_text(TASK)
    (entry,) = listed(catalogue, "push.py")[Section.FOLDER]
    assert catalogue.entry(entry.number) == entry
    for number in (0, -1, 10**9, entry.number + 1000):
        assert catalogue.entry(number) is None
    file.unlink()
    (tmp_path / "work/other.py").write_text(TASK)
    (other,) = listed(catalogue, "other.py")[Section.FOLDER]
    assert other.number != entry.number and catalogue.entry(entry.number) is None
    file.write_text(TASK)
    again = {one.name: one.number for one in listed(catalogue, "other.py", "push.py")[Section.FOLDER]}
    assert again == {"push.py": entry.number, "other.py": other.number}


def test_the_list_follows_its_folder_and_is_unchanged_without_changes(
    made: Callable[..., Catalogue], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(catalogue_module, "SEARCH_SECONDS", 0.02)
    catalogue = made()
    work = tmp_path / "work"

    def seen() -> list[str]:
        return [f"{one.name}: {one.about}" for one in rows_of(catalogue)[Section.FOLDER]]

    def comes_to(*rows: str) -> None:
        until(lambda: seen() == list(rows), f"the rows {rows}", seen=seen)

    catalogue.refresh()
    comes_to()
    (work / "push.py").write_text(TASK)
    comes_to("push.py: Task")
    (work / "pull.py").write_text("class Task(BaseEnv)\n    pass\n")
    comes_to("pull.py: not Python yet: line 1", "push.py: Task")
    (work / "pull.py").write_text(TASK)
    comes_to("pull.py: Task", "push.py: Task")
    (work / "push.py").rename(work / "shove.py")
    comes_to("pull.py: Task", "shove.py: Task")
    (work / "pull.py").unlink()
    comes_to("shove.py: Task")
    until(lambda: not catalogue.registered.view.doing, "the ids")
    searches: list[int] = []
    find = catalogue_module.find_task_files
    monkeypatch.setattr(
        catalogue_module, "find_task_files", lambda *given: (searches.append(1), find(*given))[1]
    )
    view = catalogue.view()
    until(lambda: catalogue.view() and len(searches) > 2, "further searches")
    assert catalogue.view() is view


def test_a_list_that_is_not_shown_does_not_follow_its_folder(
    made: Callable[..., Catalogue], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(catalogue_module, "SEARCH_SECONDS", 0.01)
    monkeypatch.setattr(catalogue_module, "SHOWN_SECONDS", 0.05)
    searches: list[int] = []
    find = catalogue_module.find_task_files
    monkeypatch.setattr(
        catalogue_module, "find_task_files", lambda *given: (searches.append(1), find(*given))[1]
    )
    catalogue = made()
    assert not catalogue.view().entries, "there is no search before a request"
    catalogue.refresh()

    def rests() -> bool:
        before = len(searches)
        return not threading.Event().wait(0.2) and len(searches) == before > 0

    until(rests, "an end of the searches")
    before = len(searches)
    until(lambda: catalogue.view() and len(searches) > before, "another search, once the list is shown")


def test_a_change_during_a_search_is_found_by_the_next_search(
    made: Callable[..., Catalogue], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    passed_by, go_on, search = threading.Event(), threading.Event(), catalogue_module.find_task_files

    def slow(*asked: Any) -> Any:
        found = search(*asked)
        passed_by.set()
        go_on.wait(TIMEOUT_SECONDS)
        return found

    catalogue, file = made(), tmp_path / "work" / "push.py"
    file.write_text(TASK)
    monkeypatch.setattr(catalogue_module, "find_task_files", slow)
    catalogue.refresh()
    assert passed_by.wait(TIMEOUT_SECONDS)
    file.unlink()
    catalogue.refresh()
    go_on.set()
    until(lambda: not catalogue.view().searching, "the list")
    assert not rows_of(catalogue)[Section.FOLDER]


@pytest.mark.parametrize(
    "text",
    [
        "{work}/my task.py",
        "my task.py",
        "  {work}/my task.py \t",
        '"my task.py" ',
        "file://{work}/my%20task.py",
        "~/work/my task.py",
        "my task.py:88:4",
    ],
)
def test_a_typed_path_is_a_row(
    made: Callable[..., Catalogue], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str
) -> None:
    catalogue, work = made(), tmp_path / "work"
    monkeypatch.chdir(work)
    monkeypatch.setenv("HOME", str(tmp_path))
    (work / "my task.py").write_text(TASK)
    entry = result_of(catalogue.typed(text.format(work=work)))
    assert entry is not None and catalogue.entry(entry.number) == entry
    assert (entry.section, entry.file, entry.reference) == (
        Section.TYPED,
        work / "my task.py",
        str(work / "my task.py"),
    )


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("/no/such/push.py", "/no/such"),
        ("pusch.py", "push.py"),
        ("notes.txt", "not a .py file"),
        ("/dev/null", "/dev/null"),
        ("/" + "x" * 300 + ".py", "xxx"),
        ("/a\0b.py", "null byte"),
        ("/\ud800.py", "surrogates"),
    ],
)
def test_an_invalid_typed_path_is_explained(
    made: Callable[..., Catalogue], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, said: str
) -> None:
    catalogue, work = made(), tmp_path / "work"
    monkeypatch.chdir(work)
    (work / "push.py").write_text(TASK)
    (work / "notes.txt").write_text("")
    with pytest.raises(NotAPath, match=re.escape(said)):
        result_of(catalogue.typed(text.format(work=work)))


def test_a_cached_list_names_no_file_and_no_module(made: Callable[..., Catalogue]) -> None:
    wrong = ["/tmp/evil.py", "evil.py", "os:system", "../x", "a b", "", "~/x", "x" * 500, "\u202ePick-v1"]
    rows = listed(made([*wrong, "PickCube-v1"]))
    assert [one.reference for one in rows[Section.REGISTERED]] == ["PickCube-v1"]


def jpeg() -> bytes:
    written = io.BytesIO()
    Image.fromarray(np.zeros((6, 8, 3), np.uint8)).save(written, "JPEG")
    return written.getvalue()


def test_a_cached_thumbnail_is_shown_and_an_invalid_one_is_not(
    made: Callable[..., Catalogue], tmp_path: Path
) -> None:
    catalogue = made(["Good-v1", "Bad-v1", "Large-v1"])
    (tmp_path / "cache/Good-v1.jpg").write_bytes(jpeg())
    (tmp_path / "cache/Bad-v1.jpg").write_bytes(b"<svg onload=alert(1)>")
    (tmp_path / "cache/Large-v1.jpg").write_bytes(jpeg() + b"x" * registered_module.MAX_PICTURE_BYTES)
    (tmp_path / "cache/Secret-v1.jpg").write_bytes(jpeg())
    listed(catalogue)
    assert catalogue.registered.view.pictures == {"Good-v1"}
    assert catalogue.registered.picture("Good-v1") == jpeg()
    for name in ("Bad-v1", "Secret-v1", "../cache/Good-v1", "Good-v1.jpg", ""):
        assert catalogue.registered.picture(name) is None


@pytest.mark.slow
def test_maniskills_tasks_are_listed_and_drawn_once(child_process: None, tmp_path: Path) -> None:
    first = RegisteredTasks(folder=tmp_path)
    first.start()
    first.start()
    # The first tasks lack a download on most machines; this is not shown as broken.
    until(lambda: first.view.pictures or first.view.problem, "a picture", 280, lambda: first.view)
    view = first.view
    first.close()
    assert "PickCube-v1" in view.ids and not view.problem
    drawn = next(iter(view.pictures))
    picture = Image.open(io.BytesIO(first.picture(drawn) or b""))
    assert picture.size == (registered_module.WIDTH_PIXELS, registered_module.HEIGHT_PIXELS)
    assert np.asarray(picture).std() > 5, "the picture is not empty"
    again = RegisteredTasks(lambda: False, folder=tmp_path)
    again.start()
    until(lambda: again.view.pictures, "the cached one")
    again.close()
    assert again.view.ids == view.ids and again.view.why_not.keys() >= view.why_not.keys()


class Process:
    """Replaces the process that draws the thumbnails."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(registered_module, "Background", self.made)
        self.asked: list[str] = []
        self.ended = self.closed = 0

    def made(self, niceness: int) -> Process:
        assert niceness == 19
        return self

    def end(self) -> None:
        self.ended += 1

    def close(self) -> None:
        self.closed += 1

    async def ask(self, question: registered_module.DrawTask) -> object:
        self.asked.append(question.env_id)
        return await self.answer()

    async def answer(self) -> object:
        raise registered_module.JobFailed("it crashed")


class Hanging(Process):
    async def answer(self) -> object:
        await asyncio.Event().wait()


def test_a_task_that_cannot_be_drawn_is_not_retried_forever(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    process = Process(monkeypatch)
    cached(tmp_path, ["A-v1"], not_drawn={})
    for _ in range(4):
        tasks = RegisteredTasks(folder=tmp_path)
        tasks.start()
        until(lambda tasks=tasks: tasks.view.why_not and not tasks.view.doing, "its end")
        tasks.close()
        assert tasks.view.why_not["A-v1"].text == "it crashed"
    assert process.asked == ["A-v1"] * registered_module.MAX_TRIES


def test_a_thumbnail_that_times_out_is_omitted_and_its_process_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    process = Hanging(monkeypatch)
    monkeypatch.setattr(registered_module, "ANSWER_SECONDS", 0.01)
    tasks = RegisteredTasks(folder=cached(tmp_path, ["A-v1", "B-v1"], not_drawn={}))
    tasks.start()
    until(lambda: len(tasks.view.why_not) == 2 and not tasks.view.doing, "its end")
    assert process.ended >= 2 and "longer than" in tasks.view.why_not["A-v1"].text
    tasks.close()


def test_close_stops_a_running_thumbnail_and_starts_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    process = Hanging(monkeypatch)
    folder = cached(tmp_path, ["A-v1"], not_drawn={})
    tasks = RegisteredTasks(folder=folder)
    tasks.start()
    until(lambda: process.asked, "the question")
    tasks.close()
    until(lambda: not tasks.view.doing, "its end")
    assert process.closed == 1 and not tasks.view.why_not
    never = RegisteredTasks(folder=folder)
    never.close()
    never.start()
    do(lambda: None)
    assert never.view == registered_module.RegisteredView() and process.asked == ["A-v1"]
