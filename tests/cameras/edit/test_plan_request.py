"""A request of the studio becomes the right kind of edit of the files on disk, or is refused with text to copy."""

from __future__ import annotations

import ast
import sys
import types
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.cameras.edit.real_cameras import HEADER, close, modules, run_class, settings_of
from tests.drive.scenes import camera, description, table_scene
from workbench.cameras.edit.hook_cameras import HookCameras
from workbench.cameras.edit.plan_request import copy, plan
from workbench.cameras.view import EditRequest, EditState
from workbench.envs.camera_data import CallSite, CameraInfo, CameraKey, CameraSettings
from workbench.envs.maniskill_private import parse_cameras
from workbench.task.description import TaskDescription

KEY: CameraKey = ("sensor", "cam")
OWN = (
    HEADER
    + '''class Task(Base):
    """A task."""

    @property
    def _default_sensor_configs(self):
        return [CameraConfig("cam", sapien.Pose([0.5, 0, 0.5]), 128, 128, 1.0, 0.01, 10)]
'''
)
LIBRARY = (
    HEADER
    + """class Library(Base):
    @property
    def _default_sensor_configs(self):
        made = [CameraConfig(name, sapien.Pose([0.5, 0, 0.5]), 128, 128, 1.0, 0.01, 10) for name in ("cam", "other")]
        return made
"""
)
CHILD = '''from a_library import Library


class Task(Library):
    """A task whose cameras are inherited."""
'''
NOW = CameraSettings((0.5, 0.0, 0.5), (1.0, 0.0, 0.0, 0.0), 1.0, None, 128, 128, 0.01, 10.0, "minimal")
THERE = replace(NOW, position=(0.25, 0.5, 0.75), fov=0.5)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "task.py"


def task_of(file: Path, text: str, **changes: Any) -> TaskDescription:
    file.write_text(text)
    own = {"file": str(file), "source_files": (str(file),), "source": {str(file): text}, "class_name": "Task"}
    return replace(description(table_scene(1)[0]), **{**own, **changes})


def info_of(file: Path, function: str = "Task._default_sensor_configs", **changes: Any) -> CameraInfo:
    return replace(camera("cam"), settings=NOW, site=CallSite(str(file), 20, function), **changes)


def cameras_in(text: str) -> dict[str, CameraSettings]:
    with modules({"/author/task.py": text}) as names:
        task = names["Task"]()
        found: dict[str, CameraSettings] = {}
        for hook in ("_default_sensor_configs", "_default_human_render_camera_configs"):
            if hasattr(task, hook):
                found |= {name: settings_of(one) for name, one in parse_cameras(getattr(task, hook)).items()}
        return found


def fails(sources: Mapping[str, str]) -> HookCameras:
    raise AssertionError("the hooks need not run")


def planned(
    task: TaskDescription, info: CameraInfo | None, request: EditRequest
) -> dict[str, CameraSettings]:
    """The cameras of the planned text; the file itself is unchanged."""
    assert task.file is not None
    before = Path(task.file).read_bytes()
    state = plan(task, info, request, run_class)
    assert state.stage == "planned" and state.edit is not None and state.request == request, state.message
    assert Path(task.file).read_bytes() == before and state.edit.file == task.file
    return cameras_in(state.edit.new_text)


def refused(
    task: TaskDescription, info: CameraInfo | None, request: EditRequest, run: Any = fails
) -> EditState:
    state = plan(task, info, request, run)
    assert state.stage == "refused" and state.edit is None and state.request == request and state.message
    return state


def test_each_kind_of_request_changes_the_cameras_as_it_says(file: Path) -> None:
    task, info = task_of(file, OWN), info_of(file)
    for request, wanted in (
        (EditRequest("edit", KEY, THERE), {"cam": THERE}),
        (EditRequest("add", ("human", "new"), THERE), {"cam": NOW, "new": THERE}),
        (EditRequest("duplicate", KEY, NOW, "second"), {"cam": NOW, "second": NOW}),
        (EditRequest("rename", KEY, NOW, "front"), {"front": NOW}),
        (EditRequest("remove", KEY, NOW), {}),
    ):
        found = planned(task, None if request.what == "add" else info, request)
        assert found.keys() == wanted.keys() and all(close(found[name], wanted[name]) for name in wanted), (
            request
        )


