"""Non-Python files next to a task: which are recorded, and how later changes are reported."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.drive.episodes import Made
from workbench.episodes.reader.read_episode import read_episode
from workbench.episodes.side_files import side_files, side_files_text

TEXT = """
'''See notes.txt.'''
ROOT = Path(__file__).parent
mesh = ROOT / "meshes" / "part.obj"
loader.load(str(ROOT / "robots/arm.urdf"))
for k in range(2):
    load(f"{ROOT}/shapes/piece_{k}.ply", "shapes")
"""


@pytest.fixture
def task(tmp_path: Path) -> Path:
    for name, text in {
        "meshes/part.obj": "v 0 0 0",
        "meshes/other.obj": "v 1 1 1",
        "robots/arm.urdf": '<mesh filename="visual/hand.stl"/>',
        "robots/visual/hand.stl": "solid",
        "shapes/piece_0.ply": "ply",
        "notes.txt": "mine",
        "recordings/part.obj": "not this one",
        "unnamed.bin": "",
    }.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    (tmp_path / "task.py").write_text(TEXT)
    return tmp_path / "task.py"


def test_files_named_in_the_task_and_in_those_files_are_recorded(task: Path) -> None:
    found = side_files(str(task), {str(task): TEXT})
    named = {"meshes/part.obj", "robots/arm.urdf", "robots/visual/hand.stl", "shapes/piece_0.ply"}
    assert named <= found.keys()
    assert not {"notes.txt", "unnamed.bin", "recordings/part.obj"} & found.keys()
    assert side_files(None, {"task.py": TEXT}) == {}
    assert side_files(str(task), {str(task): "not python ("}) == {}


def test_only_files_of_the_authors_own_folder_are_recorded(tmp_path: Path) -> None:
    names = ["a/ARM.URDF", "a/hand.stl", ".hidden/b.csv", ".c.csv", "d.csv", "d.rrd", "d.h5", "f.py", "g.csv"]
    for name in names:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("hand.stl" if name == "a/ARM.URDF" else name)
    task, arm = str(tmp_path / "task.py"), {"a/ARM.URDF", "a/hand.stl"}
    assert set(side_files(task, {"": f"names = {[*names, 'none.csv']!r}"})) == {*arm, "g.csv"}
    for text in ("load('ARM.URDF')", "load('a')", "load('./a/ARM.URDF')"):
        assert set(side_files(task, {"": text})) == arm, text
    assert side_files(task, {"": "'g.csv is only mentioned'\n'g.csv'\n"}) == {}
    installed = tmp_path / "lib" / "site-packages" / "tasks"
    installed.mkdir(parents=True)
    (installed / "g.csv").write_text("")
    assert side_files(str(installed / "task.py"), {"": "load('g.csv')"}) == {}
    assert side_files("task.py", {"": "load('g.csv')"}) == {}


def test_many_changed_files_are_named_in_part_and_counted(tmp_path: Path) -> None:
    for k in range(6):
        (tmp_path / f"{k}.csv").write_text("then")
    (tmp_path / "task.py").write_text("")
    recorded = side_files(str(tmp_path / "task.py"), {"": f"load({[f'{k}.csv' for k in range(6)]!r})"})
    assert list(recorded) == [f"{k}.csv" for k in range(6)] and len(set(recorded.values())) == 1
    for k in range(1, 6):
        (tmp_path / f"{k}.csv").write_text("now, and longer")
    text = side_files_text(str(tmp_path / "task.py"), recorded)
    assert "0.csv, 1.csv, 2.csv and 3 more" in text and "2 more differ" in text
    assert "0.csv has" not in text and "3.csv has" in text and "4.csv has" not in text


def test_changed_and_missing_side_files_are_reported(task: Path) -> None:
    text = "load('meshes/part.obj', 'notes.txt')"
    recorded = side_files(str(task), {str(task): text})
    assert list(recorded) == ["meshes/part.obj", "notes.txt"]
    assert "which the recording does not hold: they are unchanged." in side_files_text(str(task), recorded)
    (task.parent / "meshes/part.obj").write_text("v 9 9 9 9")
    (task.parent / "notes.txt").unlink()
    message = side_files_text(str(task), recorded)
    assert "meshes/part.obj has changed since; notes.txt is missing." in message
    assert "is missing" in side_files_text("task.py", recorded), "the task's folder is not the current one"
    assert "is missing" in side_files_text(str(task), {"../../etc/hostname": "0" * 12})
    assert side_files_text(str(task), {}) == ""


def test_a_file_outside_the_folder_is_not_compared(tmp_path: Path) -> None:
    """A shared recording reveals nothing about the files of the person who opens it."""
    outside, task = tmp_path / "outside.txt", str(tmp_path / "tasks" / "task.py")
    outside.write_text("mine")
    hashed = side_files(str(tmp_path / "task.py"), {"": "load('outside.txt')"})["outside.txt"]
    for name in ("../outside.txt", str(outside)):
        assert "is missing" in side_files_text(task, {name: hashed})


def test_a_copied_recording_finds_its_task_from_the_search_folder(
    make_episode: Callable[..., Made], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    task, copy = tmp_path / "project" / "tasks" / "push.py", tmp_path / "copy"
    task.parent.mkdir(parents=True)
    task.write_text('@register_env("Made-v1")\n')
    episode = make_episode()
    episode.info = dataclasses.replace(episode.info, source_file=str(task))
    file = episode.write(tmp_path / "project" / "recordings").json
    assert read_episode(file).info.source_file == str(task)
    copied = shutil.copytree(file.parent, copy / "a" / "b") / file.name
    assert read_episode(copied).info.source_file == "push.py"
    monkeypatch.chdir(tmp_path / "project")
    assert read_episode(copied).info.source_file == str(task)
    task.write_text("something else of that name")
    assert read_episode(copied).info.source_file == "push.py"
