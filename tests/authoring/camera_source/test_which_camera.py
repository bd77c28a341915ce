"""Which call is meant, in which file, and what is said when that cannot be told."""

from __future__ import annotations

import dataclasses
import math
import subprocess
import sys
from textwrap import dedent
from typing import Any

import pytest

from tests.authoring.camera_source.real_cameras import FILE, HEADER, planned, real_settings, run_as, run_class
from workbench.authoring.camera_source.cameras import HookCameras, RunHooks
from workbench.authoring.camera_source.disk import SourceEdit
from workbench.authoring.camera_source.plan import plan_edit
from workbench.authoring.source.text import Place, Read, RefusedEdit
from workbench.core.camera_data import CallSite, CameraKey, CameraSettings

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


def edited_line(plan: SourceEdit | RefusedEdit) -> int:
    assert isinstance(plan, SourceEdit), plan
    pairs = zip(plan.old_text.splitlines(), plan.new_text.splitlines(), strict=True)
    (line,) = [number for number, (old, new) in enumerate(pairs, 1) if old != new]
    return line


def test_kind_tells_a_sensor_from_a_camera_for_people() -> None:
    before = real_settings({FILE: TWO}, "cam", "_default_sensor_configs")
    assert (
        edited_line(planned(plan_edit, {FILE: TWO}, ("sensor", "cam"), before, higher(before), run_class))
        == LINE
    )
    people = real_settings({FILE: TWO}, "cam", "_default_human_render_camera_configs")
    assert (
        edited_line(planned(plan_edit, {FILE: TWO}, ("human", "cam"), people, higher(people), run_class))
        == LINE + 4
    )


def test_two_of_one_name_and_value_are_told_apart_by_the_place() -> None:
    source = TWO.replace("512, 512", "128, 128").replace('f"{name}"', '"cam"')
    before = real_settings({FILE: source}, "cam", "_default_sensor_configs")
    for class_name, line in (("Task", LINE), ("Other", LINE + 11)):
        plan = planned(
            plan_edit, {FILE: source}, ("sensor", "cam"), before, higher(before), run_as(class_name)
        )
        assert edited_line(plan) == line


def test_a_computed_name_is_found_by_its_place() -> None:
    before = real_settings({FILE: TWO}, "cam", "_default_sensor_configs")
    plan = planned(plan_edit, {FILE: TWO}, ("sensor", "cam"), before, higher(before), run_as("Other"))
    assert edited_line(plan) == LINE + 11


def test_remarks_above_it_since_it_ran_do_not_matter() -> None:
    before = real_settings({FILE: TWO}, "cam", "_default_sensor_configs")
    moved = TWO.replace("class Task(Base):", "# more\n\n# Größe\n\nclass Task(Base):")
    plan = planned(plan_edit, {FILE: moved}, ("sensor", "cam"), before, higher(before), run_class)
    assert edited_line(plan) == LINE + 4


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
    plan = planned(
        plan_edit, {FILE: TWO}, ("sensor", "cam"), before, dataclasses.replace(before, **change), run_class
    )
    assert isinstance(plan, RefusedEdit) and not plan.snippet


def test_the_snippet_of_a_mounted_camera_has_its_mount() -> None:
    source = TWO.replace(
        "sapien.Pose([0.5, 0, 0.5]), 128, 128, 1.0)",
        "sapien.Pose([-0.5, 0, -0.5]).inv(), 128, 128, 1.0, mount=self.camera_link)",
    )
    before = real_settings({FILE: TWO}, "cam", "_default_sensor_configs")
    plan = planned(plan_edit, {FILE: source}, ("sensor", "cam"), before, higher(before), run_class)
    assert isinstance(plan, RefusedEdit) and "    mount=self.camera_link,\n" in plan.snippet


