"""The index is a cache: a damaged index is discarded, one locked by another process is not."""

from __future__ import annotations

import os
import sqlite3
from pathlib import Path

import pytest

from workbench.episodes.reader.scan import RecordingFiles
from workbench.episodes.row import Facts
from workbench.library import index as library_index
from workbench.library.index import LibraryIndex, index_path


def found(key: str, size: int = 5) -> RecordingFiles:
    return RecordingFiles(key, {".json": size}, {".json": 7})


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(library_index, "LOCKED_SECONDS", 0.05)
    return tmp_path / "recordings"


def keep(index: LibraryIndex, *keys: str) -> None:
    index.store([(found(key), [(Facts(kind="workbench"), os.fsencode(key))]) for key in keys])


def test_an_index_locked_by_another_process_is_not_changed(folder: Path) -> None:
    index = LibraryIndex(folder)
    keep(index, "a", "b")
    path = index_path(folder)
    inode = os.stat(path).st_ino
    other = sqlite3.connect(path, isolation_level=None)
    other.execute("BEGIN EXCLUSIVE")
    keep(index, "c")
    assert index.thumbnails([("a", 0)]) == {}
    other.execute("ROLLBACK")
    other.close()
    assert index.load().keys() == {"a", "b"} and os.stat(path).st_ino == inode
    assert index.thumbnails([("a", 0), ("b", 0), ("c", 0), ("a", 1)]) == {("a", 0): b"a", ("b", 0): b"b"}
    index.close()


def test_reread_recordings_replace_their_entries_and_deleted_ones_are_removed(folder: Path) -> None:
    index = LibraryIndex(folder)
    keep(index, "a", "b", "c")
    facts = Facts(kind="workbench")
    index.store([(found("a", size=6), [(facts, None), (facts, b"second")])], gone=["b"])
    index.close()
    index = LibraryIndex(folder)
    kept = index.load()
    assert kept.keys() == {"a", "c"} and kept["a"].found == found("a", size=6) and len(kept["a"].rows) == 2
    wanted = [("a", 0), ("a", 1), ("b", 0), ("c", 0)]
    assert index.thumbnails(wanted) == {("a", 1): b"second", ("c", 0): b"c"}
    index.close()
