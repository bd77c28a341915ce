"""An edit finds the right call in the right file, or is refused with a reason."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from textwrap import dedent
from typing import Any

import pytest

from tests.cameras.edit.real_cameras import FILE, HEADER, planned, real_settings, run_as, run_class
from workbench.cameras.edit.hook_cameras import HookCameras, RunHooks
from workbench.cameras.edit.plan import plan_edit
from workbench.envs.camera_data import CameraKey, CameraSettings
from workbench.source.parsed import Place, Read, RefusedEdit
from workbench.task.write_edits import SourceEdit

TWO = HEADER + dedent(
    """\
    class Task(Base):
        @property
        def _default_sensor_configs(self):
            return [CameraConfig("cam", sapien.Pose([0.5, 0, 0.5]), 128, 128, 1.0)]

        @property
        def _default_human_render_camera_configs(self):
            return CameraConfig("cam", sapien.Pose([0.5, 0, 0.5]), 512, 512, 1.0)


    class Other(Task):
        @property
        def _default_sensor_configs(self):
            name = "cam"
            return [CameraConfig(f"{name}", sapien.Pose([0.5, 0, 0.5]), 128, 128, 1.0)]
    """
)
LINE = (
    TWO.splitlines().index('        return [CameraConfig("cam", sapien.Pose([0.5, 0, 0.5]), 128, 128, 1.0)]')
    + 1
)


KEY: CameraKey = ("sensor", "cam")


@pytest.fixture
def before() -> CameraSettings:
    """The first of `TWO`'s cameras."""
    return real_settings({FILE: TWO}, "cam", "_default_sensor_configs")


def higher(now: CameraSettings) -> CameraSettings:
    return dataclasses.replace(now, position=(0.5, 0.0, 0.75))


def edit(
    sources: Mapping[str, str], before: CameraSettings, after: CameraSettings, run: RunHooks = run_class
) -> SourceEdit | RefusedEdit:
    return planned(plan_edit, sources, KEY, before, after, run)


def edited_line(plan: SourceEdit | RefusedEdit) -> int:
    assert isinstance(plan, SourceEdit), plan
    pairs = zip(plan.old_text.splitlines(), plan.new_text.splitlines(), strict=True)
    (line,) = [number for number, (old, new) in enumerate(pairs, 1) if old != new]
    return line


def test_cameras_of_equal_name_and_value_are_distinguished_by_their_place() -> None:
    source = TWO.replace("512, 512", "128, 128").replace('f"{name}"', '"cam"')
    before = real_settings({FILE: source}, "cam", "_default_sensor_configs")
    for class_name, line in (("Task", LINE), ("Other", LINE + 11)):
        plan = edit({FILE: source}, before, higher(before), run_as(class_name))
        assert edited_line(plan) == line


@pytest.mark.parametrize(
    "change",
    [
        {"shader_pack": '"); import os; ("'},
        {"position": (float("nan"), 0.0, 0.0)},
        {"position": (1e300, 0.0, 0.0)},
        {"quaternion": (0.0, 0.0, 0.0, 0.0)},
        {"fov": 4.0},
        {"fov": None},
        {"near": 5.0, "far": 1.0},
        {"width": 0},
        {"height": 2.5},
    ],
)
def test_invalid_camera_settings_are_never_written(before: CameraSettings, change: dict[str, Any]) -> None:
    plan = edit({FILE: TWO}, before, dataclasses.replace(before, **change))
    assert isinstance(plan, RefusedEdit) and not plan.snippet


def forged_report(ran: HookCameras, **changes: Any) -> RunHooks:
    """Run hooks as a worker that reports `changes` for the camera."""
    return lambda sources: HookCameras(
        {**ran.cameras, KEY: dataclasses.replace(ran.cameras[KEY], **changes)}, ran.owners
    )


@pytest.mark.parametrize(
    ("place", "reason"),
    [
        (Place("/etc/passwd", 0, 10), "not one of your files"),
        (Place(FILE, -5, 10**9), "differs from the text that ran"),
        (Place(FILE, 3, 17), "differs from the text that ran"),
    ],
)
@pytest.mark.parametrize("of", ["call", "argument", "read", "part"])
def test_a_worker_that_reports_false_places_changes_nothing(
    before: CameraSettings, place: Place, reason: str, of: str
) -> None:
    ran = run_class({FILE: TWO})
    trace = ran.cameras[KEY].trace
    assert trace is not None
    pose = trace.parts["pose"]
    if of == "call":
        trace = dataclasses.replace(trace, at=place)
    elif of == "read":
        lie = dataclasses.replace(pose, reads=(Read(place, "somebody"),))
        trace = dataclasses.replace(trace, parts={**trace.parts, "pose": lie})
    elif of == "argument":
        lie = dataclasses.replace(pose, at=place)
        trace = dataclasses.replace(trace, parts={**trace.parts, "pose": lie})
    else:
        item = dataclasses.replace(pose.parts["p"].parts["2"], at=place)
        vector = dataclasses.replace(pose.parts["p"], parts={**pose.parts["p"].parts, "2": item})
        lie = dataclasses.replace(pose, parts={**pose.parts, "p": vector})
        trace = dataclasses.replace(trace, parts={**trace.parts, "pose": lie})
    plan = edit({FILE: TWO}, before, higher(before), forged_report(ran, trace=trace))
    assert isinstance(plan, RefusedEdit) and reason in plan.reason


