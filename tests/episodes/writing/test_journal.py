"""A journal holds complete states, whatever fails: system calls, its folder, or pictures still being encoded."""

from __future__ import annotations

import errno
import os
import threading
from collections.abc import Iterator
from concurrent.futures import Future
from pathlib import Path

import numpy as np
import pytest

from tests.drive.episodes import entries_of
from tests.drive.equal import assert_equal
from tests.drive.scenes import table_scene
from tests.drive.waiting import until
from tests.episodes.refused_calls import descriptors, left_open, refused
from workbench.envs.scene.shapes import Material, Mesh, SceneGeometry, Visual
from workbench.episodes.writing import journal as journals
from workbench.episodes.writing.journal import Journal, JournalEntry, claim, read_visuals, write_scene


@pytest.fixture(autouse=True)
def no_thread_writes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stop the journal thread, so that each test decides when to write."""
    keeper = type(journals.journal_threads)()
    monkeypatch.setattr(keeper, "watch", lambda journal: None)
    monkeypatch.setattr(journals, "journal_threads", keeper)


@pytest.fixture
def threads_write(no_thread_writes: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the journal threads write, every hundredth of a second."""
    monkeypatch.setattr(journals, "journal_threads", type(journals.journal_threads)())
    monkeypatch.setattr(journals, "SYNC_SECONDS", 0.01)


@pytest.fixture
def journal(tmp_path: Path) -> Iterator[Journal]:
    journal = Journal(tmp_path / "folder" / "a.arrow")
    yield journal
    journal.close()


def rows(path: Path) -> list[bytes]:
    """Values of the rows in the file; consecutive rows that were written together are one value."""
    return [entry.value for entry in entries_of(path) if entry.kind == "row"]


def numbers(*values: int) -> list[bytes]:
    return [bytes([value]) for value in values]


def test_a_disk_error_is_raised_at_the_next_row_and_a_later_sync_does_not_clear_it(
    journal: Journal,
) -> None:
    journal.append(JournalEntry("row", 0, b"0"))
    with refused(1, ("fsync",)):
        journal.sync()
    for _ in range(2):
        journal.sync()
        for tell in (lambda: journal.append(JournalEntry("row", 0, b"1")), journal.append):
            with pytest.raises(OSError, match="Input/output error"):
                tell()
    journal.finish()
    assert rows(journal.path) == [b"0"]


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EIO])
@pytest.mark.parametrize("then", [0, errno.EIO])
@pytest.mark.parametrize("half", [0, 5])
def test_rows_that_could_not_be_written_are_written_once_there_is_room(
    journal: Journal, monkeypatch: pytest.MonkeyPatch, number: int, then: int, half: int
) -> None:
    """This holds too where half of a row was written and truncating it fails."""
    journal.append(JournalEntry("row", 0, b"0"))
    journal.write()
    for value in numbers(1, 2):
        journal.append(JournalEntry("row", 0, value * 3000))
    write = os.pwrite
    with monkeypatch.context() as patch:
        if half:
            patch.setattr(os, "pwrite", lambda descriptor, view, at: write(descriptor, view[:half], at))
        with refused(2 if half else 1, ("pwrite",), number, then):
            journal.write()
    with pytest.raises(OSError) as error:
        journal.append(JournalEntry("row", 0, b"not kept"))
    assert error.value.errno == number
    assert rows(journal.path) == [b"0"]
    journal.finish()
    assert rows(journal.path) == [b"0", b"".join(value * 3000 for value in numbers(1, 2))]
    assert journal.size == journal.path.stat().st_size


