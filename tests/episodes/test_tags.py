"""Tags and notes: whatever fails while they are written, the old or the new ones are intact."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.episodes.library_files import describe
from tests.episodes.refused_calls import descriptors, left_open, refused
from workbench.episodes.document import read_notes, write_into_description, write_notes


def our_recording(folder: Path) -> tuple[Path, Callable[[], None]]:
    path = describe(folder, "a", id="a1", tags=["old"], note="typed before")
    return path, lambda: write_into_description(path, ("new",), "typed now")


def foreign_recording(folder: Path) -> tuple[Path, Callable[[], None]]:
    path = folder / "demo.notes"
    folder.mkdir(exist_ok=True)
    write_notes(path, "traj_0", ("old",), "typed before")
    return path, lambda: write_notes(path, "traj_1", ("new",), "typed now")


KINDS = pytest.mark.parametrize("begin", [our_recording, foreign_recording])


@KINDS
@pytest.mark.parametrize("then", [0, errno.EROFS])
def test_a_call_that_fails_leaves_the_old_content_or_the_new(
    tmp_path: Path, begin: Callable[[Path], tuple[Path, Callable[[], None]]], then: int
) -> None:
    path, write = begin(tmp_path / "0")
    before = path.read_bytes()
    with refused() as calls:
        write()
    assert calls[0].startswith("open") and {call.split()[0] for call in calls} >= {"fsync", "replace"}
    after = path.read_bytes()
    for at, call in enumerate(calls, 1):
        path, write = begin(tmp_path / str(at))
        opened, beside = descriptors(), sorted(os.listdir(path.parent))
        failed = False
        with refused(at, then=then):
            try:
                write()
            except OSError as error:
                failed = True
                assert error.errno == errno.EIO, call
        assert path.read_bytes() == (before if failed else after), call
        assert failed or not call.startswith(("open", "fsync", "replace")), call
        assert left_open(opened) == [], call
        # Where removing fails too, the partial file stays.
        assert then or sorted(os.listdir(path.parent)) == beside, call


def test_notes_of_one_trajectory_leave_those_of_the_others(tmp_path: Path) -> None:
    path = tmp_path / "demo.notes"
    for number in range(3):
        write_notes(path, f"traj_{number}", (f"tag {number}",), "same")
    write_notes(path, "traj_1", (), "")
    assert read_notes(path) == {"traj_0": (("tag 0",), "same"), "traj_2": (("tag 2",), "same")}
    write_notes(path, None, (), "of the whole file")
    assert read_notes(path)[""] == ((), "of the whole file")
    for name in ("traj_0", "traj_2", None, "traj_0"):
        write_notes(path, name, (), "")
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("content", ["", "{", "[1]", '{"mine": 1}', '{"workbench_notes": {"traj_0": 5}}'])
def test_unreadable_notes_are_not_overwritten(tmp_path: Path, content: str) -> None:
    path = tmp_path / "demo.notes"
    path.write_text(content)
    assert read_notes(path) == {}
    with pytest.raises(ValueError, match="holds no notes that this version can read"):
        write_notes(path, "traj_1", ("new",), "")
    with pytest.raises(ValueError):
        write_notes(path, "traj_1", (), "")
    assert path.read_text() == content
