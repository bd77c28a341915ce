"""Recent tasks are kept for the next run, and no content of their file breaks the page."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from workbench.start.recents import MAX_TASKS, RECENT_FILE, RecentTasks
from workbench.task.description import TaskOptions
from workbench.task.reference import lasting


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "state"


def recents(folder: Path) -> RecentTasks:
    return RecentTasks(lambda: folder)


def test_the_last_task_comes_first_with_its_options_also_in_another_run(folder: Path, tmp_path: Path) -> None:
    here = recents(folder)
    here.add(f"{tmp_path}/push.py:Push", TaskOptions(4, env_kwargs={"robot_uids": "fetch", "size": 0.5}))
    here.add("PickCube-v1", TaskOptions(2))
    here.add(f"{tmp_path}/push.py:Push", TaskOptions(8))
    for one in (here, recents(folder)):
        assert [(task.reference, task.num_envs) for task in one.list()] == [
            (f"{tmp_path}/push.py:Push", 8),
            ("PickCube-v1", 2),
        ]
    assert recents(folder).list()[1].file is None
    assert os.stat(folder / RECENT_FILE).st_mode & 0o077 == 0, "no other user can read the recent tasks"


def test_two_runs_keep_each_others_tasks_and_only_the_newest_are_kept(folder: Path) -> None:
    first, second = recents(folder), recents(folder)
    for number in range(MAX_TASKS):
        (first, second)[number % 2].add(f"Task{number}-v1", TaskOptions())
    assert len(recents(folder).list()) == MAX_TASKS
    first.add("Last-v1", TaskOptions())
    kept = [task.reference for task in recents(folder).list()]
    assert kept[0] == "Last-v1" and len(kept) == MAX_TASKS and "Task0-v1" not in kept


def test_a_name_is_valid_in_another_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "lab").mkdir()
    (tmp_path / "lab/envs.py").touch()
    assert lasting("push.py") == str(tmp_path / "push.py")
    assert lasting("push.py:Push") == f"{tmp_path}/push.py:Push"
    assert lasting("lab.envs:Push") == f"{tmp_path}/lab/envs.py:Push"
    assert lasting("PickCube-v1") == "PickCube-v1"


HOSTILE = [
    {"reference": "push.py"},
    {"reference": "os:system"},
    {"reference": ""},
    {"reference": "/x/\u202eevil.py"},
    {"reference": "/x/" + "a" * 10_000 + ".py"},
    {"reference": "PickCube-v1", "num_envs": 10**9},
    {"reference": "PickCube-v1", "num_envs": -1},
    {"reference": "PickCube-v1", "env_kwargs": {"a b": 1}},
    {"reference": "PickCube-v1", "env_kwargs": {"a": "x" * 100_000}},
    {"reference": 7},
    "PickCube-v1",
    None,
]


def test_an_invalid_entry_is_dropped_and_the_others_stay(folder: Path) -> None:
    recents(folder).add("PickCube-v1", TaskOptions())
    rows = json.loads((folder / RECENT_FILE).read_text())["tasks"]
    (folder / RECENT_FILE).write_text(json.dumps({"tasks": [*HOSTILE, *rows]}))
    assert [task.reference for task in recents(folder).list()] == ["PickCube-v1"]


@pytest.mark.parametrize("text", ["", "{", "[]", '{"tasks": 3}', '{"tasks": [' * 5000, "\x00", "\ud800"])
def test_a_broken_file_is_ignored_and_rewritten(folder: Path, text: str) -> None:
    folder.mkdir(mode=0o700)
    (folder / RECENT_FILE).write_bytes(text.encode("utf-8", "surrogatepass"))
    one = recents(folder)
    assert one.list() == []
    one.add("PickCube-v1", TaskOptions())
    assert [task.reference for task in recents(folder).list()] == ["PickCube-v1"]


def test_a_file_writable_by_others_is_not_trusted(folder: Path) -> None:
    recents(folder).add("PickCube-v1", TaskOptions())
    (folder / RECENT_FILE).chmod(0o666)
    assert recents(folder).list() == []


def test_in_a_read_only_folder_recents_last_for_this_run(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    one = RecentTasks(lambda: tmp_path / "file" / "state")
    one.add("PickCube-v1", TaskOptions())
    assert [task.reference for task in one.list()] == ["PickCube-v1"]