def test_rows_appended_while_the_disk_fails_keep_their_order(
    journal: Journal, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> int:
        journal.append(JournalEntry("row", 0, b"2"))
        raise OSError(errno.ENOSPC, "No space left on device")

    for value in (b"0", b"1"):
        journal.append(JournalEntry("row", 0, value))
    with monkeypatch.context() as patch:
        patch.setattr(os, "pwrite", full)
        journal.write()
    journal.finish()
    assert b"".join(rows(journal.path)) == b"012"
    assert journal.size == journal.path.stat().st_size


def test_a_journal_has_one_writer_and_later_one_exclusive_claim(tmp_path: Path, journal: Journal) -> None:
    assert claim(journal.path) is None, "its writer lives"
    assert claim(tmp_path / "none.arrow") is None
    (tmp_path / "link.arrow").symlink_to(journal.path)
    journal.close()
    assert claim(tmp_path / "link.arrow") is None and claim(tmp_path) is None
    before = descriptors()
    held = claim(journal.path)
    assert held is not None and claim(journal.path) is None and len(left_open(before)) == 1
    os.close(held)
    with pytest.raises(FileExistsError):
        Journal(journal.path)
    again = claim(journal.path)
    assert again is not None
    os.close(again)
    assert left_open(before) == []


def test_threads_write_all_journals_and_end_with_the_last(
    tmp_path: Path, threads_write: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    lasting: set[str] = set()
    fsync = os.fsync

    def noted(descriptor: int) -> None:
        fsync(descriptor)
        lasting.add(os.readlink(f"/proc/self/fd/{descriptor}"))

    monkeypatch.setattr(os, "fsync", noted)
    before = set(threading.enumerate())
    three = [Journal(tmp_path / f"{k}.arrow") for k in range(3)]
    threads = set(threading.enumerate()) - before
    assert threads and all(thread.daemon for thread in threads), "they must not delay the exit of a process"
    for journal in three:
        journal.append(JournalEntry("row", 0, b"x"))
    until(
        lambda: all(rows(journal.path) == [b"x"] and str(journal.path) in lasting for journal in three),
        "every row on the disk",
    )
    for journal in three:
        journal.close()
    for thread in threads:
        thread.join(20)
        assert not thread.is_alive()


def test_rows_that_are_held_back_are_added_before_each_write_until_their_owner_is_deleted(
    tmp_path: Path, threads_write: None
) -> None:
    class Batch:
        def __init__(self, value: bytes) -> None:
            self.held = [value]

        def flush(self) -> None:
            while self.held:
                journal.append(JournalEntry("row", 0, self.held.pop()))

    first, second = Batch(b"1"), Batch(b"2")
    journals.before_writing(first.flush)
    journals.before_writing(second.flush)
    del first
    journal = Journal(tmp_path / "a.arrow")
    until(lambda: b"".join(rows(journal.path)) == b"2", "what the second held is written")
    second.held.append(b"3")
    until(lambda: b"".join(rows(journal.path)) == b"23", "what it held later too")
    journal.close()


def test_meshes_are_written_once_for_the_episodes_of_a_scene_in_a_folder(tmp_path: Path) -> None:
    scene, other = table_scene(1)[0], table_scene(2)[0]
    paths = [tmp_path / name / "a.scene" for name in ("one", "two")]
    paths += [tmp_path / "one" / "b.scene", tmp_path / "one" / "c.scene"]
    for path, geometry in zip(paths, (scene, scene, scene, other)):
        path.parent.mkdir(exist_ok=True)
        write_scene(geometry, path)
        assert len(read_visuals(path)) == len(geometry.visuals)
        assert read_visuals(path)[-1].envs.tolist() == geometry.visuals[-1].envs.tolist()
    first, apart, second, third = (path.stat() for path in paths)
    assert len({first.st_ino, apart.st_ino, second.st_ino, third.st_ino}) == 4
    # Of two episodes of one scene in one folder, one after the other, the second links the first's file.
    write_scene(other, tmp_path / "one" / "d.scene")
    paths[3].unlink()
    write_scene(other, tmp_path / "one" / "e.scene")
    linked = {(tmp_path / "one" / f"{name}.scene").stat().st_ino for name in "de"}
    assert linked == {third.st_ino}


def test_a_scene_is_read_back_with_all_its_numbers(tmp_path: Path) -> None:
    numbers = np.arange(9, dtype=np.float32).reshape(3, 3)
    mesh = Mesh(numbers, np.array([[2, 0, 1]], np.uint32), numbers + 1, numbers[:, :2] + 2)
    look = Material((0.1, 0.2, 0.3, 0.4), 0.5, 0.6, np.full((1, 2, 4), 7, np.uint8))
    envs, bodies = np.array([0, 1], np.int32), np.array([1, 0], np.int32)
    plain = Visual("plain", Mesh(numbers, mesh.faces), Material((1, 1, 1, 1)), envs[:1], bodies[:1])
    visuals = (Visual("a/b", mesh, look, envs, bodies), plain)
    write_scene(SceneGeometry(2, (), (), (), visuals), tmp_path / "a.scene")
    assert_equal(read_visuals(tmp_path / "a.scene"), visuals)


def test_rows_are_still_written_while_a_sync_hangs(
    tmp_path: Path, threads_write: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    hangs, goes_on = threading.Event(), threading.Event()

    def hang(descriptor: int) -> None:
        hangs.set()
        goes_on.wait(60)

    monkeypatch.setattr(os, "fsync", hang)
    two = [Journal(tmp_path / f"{k}.arrow") for k in range(2)]
    try:
        assert hangs.wait(60)
        for value in numbers(1, 2):
            for journal in two:
                journal.append(JournalEntry("row", 0, value))
            until(lambda value=value: all(rows(one.path)[-1:] == [value] for one in two), "it is written")
    finally:
        goes_on.set()
        for journal in two:
            journal.close()


def test_many_bytes_are_written_at_once_and_not_kept_in_memory(journal: Journal) -> None:
    journal.append(JournalEntry("row", 0, b"a"))
    assert rows(journal.path) == []
    journal.append(JournalEntry("row", 0, bytes(3 << 20)))
    assert rows(journal.path) == [b"a" + bytes(3 << 20)]


def test_pending_bytes_are_counted_until_they_are_written(journal: Journal) -> None:
    begin = journal.size
    made: Future[list[JournalEntry]] = Future()
    journal.append(JournalEntry("row", 0, b"0" * 100))
    journal.append(made, JournalEntry("row", 0, b"1" * 100))
    waiting = journal.size
    assert begin + 200 < waiting < begin + 300
    made.set_result([JournalEntry("picture/0/rgb", 1, b"p" * 1000)])
    assert journal.size > waiting + 1000
    for _ in range(2):
        journal.write()
        assert journal.size == journal.path.stat().st_size