def test_an_installed_file_is_left_alone(before: CameraSettings) -> None:
    path = "/usr/lib/python3/site-packages/mani_skill/envs/tasks/task.py"
    plan = edit({path: TWO}, before, higher(before))
    assert isinstance(plan, RefusedEdit) and "copy the task" in plan.reason


PLACES = """\
import numpy as np

EYE = np.array([0.5, 0, 0.5])  # above the table
SIZE = 128
"""
IMPORTING = HEADER + dedent(
    """\
    import places
    from places import EYE


    class Task(Base):
        @property
        def _default_sensor_configs(self):
            return [CameraConfig("cam", sapien.Pose(EYE), places.SIZE, 64, 1.0)]
    """
)


def test_a_constant_of_another_file_is_changed_there() -> None:
    sources = {FILE: IMPORTING, "/author/places.py": PLACES}
    before = real_settings(sources, "cam")
    plan = edit(sources, before, higher(before))
    assert isinstance(plan, SourceEdit), plan
    assert plan.file == "/author/places.py"
    assert "EYE = np.array([0.5, 0, 0.75])  # above the table" in plan.new_text
    assert plan.settings == real_settings(sources | {plan.file: plan.new_text}, "cam")


def test_a_constant_that_another_file_reads_stays_unchanged() -> None:
    sources = {
        FILE: IMPORTING,
        "/author/places.py": PLACES,
        "/author/more.py": "from places import EYE\nx = EYE\n",
    }
    before = real_settings(sources, "cam")
    plan = edit(sources, before, higher(before))
    assert isinstance(plan, SourceEdit) and plan.file == FILE
    assert "sapien.Pose([0.5, 0, 0.75])" in plan.new_text
    assert any("more.py" in note for note in plan.notes)


def test_one_plan_can_change_two_files() -> None:
    sources = {FILE: IMPORTING, "/author/places.py": PLACES}
    before = real_settings(sources, "cam")
    after = dataclasses.replace(higher(before), height=100)
    plan = edit(sources, before, after)
    assert isinstance(plan, SourceEdit), plan
    assert [change.file for change in plan.changes] == [FILE, "/author/places.py"]
    assert "places.SIZE, 100, 1.0" in plan.new_text and "[0.5, 0, 0.75]" in plan.others[0].new_text
    assert [change.diff.count("+++") for change in plan.changes] == [1, 1] and plan.notes[-1].startswith(
        "2 files change together"
    )
    new = {change.file: change.new_text for change in plan.changes}
    assert plan.settings == real_settings(sources | new, "cam")


def test_settings_that_env_arguments_override_are_left_alone_with_a_note(before: CameraSettings) -> None:
    running = dataclasses.replace(before, width=640, height=480)
    plan = edit({FILE: TWO}, running, higher(running))
    assert isinstance(plan, SourceEdit) and plan.settings is not None
    assert (plan.settings.width, plan.settings.height) == (640, 480)
    assert "not changed there" in plan.notes[-1]
    plan = edit({FILE: TWO}, running, dataclasses.replace(running, width=320))
    assert isinstance(plan, RefusedEdit) and "gym.make" in plan.reason


def test_an_intrinsic_replaces_a_fov_and_back() -> None:
    source = HEADER + dedent(
        """\
        class Task(Base):
            @property
            def _default_sensor_configs(self):
                return [
                    CameraConfig("cam", sapien.Pose([0.5, 0, 0.5]), 128, 128, fov=1.0),
                    CameraConfig("other", sapien.Pose([0.5, 0, 0.5]), 128, 128, 1.0, 0.01, 100),
                ]
        """
    )
    matrix = ((110.5, 0.0, 64.0), (0.0, 110.25, 63.5), (0.0, 0.0, 1.0))
    for uid in ("cam", "other"):
        before = real_settings({FILE: source}, uid)
        after = dataclasses.replace(before, fov=None, intrinsic=matrix)
        plan = planned(plan_edit, {FILE: source}, ("sensor", uid), before, after, run_class)
        assert isinstance(plan, SourceEdit), plan
        assert real_settings({FILE: plan.new_text}, uid) == plan.settings == after
        assert "intrinsic=np.array([[110.5, 0.0, 64.0], [" in plan.new_text
        back = planned(plan_edit, {FILE: plan.new_text}, ("sensor", uid), after, before, run_class)
        assert isinstance(back, SourceEdit), back
        assert real_settings({FILE: back.new_text}, uid) == back.settings == before


def test_a_change_that_would_also_change_another_camera_is_refused() -> None:
    source = HEADER + dedent(
        """\
        from places import EYE as ONE
        from places import EYE as OTHER


        class Task(Base):
            @property
            def _default_sensor_configs(self):
                return [
                    CameraConfig("cam", sapien.Pose(ONE), 64, 64, 1.0),
                    CameraConfig("hand", sapien.Pose(OTHER), 64, 64, 1.0),
                ]
        """
    )
    sources = {FILE: source, "/author/places.py": PLACES}
    before = real_settings(sources, "cam")
    plan = edit(sources, before, higher(before))
    assert isinstance(plan, RefusedEdit) and "hand" in plan.reason
    assert "p=[0.5, 0.0, 0.75]" in plan.snippet
