"""Each save by an editor gives one call with the final content on disk."""

from __future__ import annotations

import os
import queue
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from workbench.task import watch
from workbench.task.watch import SourceWatcher

pytestmark = pytest.mark.thorough

TIMEOUT_SECONDS = 20.0
"""Timeout for expected calls; no test asserts how soon they come."""


class Calls:
    """Records the calls of a watcher, with the content of the files at that moment."""

    def __init__(self) -> None:
        self.queue: queue.Queue[dict[str, str | None]] = queue.Queue()

    def __call__(self, paths: set[Path]) -> None:
        self.queue.put({path.name: path.read_text() if path.exists() else None for path in paths})

    def next(self) -> dict[str, str | None]:
        return self.queue.get(timeout=TIMEOUT_SECONDS)

    def until(self, expected: dict[str, str | None]) -> int:
        """Take calls until one is `expected`; returns how many were taken."""
        for number in range(1, 100):
            if self.next() == expected:
                return number
        raise AssertionError("too many calls")

    def comes_next(self, last: Path) -> bool:
        """Save another watched file; returns whether that save is the next call."""
        last.write_text(f"{last.read_text()}# again\n")
        return self.next() == {last.name: last.read_text()}


@pytest.fixture
def calls() -> Calls:
    return Calls()


@pytest.fixture
def watcher(calls: Calls) -> Iterator[SourceWatcher]:
    started = SourceWatcher(calls)
    yield started
    started.stop()


@pytest.fixture
def last(tmp_path: Path) -> Path:
    """A watched file in its own folder, whose save is reported after those of the other files."""
    path = tmp_path / "beside" / "last.py"
    path.parent.mkdir()
    path.write_text("")
    return path


@pytest.fixture
def file(watcher: SourceWatcher, tmp_path: Path, last: Path) -> Path:
    path = tmp_path / "task.py"
    path.write_text("a = 0\n")
    watcher.follow([path, last])
    return path


def write(path: Path, text: str) -> None:
    path.write_text(text)


def rename_over(path: Path, text: str) -> None:
    path.with_suffix(".tmp").write_text(text)
    os.replace(path.with_suffix(".tmp"), path)


def backup_and_create(path: Path, text: str) -> None:
    path.rename(path.with_suffix(".py~"))
    path.write_text(text)


def delete_and_create(path: Path, text: str) -> None:
    path.unlink()
    time.sleep(0.05)  # an editor takes that long, so the watcher sees that the file is missing
    path.write_text(text)


@pytest.mark.parametrize("save", [write, rename_over, backup_and_create, delete_and_create])
def test_every_way_of_saving_is_seen_repeatedly(
    save: Callable[[Path, str], None], file: Path, last: Path, calls: Calls
) -> None:
    for number in (1, 2, 3):
        save(file, f"a = {number}\n")
        assert calls.next() == {"task.py": f"a = {number}\n"}
    assert calls.comes_next(last)


def test_only_new_content_of_watched_files_counts(file: Path, last: Path, calls: Calls) -> None:
    os.utime(file)
    file.with_name("other.py").write_text("b = 1\n")
    file.write_text(file.read_text())
    assert calls.comes_next(last)


def test_a_deleted_file_is_reported_once_and_so_is_its_return(file: Path, last: Path, calls: Calls) -> None:
    file.unlink()
    assert calls.next() == {"task.py": None}
    assert calls.comes_next(last)
    file.write_text("a = 0\n")
    assert calls.next() == {"task.py": "a = 0\n"}


def test_a_save_that_truncates_first_is_not_seen_empty(file: Path, last: Path, calls: Calls) -> None:
    with open(file, "w") as opened:
        opened.flush()
        time.sleep(0.12)  # so that it is seen empty
        opened.write("a = 1\n")
    assert calls.next() == {"task.py": "a = 1\n"}
    assert calls.comes_next(last)


def test_a_folder_deleted_and_made_again_is_watched_again(
    watcher: SourceWatcher, calls: Calls, tmp_path: Path
) -> None:
    path = tmp_path / "project" / "task.py"
    for number in (1, 2):
        path.parent.mkdir()
        path.write_text(f"a = {number}\n")
        watcher.follow([path], {str(path): "a = 0\n"})
        calls.until({"task.py": f"a = {number}\n"})
        path.write_text(f"a = {number}{number}\n")
        calls.until({"task.py": f"a = {number}{number}\n"})
        shutil.rmtree(path.parent)
        calls.until({"task.py": None})


def test_a_save_between_reading_and_watching_is_not_lost(
    watcher: SourceWatcher, last: Path, calls: Calls, tmp_path: Path
) -> None:
    path = tmp_path / "task.py"
    path.write_text("a = 1\n")
    watcher.follow([path], {str(path): "a = 0\n"})
    assert calls.next() == {"task.py": "a = 1\n"}
    watcher.follow([path, last], {str(path): "a = 1\n"})
    assert calls.comes_next(last)


def test_files_in_several_folders_are_watched_and_released(
    watcher: SourceWatcher, last: Path, calls: Calls, tmp_path: Path
) -> None:
    one, two = tmp_path / "one.py", tmp_path / "below" / "two.py"
    two.parent.mkdir()
    for path in (one, two):
        path.write_text("a = 0\n")
    watcher.follow([one])
    watcher.follow([one, two])
    two.write_text("a = 1\n")
    assert calls.next() == {"two.py": "a = 1\n"}
    watcher.follow([one, last])
    two.write_text("a = 2\n")
    one.write_text("a = 2\n")
    assert calls.next() == {"one.py": "a = 2\n"}
    assert calls.comes_next(last)