def told(ran: HookCameras, **changes: Any) -> RunHooks:
    """A worker that says something else of the camera."""
    key: CameraKey = ("sensor", "cam")
    return lambda sources: HookCameras(
        {**ran.cameras, key: dataclasses.replace(ran.cameras[key], **changes)}, ran.owners
    )


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"site": CallSite("/usr/site-packages/x.py", 3, "f")}, "copy the task"),
        ({"site": CallSite("/other/x.py", 3, "f"), "trace": None}, "not one of your files"),
        ({"site": CallSite(FILE, 1, "f"), "trace": None}, "a function or class of its own"),
        ({"site": None, "trace": None}, "no CameraConfig(...) in your files"),
        ({"made": None}, "cannot be read"),
    ],
)
def test_a_place_that_is_none_is_refused(changes: dict[str, Any], reason: str) -> None:
    before = real_settings({FILE: TWO}, "cam", "_default_sensor_configs")
    run = told(run_class({FILE: TWO}), **changes)
    plan = planned(plan_edit, {FILE: TWO}, ("sensor", "cam"), before, higher(before), run)
    assert isinstance(plan, RefusedEdit) and reason in plan.reason
    assert "p=[0.5, 0.0, 0.75]" in plan.snippet


@pytest.mark.parametrize(
    ("place", "reason"),
    [
        (Place("/etc/passwd", 0, 10), "not one of your files"),
        (Place(FILE, -5, 10**9), "differs from the text that ran"),
        (Place(FILE, 3, 17), "differs from the text that ran"),
    ],
)
@pytest.mark.parametrize("of", ["call", "argument", "read", "part"])
def test_a_worker_that_lies_about_places_changes_nothing(place: Place, reason: str, of: str) -> None:
    before = real_settings({FILE: TWO}, "cam", "_default_sensor_configs")
    ran = run_class({FILE: TWO})
    trace = ran.cameras["sensor", "cam"].trace
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
    plan = planned(plan_edit, {FILE: TWO}, ("sensor", "cam"), before, higher(before), told(ran, trace=trace))
    assert isinstance(plan, RefusedEdit) and reason in plan.reason


def test_an_installed_file_is_left_alone() -> None:
    path = "/usr/lib/python3/site-packages/mani_skill/envs/tasks/task.py"
    before = real_settings({FILE: TWO}, "cam", "_default_sensor_configs")
    plan = planned(plan_edit, {path: TWO}, ("sensor", "cam"), before, higher(before), run_class)
    assert isinstance(plan, RefusedEdit) and "copy the task" in plan.reason


def test_what_is_not_in_the_files_or_not_python_is_refused() -> None:
    before = real_settings({FILE: TWO}, "cam", "_default_sensor_configs")
    plan = planned(plan_edit, {FILE: TWO}, ("sensor", "hand"), before, higher(before), run_class)
    assert isinstance(plan, RefusedEdit) and "'hand'" in plan.reason
    plan = planned(plan_edit, {FILE: "cam = (\n"}, ("sensor", "cam"), before, higher(before), run_class)
    assert isinstance(plan, RefusedEdit) and "not valid Python" in plan.reason


def test_a_class_of_that_name_in_the_files_is_not_taken_for_maniskills() -> None:
    own = (
        "from mani_skill.sensors.camera import CameraConfig as Stock\n\n\nclass CameraConfig(Stock):\n"
        "    def __init__(self, *given):\n        super().__init__(*given)\n"
    )
    source = TWO.replace("from mani_skill.sensors.camera import", "from configs import")
    before = real_settings({FILE: TWO}, "cam", "_default_sensor_configs")
    plan = planned(
        plan_edit,
        {FILE: source, "/author/configs.py": own},
        ("sensor", "cam"),
        before,
        higher(before),
        run_class,
    )
    assert isinstance(plan, RefusedEdit) and "is given by * or **" in plan.reason
    handed_on = TWO.replace("from mani_skill.sensors.camera import", "from mani_skill.sensors import")
    assert (
        edited_line(
            planned(plan_edit, {FILE: handed_on}, ("sensor", "cam"), before, higher(before), run_class)
        )
        == LINE
    )


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
    plan = planned(plan_edit, sources, ("sensor", "cam"), before, higher(before), run_class)
    assert isinstance(plan, SourceEdit), plan
    assert plan.file == "/author/places.py"
    assert "EYE = np.array([0.5, 0, 0.75])  # above the table" in plan.new_text
    assert plan.settings == real_settings(sources | {plan.file: plan.new_text}, "cam")


