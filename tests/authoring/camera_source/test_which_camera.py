"""Which call is meant, in which file, and what is said when that cannot be told."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from textwrap import dedent
from typing import Any

import pytest

from tests.authoring.camera_source.real_cameras import FILE, HEADER, real_settings
from workbench.authoring.camera_source import Refusal, SourceEdit, plan_edit
from workbench.core.camera_settings import CallSite, CameraSettings

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


def higher(now: CameraSettings) -> CameraSettings:
    return dataclasses.replace(now, position=(0.5, 0.0, 0.75))


def edited_line(plan: SourceEdit | Refusal) -> int:
    assert isinstance(plan, SourceEdit), plan
    pairs = zip(plan.old_text.splitlines(), plan.new_text.splitlines(), strict=True)
    (line,) = [number for number, (old, new) in enumerate(pairs, 1) if old != new]
    return line


def test_kind_tells_a_sensor_from_a_camera_for_people() -> None:
    before = real_settings({FILE: TWO}, "cam", "_default_sensor_configs")
    assert edited_line(plan_edit({FILE: TWO}, "cam", before, higher(before), kind="sensor")) == LINE
    people = real_settings({FILE: TWO}, "cam", "_default_human_render_camera_configs")
    assert edited_line(plan_edit({FILE: TWO}, "cam", people, higher(people), kind="human")) == LINE + 4


def test_two_of_one_name_and_value_are_told_apart_by_the_place_alone() -> None:
    source = TWO.replace("512, 512", "128, 128").replace('f"{name}"', '"cam"')
    before = real_settings({FILE: source}, "cam", "_default_sensor_configs")
    plan = plan_edit({FILE: source}, "cam", before, higher(before))
    assert isinstance(plan, Refusal) and "the same values" in plan.reason
    for line, function in (
        (LINE, "Task._default_sensor_configs"),
        (LINE + 11, "Other._default_sensor_configs"),
    ):
        plan = plan_edit({FILE: source}, "cam", before, higher(before), CallSite(FILE, line, function))
        assert edited_line(plan) == line


def test_a_computed_name_is_found_by_its_place() -> None:
    before = real_settings({FILE: TWO}, "cam", "_default_sensor_configs")
    site = CallSite(FILE, LINE + 11, "Other._default_sensor_configs")
    assert edited_line(plan_edit({FILE: TWO}, "cam", before, higher(before), site)) == LINE + 11


def test_a_place_that_remarks_have_moved_is_still_found() -> None:
    before = real_settings({FILE: TWO}, "cam", "_default_sensor_configs")
    for line in (1, LINE + 4, 1000):
        site = CallSite(FILE, line, "Task._default_sensor_configs")
        assert edited_line(plan_edit({FILE: TWO}, "cam", before, higher(before), site)) == LINE


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
def test_what_is_no_camera_never_reaches_the_file(change: dict[str, Any]) -> None:
    before = real_settings({FILE: TWO}, "cam", "_default_sensor_configs")
    plan = plan_edit({FILE: TWO}, "cam", before, dataclasses.replace(before, **change), kind="sensor")
    assert isinstance(plan, Refusal) and not plan.snippet


def test_the_snippet_of_a_mounted_camera_has_its_mount() -> None:
    source = TWO.replace(
        "sapien.Pose([0.5, 0, 0.5]), 128, 128, 1.0)", "POSE.inv(), 128, 128, 1.0, mount=self.link)"
    )
    before = real_settings({FILE: TWO}, "cam", "_default_sensor_configs")
    plan = plan_edit({FILE: source}, "cam", before, higher(before), kind="sensor")
    assert isinstance(plan, Refusal) and "    mount=self.link,\n" in plan.snippet


@pytest.mark.parametrize(
    ("site", "reason"),
    [
        (CallSite("/usr/site-packages/x.py", 3, "f"), "copy the task"),
        (CallSite("/other/x.py", 3, "f"), "not one of your files"),
        (CallSite(FILE, 1, "f"), "edited since"),
    ],
)
def test_a_place_that_is_none_is_refused(site: CallSite, reason: str) -> None:
    before = real_settings({FILE: TWO}, "cam", "_default_sensor_configs")
    plan = plan_edit({FILE: TWO}, "cam", before, higher(before), site)
    assert isinstance(plan, Refusal) and reason in plan.reason
    assert "p=[0.5, 0.0, 0.75]" in plan.snippet


def test_an_installed_file_is_left_alone() -> None:
    path = "/usr/lib/python3/site-packages/mani_skill/envs/tasks/task.py"
    before = real_settings({FILE: TWO}, "cam", "_default_sensor_configs")
    plan = plan_edit({path: TWO}, "cam", before, higher(before), kind="sensor")
    assert isinstance(plan, Refusal) and "copy the task" in plan.reason


def test_what_is_not_in_the_files_or_not_python_is_refused() -> None:
    before = real_settings({FILE: TWO}, "cam", "_default_sensor_configs")
    plan = plan_edit({FILE: TWO}, "hand", before, higher(before))
    assert isinstance(plan, Refusal) and "'hand'" in plan.reason
    plan = plan_edit({FILE: "cam = (\n"}, "cam", before, higher(before))
    assert isinstance(plan, Refusal) and "not valid Python" in plan.reason


def test_a_class_of_that_name_in_the_files_is_not_taken_for_maniskills() -> None:
    own = "class CameraConfig:\n    pass\n"
    source = TWO.replace("from mani_skill.sensors.camera import", "from configs import")
    before = real_settings({FILE: TWO}, "cam", "_default_sensor_configs")
    plan = plan_edit({FILE: source, "/author/configs.py": own}, "cam", before, higher(before), kind="sensor")
    assert isinstance(plan, Refusal) and "no CameraConfig" in plan.reason
    handed_on = TWO.replace("from mani_skill.sensors.camera import", "from mani_skill.sensors import")
    assert edited_line(plan_edit({FILE: handed_on}, "cam", before, higher(before), kind="sensor")) == LINE


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
    plan = plan_edit(sources, "cam", before, higher(before))
    assert isinstance(plan, SourceEdit), plan
    assert plan.file == "/author/places.py"
    assert "EYE = np.array([0.5, 0, 0.75])  # above the table" in plan.new_text
    assert plan.settings == real_settings(sources | {plan.file: plan.new_text}, "cam")


def test_a_constant_that_another_file_reads_is_left_as_it_is() -> None:
    sources = {
        FILE: IMPORTING,
        "/author/places.py": PLACES,
        "/author/more.py": "from places import EYE\nx = EYE\n",
    }
    before = real_settings(sources, "cam")
    plan = plan_edit(sources, "cam", before, higher(before))
    assert isinstance(plan, SourceEdit) and plan.file == FILE
    assert "sapien.Pose([0.5, 0, 0.75])" in plan.new_text
    assert any("more.py" in note for note in plan.notes)


def test_a_change_of_two_files_is_one_plan_with_both() -> None:
    sources = {FILE: IMPORTING, "/author/places.py": PLACES}
    before = real_settings(sources, "cam")
    after = dataclasses.replace(higher(before), height=100)
    plan = plan_edit(sources, "cam", before, after)
    assert isinstance(plan, SourceEdit), plan
    assert [change.file for change in plan.changes] == [FILE, "/author/places.py"]
    assert "places.SIZE, 100, 1.0" in plan.new_text and "[0.5, 0, 0.75]" in plan.others[0].new_text
    assert plan.diff.count("+++") == 2 and plan.notes[-1].startswith("2 files change together")
    new = {change.file: change.new_text for change in plan.changes}
    assert plan.settings == real_settings(sources | new, "cam")


def test_what_an_argument_of_the_env_decides_is_left_alone_and_said() -> None:
    before = real_settings({FILE: TWO}, "cam", "_default_sensor_configs")
    running = dataclasses.replace(before, width=640, height=480)
    plan = plan_edit({FILE: TWO}, "cam", running, higher(running), kind="sensor")
    assert isinstance(plan, SourceEdit) and plan.settings is not None
    assert (plan.settings.width, plan.settings.height) == (640, 480)
    assert "left alone" in plan.notes[-1]
    plan = plan_edit({FILE: TWO}, "cam", running, dataclasses.replace(running, width=320), kind="sensor")
    assert isinstance(plan, Refusal) and "gym.make" in plan.reason


def test_nothing_changed_is_said() -> None:
    before = real_settings({FILE: TWO}, "cam", "_default_sensor_configs")
    assert isinstance(plan_edit({FILE: TWO}, "cam", before, before, kind="sensor"), Refusal)


def test_an_intrinsic_takes_the_place_of_a_fov_and_back() -> None:
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
        plan = plan_edit({FILE: source}, uid, before, after)
        assert isinstance(plan, SourceEdit), plan
        assert real_settings({FILE: plan.new_text}, uid) == plan.settings == after
        back = plan_edit({FILE: plan.new_text}, uid, after, before)
        assert isinstance(back, SourceEdit), back
        assert real_settings({FILE: back.new_text}, uid) == back.settings == before


def test_the_server_process_gets_no_simulator_by_it(child_process: None) -> None:
    code = (
        "import sys, workbench.authoring.camera_source\n"
        "print({'torch', 'sapien', 'mani_skill'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


def test_a_change_that_another_camera_would_make_too_is_refused() -> None:
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
    plan = plan_edit(sources, "cam", before, higher(before))
    assert isinstance(plan, Refusal) and "of the camera hand as well" in plan.reason
    assert "p=[0.5, 0.0, 0.75]" in plan.snippet
