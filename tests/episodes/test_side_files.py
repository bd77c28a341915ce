"""Files beside a task that are no Python: which are named, and what is said of them later."""

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


def test_what_the_text_names_is_named_and_what_that_names_in_turn(task: Path) -> None:
    found = side_files(str(task), {str(task): TEXT})
    assert {"meshes/part.obj", "robots/arm.urdf", "robots/visual/hand.stl", "shapes/piece_0.ply"} <= set(
        found
    )
    assert not {"notes.txt", "unnamed.bin", "recordings/part.obj"} & set(found)
    assert side_files(None, {"task.py": TEXT}) == {}
    assert side_files(str(task), {str(task): "not python ("}) == {}


def test_what_has_changed_or_gone_since_is_said(task: Path) -> None:
    text = "load('meshes/part.obj', 'notes.txt')"
    recorded = side_files(str(task), {str(task): text})
    assert list(recorded) == ["meshes/part.obj", "notes.txt"]
    assert "which the recording does not hold: they are as then." in side_files_text(str(task), recorded)
    (task.parent / "meshes/part.obj").write_text("v 9 9 9 9")
    (task.parent / "notes.txt").unlink()
    said = side_files_text(str(task), recorded)
    assert "meshes/part.obj has changed since; notes.txt is missing." in said
    assert "is missing" in side_files_text("task.py", recorded), "read where the task is not"
    assert "is missing" in side_files_text(str(task), {"../../etc/hostname": "0" * 12})
    assert side_files_text(str(task), {}) == ""


def test_a_file_outside_is_not_said_to_be_as_then(task: Path) -> None:
    """Whoever shares a recording learns nothing of the files of whoever opens it."""
    outside = task.parent.parent / "outside.txt"
    outside.write_text("mine")
    try:
        hashed = side_files(str(outside.with_name("task.py")), {"": "load('outside.txt')"})["outside.txt"]
        assert "is missing" in side_files_text(str(task), {"../outside.txt": hashed})
        assert "is missing" in side_files_text(str(task), {str(outside): hashed})
    finally:
        outside.unlink()


def test_a_recording_that_was_copied_elsewhere_finds_its_task_where_one_looks_from(
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