def test_of_however_many_files_that_only_speak_of_it_a_constant_is_changed_where_it_is() -> None:
    more = {f"/author/more_{number}.py": f"# EYE is not read here\nx = {number}\n" for number in range(20)}
    sources = {FILE: IMPORTING, "/author/places.py": PLACES, **more}
    before = real_settings(sources, "cam")
    after = dataclasses.replace(higher(before), width=100)
    plan = planned(plan_edit, sources, ("sensor", "cam"), before, after, run_class)
    assert isinstance(plan, SourceEdit), plan
    assert plan.file == "/author/places.py" and not plan.others, plan.notes
    assert "EYE = np.array([0.5, 0, 0.75])" in plan.new_text and "SIZE = 100" in plan.new_text


def test_a_constant_that_another_file_reads_is_left_as_it_is() -> None:
    sources = {
        FILE: IMPORTING,
        "/author/places.py": PLACES,
        "/author/more.py": "from places import EYE\nx = EYE\n",
    }
    before = real_settings(sources, "cam")
    plan = planned(plan_edit, sources, ("sensor", "cam"), before, higher(before), run_class)
    assert isinstance(plan, SourceEdit) and plan.file == FILE
    assert "sapien.Pose([0.5, 0, 0.75])" in plan.new_text
    assert any("more.py" in note for note in plan.notes)


def test_a_constant_of_a_class_that_a_method_reads_too_is_left_as_it_is() -> None:
    source = HEADER + dedent(
        """\
        class Task(Base):
            EYE = [0.5, 0, 0.5]
            POSE = sapien.Pose(EYE)

            @property
            def _default_sensor_configs(self):
                return [CameraConfig("cam", self.POSE, 64, 64, 1.0)]

            def _load_scene(self, options):
                self.lamp.set_pose(sapien.Pose(self.EYE))
        """
    )
    before = real_settings({FILE: source}, "cam")
    plan = planned(plan_edit, {FILE: source}, ("sensor", "cam"), before, higher(before), run_class)
    assert isinstance(plan, SourceEdit), plan
    assert "EYE = [0.5, 0, 0.5]\n" in plan.new_text and "POSE = sapien.Pose([0.5, 0, 0.75])" in plan.new_text
    assert "also read elsewhere" in plan.notes[0]
    alone = source[: source.index("    def _load_scene")]
    plan = planned(plan_edit, {FILE: alone}, ("sensor", "cam"), before, higher(before), run_class)
    assert isinstance(plan, SourceEdit) and "EYE = [0.5, 0, 0.75]" in plan.new_text


def test_a_change_that_would_not_be_seen_in_what_is_written_is_refused() -> None:
    before = real_settings({FILE: TWO}, "cam", "_default_sensor_configs")
    after = dataclasses.replace(before, position=(0.5, 0.0, 0.50003))
    plan = planned(plan_edit, {FILE: TWO}, ("sensor", "cam"), before, after, run_class)
    assert isinstance(plan, RefusedEdit) and "smaller than what is written" in plan.reason


SHARED = dedent(
    """\
    X = 1 / 3
    POSE = sapien.Pose([X, 0, 0.5])


    class Task(Base):
        OWN = sapien.Pose([1 / 3, 0, 0.5])

        @property
        def _default_sensor_configs(self):
            return [CameraConfig("cam", POSE, 64, 64, 1.0), CameraConfig("own", self.OWN, 64, 64, 1.0)]

        @property
        def _default_human_render_camera_configs(self):
            return [CameraConfig("cam", POSE, 64, 64, 1.0), CameraConfig("own", self.OWN, 64, 64, 1.0)]
    """
)


