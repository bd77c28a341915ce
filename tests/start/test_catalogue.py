"""The list of tasks: its entries, what it refuses, and ManiSkill's cached thumbnails."""

from __future__ import annotations

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
from workbench.machine.loop import result_of
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


@pytest.fixture
def searches(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """One entry for each search of the folder."""
    searches, find = list[int](), catalogue_module.find_task_files
    counted = lambda *given: (searches.append(1), find(*given))[1]  # noqa: E731
    monkeypatch.setattr(catalogue_module, "find_task_files", counted)
    return searches


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


def test_the_examples_and_maniskills_tasks_are_listed(made: Callable[..., Catalogue]) -> None:
    rows = listed(made())
    assert {"minimal.py", "push_cube.py"} <= {one.name for one in rows[Section.EXAMPLES]}
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
    made: Callable[..., Catalogue], searches: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
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
    view, before = catalogue.view(), len(searches)
    until(lambda: catalogue.view() and len(searches) > before + 2, "further searches")
    assert catalogue.view() is view


def test_a_list_that_is_not_shown_does_not_follow_its_folder(
    made: Callable[..., Catalogue], searches: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(catalogue_module, "SEARCH_SECONDS", 0.01)
    monkeypatch.setattr(catalogue_module, "SHOWN_SECONDS", 0.05)
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
