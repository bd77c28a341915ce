"""Transfer of the author's files to other machines, and translation of their paths in results."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from workbench.actions.choose import needed_by
from workbench.jobs import pack_author_files as travel
from workbench.jobs.pack_author_files import TooMuch, files_below, pack_worker_files, relocated


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a task, in the current folder."""
    mine = tmp_path / "here" / "mine"
    for name in ("task.py", "beside.py", "assets/cup/cup.urdf", "assets/cup/cup.glb", ".git/config", "venv/pyvenv.cfg",
                 "other/pyvenv.cfg", "other/lib.py", "__pycache__/task.pyc", "recordings/old.rrd", ".hidden"):  # fmt: skip
        (mine / name).parent.mkdir(parents=True, exist_ok=True)
        (mine / name).write_text(name)
    (mine / "link.py").symlink_to("/etc/passwd")
    (mine.parent / "policy").mkdir()
    (mine.parent / "policy" / "act.py").write_text("def act(obs): ...\n")
    (mine.parent / "demo.npy").write_bytes(b"123")
    monkeypatch.chdir(mine.parent)
    return mine


def test_hidden_files_generated_files_and_links_are_not_sent(place: Path) -> None:
    found = [file.relative_to(place).as_posix() for file in files_below(place)]
    assert found == ["beside.py", "task.py", "assets/cup/cup.glb", "assets/cup/cup.urdf"]


def test_paths_relative_to_the_current_folder_also_work_on_the_worker(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    worker_files = pack_worker_files([place, place / "assets"], [Path("demo.npy"), place / "task.py"])
    assert worker_files.roots == (str(place), str(place.parent / "demo.npy"))
    there = tmp_path / "there"
    there.mkdir()
    places = worker_files.unpack(there)
    assert Path.cwd() == Path(f"{there}{place.parent}")
    assert Path("mine/assets/cup/cup.urdf").read_text() == "assets/cup/cup.urdf"
    assert Path("demo.npy").read_bytes() == b"123"
    assert Path(places[str(place)], "task.py").samefile("mine/task.py")


@dataclass(frozen=True)
class Thing:
    path: Path
    text: str
    numbers: np.ndarray
    raw: bytes
    more: dict[str, tuple[str, ...]]


def test_paths_are_replaced_everywhere_except_in_bytes_and_arrays() -> None:
    thing = Thing(Path("/a/b/c.py"), "at /a/b/c.py:3", np.zeros(2), b"/a/b", {"/a/b/c": ("/a/x", "/a/b")})
    there = relocated(thing, {"/a/b": "/far", "/a": "/near"})
    assert (there.path, there.text, there.raw) == (Path("/far/c.py"), "at /far/c.py:3", b"/a/b")
    assert there.more == {"/far/c": ("/near/x", "/far")} and there.numbers is thing.numbers
    assert relocated(thing, {}) is thing


def test_a_job_needs_the_files_of_its_task_and_its_policy(place: Path) -> None:
    needed = needed_by("mine/task.py:Task", "policy/act.py:act")
    assert [folder.resolve() for folder in needed.folders] == [place, place.parent / "policy"]
    needed = needed_by("mine/task.py", "demo.npy")
    assert needed.files == (Path("demo.npy"),)
    assert (
        needed_by("PushCube-v1", "random") == needed_by("PushCube-v1")
        and not needed_by("PushCube-v1").folders
    )


def test_too_much_data_is_refused_with_the_largest_files(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(travel, "MAX_BYTES", 2 << 20)
    (place / "huge.bin").write_bytes(bytes(5 << 20))
    with pytest.raises(TooMuch, match=r"are 5 MB, and at most 2 MB are sent.*huge\.bin \(5 MB\)"):
        pack_worker_files([place])
