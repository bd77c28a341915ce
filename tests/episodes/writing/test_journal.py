"""A journal holds complete states, whatever fails: system calls, its folder, or pictures still being encoded."""

from __future__ import annotations

import errno
import os
import threading
from collections.abc import Iterator
from concurrent.futures import Future
from pathlib import Path

import pytest

from tests.drive.episodes import entries_of
from tests.drive.waiting import until
from tests.episodes.refused_calls import descriptors, left_open, refused
from workbench.episodes.writing import journal as journals
from workbench.episodes.writing.journal import Journal, JournalEntry, claim


@pytest.fixture(autouse=True)
def no_thread_writes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stop the journal thread, so that each test decides when to write."""
    keeper = type(journals._journal_threads)()
    monkeypatch.setattr(keeper, "watch", lambda journal: None)
    monkeypatch.setattr(journals, "_journal_threads", keeper)


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


def test_a_failed_picture_is_reported_and_loses_only_its_own_state(journal: Journal) -> None:
    made: Future[list[JournalEntry]] = Future()
    made.set_exception(MemoryError("no room"))
    journal.append(JournalEntry("row", 0, b"0"))
    journal.append(JournalEntry("camera/0", 1, b"pose"), made, JournalEntry("row", 0, b"1"))
    for _ in range(2):
        with pytest.raises(OSError, match="could not be encoded .*no room"):
            journal.finish()
    assert entries_of(journal.path) == [JournalEntry("row", 0, b"0")]


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
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(journals, "_journal_threads", type(journals._journal_threads)())
    monkeypatch.setattr(journals, "SYNC_SECONDS", 0.01)
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


def test_rows_are_still_written_while_a_sync_hangs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journals, "_journal_threads", type(journals._journal_threads)())
    monkeypatch.setattr(journals, "SYNC_SECONDS", 0.01)
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
            until(
                lambda value=value: all(rows(journal.path)[-1:] == [value] for journal in two),
                "it is written",
            )
    finally:
        goes_on.set()
        for journal in two:
            journal.close()


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