@pytest.mark.parametrize(
    ("uid", "new"), [("cam", "sapien.Pose([X, 0, 0.75])"), ("own", "sapien.Pose([0.3333333, 0, 0.75])")]
)
def test_of_a_shared_pose_only_names_that_are_seen_there_go_into_the_camera(uid: str, new: str) -> None:
    source = HEADER + SHARED
    before = real_settings({FILE: source}, uid, "_default_sensor_configs")
    after = dataclasses.replace(before, position=(*before.position[:2], 0.75))
    plan = planned(plan_edit, {FILE: source}, ("sensor", uid), before, after, run_class)
    assert isinstance(plan, SourceEdit), plan
    assert f'CameraConfig("{uid}", {new}, 64, 64, 1.0)' in plan.new_text


def test_an_angle_of_another_file_that_others_read_comes_in_radians_and_as_finely_as_it_was_written() -> None:
    places = PLACES + "FOV = 60 * np.pi / 180\n"
    sources = {
        FILE: IMPORTING.replace("64, 1.0", "64, places.FOV"),
        "/author/places.py": places,
        "/author/more.py": "import places\nx = places.FOV\n",
    }
    before = real_settings(sources, "cam")
    after = dataclasses.replace(before, fov=math.radians(50.123))
    plan = planned(plan_edit, sources, ("sensor", "cam"), before, after, run_class)
    assert isinstance(plan, SourceEdit) and plan.file == FILE, plan
    assert "64, 0.874759)" in plan.new_text, "50.12 degrees"


def test_a_change_of_two_files_is_one_plan_with_both() -> None:
    sources = {FILE: IMPORTING, "/author/places.py": PLACES}
    before = real_settings(sources, "cam")
    after = dataclasses.replace(higher(before), height=100)
    plan = planned(plan_edit, sources, ("sensor", "cam"), before, after, run_class)
    assert isinstance(plan, SourceEdit), plan
    assert [change.file for change in plan.changes] == [FILE, "/author/places.py"]
    assert "places.SIZE, 100, 1.0" in plan.new_text and "[0.5, 0, 0.75]" in plan.others[0].new_text
    assert [change.diff.count("+++") for change in plan.changes] == [1, 1] and plan.notes[-1].startswith(
        "2 files change together"
    )
    new = {change.file: change.new_text for change in plan.changes}
    assert plan.settings == real_settings(sources | new, "cam")


def test_what_an_argument_of_the_env_decides_is_left_alone_and_said() -> None:
    before = real_settings({FILE: TWO}, "cam", "_default_sensor_configs")
    running = dataclasses.replace(before, width=640, height=480)
    plan = planned(plan_edit, {FILE: TWO}, ("sensor", "cam"), running, higher(running), run_class)
    assert isinstance(plan, SourceEdit) and plan.settings is not None
    assert (plan.settings.width, plan.settings.height) == (640, 480)
    assert "left alone" in plan.notes[-1]
    plan = planned(
        plan_edit, {FILE: TWO}, ("sensor", "cam"), running, dataclasses.replace(running, width=320), run_class
    )
    assert isinstance(plan, RefusedEdit) and "gym.make" in plan.reason


def test_nothing_changed_is_said() -> None:
    before = real_settings({FILE: TWO}, "cam", "_default_sensor_configs")
    assert isinstance(
        planned(plan_edit, {FILE: TWO}, ("sensor", "cam"), before, before, run_class), RefusedEdit
    )


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
        plan = planned(plan_edit, {FILE: source}, ("sensor", uid), before, after, run_class)
        assert isinstance(plan, SourceEdit), plan
        assert real_settings({FILE: plan.new_text}, uid) == plan.settings == after
        assert "intrinsic=np.array([[110.5, 0.0, 64.0], [" in plan.new_text
        back = planned(plan_edit, {FILE: plan.new_text}, ("sensor", uid), after, before, run_class)
        assert isinstance(back, SourceEdit), back
        assert real_settings({FILE: back.new_text}, uid) == back.settings == before


def test_the_server_process_gets_no_simulator_by_it(child_process: None) -> None:
    code = (
        "import sys\nfrom workbench.authoring.camera_source import members, plan\n"
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
    plan = planned(plan_edit, sources, ("sensor", "cam"), before, higher(before), run_class)
    assert isinstance(plan, RefusedEdit) and "also change the camera hand" in plan.reason
    assert "p=[0.5, 0.0, 0.75]" in plan.snippet