def test_the_file_on_disk_is_planned_with_not_the_text_that_runs(file: Path) -> None:
    task = task_of(file, OWN)
    file.write_text(OWN + "\n\nLATER = 1\n")
    state = plan(task, info_of(file), EditRequest("edit", KEY, THERE), run_class)
    assert state.edit is not None and "LATER = 1" in state.edit.new_text
    file.unlink()
    assert str(file) in refused(task, info_of(file), EditRequest("edit", KEY, THERE)).message


def test_an_installed_task_is_refused_and_can_be_copied_if_it_is_one_file(tmp_path: Path) -> None:
    request, file = EditRequest("edit", KEY, THERE), tmp_path / "site-packages" / "task.py"
    file.parent.mkdir()
    task = task_of(file, OWN)
    other = file.with_name("places.py")
    other.write_text("X = 1\n")
    for sources, can_copy in (((), True), ((str(file),), True), ((str(file), str(other)), False)):
        state = refused(replace(task, source_files=sources), info_of(file), request, run_class)
        assert state.can_copy is can_copy and ast.parse(state.snippet), sources
    assert not refused(replace(task, file=None, source_files=()), info_of(file), request).can_copy


def test_a_camera_that_the_task_moves_or_whose_settings_are_unknown_is_refused(file: Path) -> None:
    task = task_of(file, OWN)
    moved = refused(task, info_of(file, varies=True), EditRequest("edit", KEY, THERE))
    assert "0.25" in moved.snippet and not moved.can_copy
    for request in (EditRequest("rename", KEY, None, "front"), EditRequest("remove", KEY)):
        refused(task, replace(info_of(file), settings=None), request)
        refused(task, None, request)


@pytest.fixture
def library(monkeypatch: pytest.MonkeyPatch) -> None:
    made = types.ModuleType("a_library")
    exec(compile(LIBRARY, "/usr/lib/a_library.py", "exec"), vars(made))
    monkeypatch.setitem(sys.modules, "a_library", made)


def test_an_inherited_camera_is_replaced_by_a_hook_of_the_tasks_own_class(file: Path, library: None) -> None:
    task = task_of(file, CHILD)
    info = info_of(Path("/usr/lib/a_library.py"), "Library._default_sensor_configs")
    found = planned(task, info, EditRequest("edit", KEY, THERE))
    assert found.keys() == {"cam", "other"} and close(found["cam"], THERE) and close(found["other"], NOW)
    for request in (
        EditRequest("rename", KEY, NOW, "front"),
        EditRequest("remove", KEY, NOW),
        EditRequest("duplicate", KEY, NOW, "second"),
    ):
        state = refused(task, info, request)
        assert not state.can_copy and bool(state.snippet) is (request.what != "remove")
    varies = refused(task, replace(info, varies=True), EditRequest("edit", KEY, THERE))
    assert "super()._default_sensor_configs" in varies.snippet


def test_a_camera_of_the_robot_is_offered_as_text_with_its_mount(file: Path) -> None:
    task = task_of(file, OWN)
    for function, mount in (
        ("Panda._sensor_configs", 'mount=self.robot.links_map["hand"]'),
        ("Elsewhere.helper", 'mount=self.agent.robot.links_map["hand"]'),
    ):
        info = info_of(Path("/usr/lib/panda.py"), function, mount="panda/hand")
        state = refused(task, info, EditRequest("edit", KEY, THERE))
        assert mount in state.snippet and not state.can_copy and "0.25" in state.snippet
        assert "super()" not in state.snippet
        installed = replace(task, source_files=(), source={})
        assert not refused(installed, info, EditRequest("edit", KEY, THERE)).can_copy, (
            "the copy would not hold it"
        )


def test_a_copy_of_a_task_gets_a_free_name_and_the_original_stays(file: Path, tmp_path: Path) -> None:
    task = task_of(file, '"""A task."""\n' + OWN)
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "task.py").write_text("mine")
    made, state = copy(task, folder)
    assert (
        made is not None and made.parent == folder and made.name != "task.py" and str(made) in state.message
    )
    assert (folder / "task.py").read_text() == "mine" and file.read_text() == '"""A task."""\n' + OWN
    missing, state = copy(replace(task, file=str(tmp_path / "gone.py")), folder)
    assert missing is None and state.stage == "refused"