def test_a_save_without_a_file_system_event_is_seen_by_polling(
    file: Path, last: Path, calls: Calls, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A network mount may answer with attributes cached some seconds ago.
    monkeypatch.setattr(watch, "_status", lambda path: ())
    for number in (1, 2):
        file.write_text(f"a = {number}\n")
        assert calls.next() == {"task.py": f"a = {number}\n"}
    assert calls.comes_next(last)


def test_a_save_of_what_is_no_text_is_a_change_too(file: Path, last: Path, calls: Calls) -> None:
    seen: queue.Queue[set[Path]] = queue.Queue()
    watcher = SourceWatcher(seen.put)
    watcher.follow([file])
    for raw in (b"\xff\xfe one", b"\xff\xfe two"):
        file.with_suffix(".tmp").write_bytes(raw)
        file.with_suffix(".tmp").replace(file)
        assert seen.get(timeout=TIMEOUT_SECONDS) == {file}
    watcher.stop()


def test_a_change_before_another_file_is_followed_is_still_seen(
    watcher: SourceWatcher, last: Path, calls: Calls, tmp_path: Path
) -> None:
    """A second `follow` must not take the file's present content for known."""
    path = tmp_path / "task.py"
    path.write_text("a = 1\n")
    watcher.follow([path], {str(path): "a = 0\n"})
    watcher.follow([path, last])
    assert calls.next() == {"task.py": "a = 1\n"}


Many = Callable[[int, int], list[Path]]


@pytest.fixture
def many(watcher: SourceWatcher, tmp_path: Path, calls: Calls, monkeypatch: pytest.MonkeyPatch) -> Many:
    """Watch files in several folders, the first one saved last; each poll checks only some of them, and reads a file
    only if its attributes changed."""

    def follow(newest: int, turn: int) -> list[Path]:
        for name, value in (("READ_SECONDS", 1e6), ("NEWEST", newest), ("TURN", turn)):
            monkeypatch.setattr(watch, name, value)
        files = [tmp_path / f"folder_{number % 3}" / f"file_{number}.py" for number in range(12)]
        for number, file in enumerate(files):
            file.parent.mkdir(exist_ok=True)
            file.write_text("a = 0\n")
            os.utime(file, (100 - number, 100 - number))
        watcher.follow(files, {str(files[0]): "a = 1\n"})
        assert calls.next() == {files[0].name: "a = 0\n"}
        return files

    return follow


def test_a_call_that_raises_is_logged_and_the_next_save_is_seen(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "task.py"
    path.write_text("a = 0\n")
    calls = Calls()

    def on_change(paths: set[Path]) -> None:
        calls(paths)
        raise ValueError("of the listener's")

    watcher = SourceWatcher(on_change)
    watcher.follow([path])
    for number in (1, 2):
        # Rename at once: an emptied file could be seen as one more save.
        (tmp_path / "next.txt").write_text(f"a = {number}\n")
        (tmp_path / "next.txt").replace(path)
        assert calls.next() == {"task.py": f"a = {number}\n"}
    watcher.stop()
    assert "of the listener's" in caplog.text


def test_a_watcher_can_be_stopped_from_outside_and_from_its_callback(tmp_path: Path) -> None:
    path = tmp_path / "task.py"
    path.write_text("a = 0\n")
    calls = Calls()
    watcher = SourceWatcher(lambda paths: (watcher.stop(), calls(paths))[1])
    watcher.follow([path])
    path.write_text("a = 1\n")
    assert calls.next() == {"task.py": "a = 1\n"}
    watcher.stop()
    path.write_text("a = 2\n")
    assert calls.queue.empty()
    idle = SourceWatcher(calls)
    idle.stop()
    idle.stop()


@pytest.mark.parametrize("what", ["pipe", "device", "large", "loop"])
def test_a_path_that_is_no_longer_a_file_counts_as_missing_and_stays_watched(
    tmp_path: Path, what: str
) -> None:
    file, other = tmp_path / "task.py", tmp_path / "other"
    file.write_text("x = 1\n")
    seen: queue.Queue[set[Path]] = queue.Queue()
    watcher = SourceWatcher(seen.put)
    watcher.follow([file])
    if what == "pipe":
        os.mkfifo(other)
    elif what == "device":
        other.symlink_to("/dev/zero")
    elif what == "loop":
        other.symlink_to(file)
    else:
        with other.open("wb") as large:
            large.truncate(2**40)
    other.replace(file)
    assert seen.get(timeout=TIMEOUT_SECONDS) == {file}
    other.write_text("x = 2\n")
    other.replace(file)
    assert seen.get(timeout=TIMEOUT_SECONDS) == {file}
    watcher.stop()


@pytest.mark.parametrize("save", [rename_over, delete_and_create])
def test_a_renamed_or_created_file_among_many_is_seen_by_its_folder(
    save: Callable[[Path, str], None], many: Many, calls: Calls
) -> None:
    for number, file in enumerate(many(0, 0)):
        save(file, f"a = 2{number}\n")
        assert calls.next() == {file.name: f"a = 2{number}\n"}
