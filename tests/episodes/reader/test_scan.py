"""A folder's recordings are listed by their files' names, and a change of the folder is noticed."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from workbench.episodes.reader import scan
from workbench.episodes.reader.scan import broken, files_named, scan_folder

LONG_AGO = time.time() - 1000


def put(path: Path, content: str = "", age: float = 1000.0) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content)
    at = time.time() - age
    os.utime(path, (at, at))
    return path


def settle(folder: Path) -> None:
    """Let the folders look as if nothing had happened for a while."""
    for path in (folder, *(path for path in folder.rglob("*") if path.is_dir() and not path.is_symlink())):
        os.utime(path, (LONG_AGO, LONG_AGO))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "library"
    for name, size in (
        ("a.json", 1),
        ("a.h5", 2),
        ("a.rrd", 3),
        ("a.notes", 4),
        ("in/b.c.rrd", 5),
        ("in/d.h5", 6),
    ):
        put(folder / name, "x" * size)
    for name in ("only.notes", "text.txt", ".hidden/e.json", ".f.json", "in/.g.rrd"):
        put(folder / name)
    os.utime(folder / "a.notes")
    (folder / "in" / "again").symlink_to(folder)
    (folder / "gone.rrd").symlink_to(folder / "nothing")
    settle(folder)
    return folder


def test_files_of_one_name_are_one_recording(folder: Path) -> None:
    found = scan_folder(folder)
    assert {key: files.sizes for key, files in found.found.items()} == {
        "a": {".json": 1, ".h5": 2, ".rrd": 3, ".notes": 4},
        "in/b.c": {".rrd": 5},
        "in/d": {".h5": 6},
    }
    assert found.problem is None and found.unsettled == {} and not found.fresh
    a = found.found["a"]
    assert a.paths(folder) == tuple(folder / f"a{suffix}" for suffix in (".json", ".h5", ".rrd", ".notes"))
    assert a.newest == max(a.times[suffix] for suffix in (".json", ".h5", ".rrd")) < a.times[".notes"]
    assert files_named(folder / "a.h5") == a and files_named(folder / "only.notes") is None
    row, picture = broken(found.found["in/b.c"], "b.c.rrd is odd.")
    assert (row.kind, row.problem, picture) == ("rrd only", "b.c.rrd is odd.", None)
    assert (
        row.written == pytest.approx((folder / "in" / "b.c.rrd").stat().st_mtime)
        and broken(a, "x")[0].kind == "maniskill"
    )


def test_a_new_file_of_numbers_waits_for_its_description(folder: Path) -> None:
    new = put(folder / "in" / "new.h5", age=0)
    put(folder / "in" / "whole.rrd", age=0)
    settle(folder)
    found = scan_folder(folder)
    assert found.unsettled.keys() == {"in/new"} and "in/new" not in found.found and "in/whole" in found.found
    assert found.fresh and not found.is_unchanged()
    os.utime(new, (LONG_AGO, LONG_AGO))
    found = scan_folder(folder)
    assert found.unsettled == {} and "in/new" in found.found and found.is_unchanged()


def test_a_change_in_any_folder_is_noticed(folder: Path) -> None:
    changed = (
        lambda: put(folder / "in" / "more.json"),
        lambda: (folder / "in" / "d.h5").unlink(),
        lambda: os.utime(folder, (LONG_AGO - 60, LONG_AGO - 60)),
        lambda: (folder / "in").rename(folder / "out"),
    )
    for change in changed:
        settle(folder)
        before = scan_folder(folder)
        assert before.is_unchanged()
        change()
        assert not before.is_unchanged()
    put(folder / "now.json")
    assert scan_folder(folder).fresh


def test_a_folder_that_cannot_be_listed_whole_says_so(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for path in (folder / "none", folder / "a.json"):
        found = scan_folder(path)
        assert found.found == {} and found.problem is not None and path.name in found.problem
        assert not found.is_unchanged()
    monkeypatch.setattr(scan, "MAX_ENTRIES", 3)
    found = scan_folder(folder)
    assert found.problem is not None and not found.is_unchanged()
