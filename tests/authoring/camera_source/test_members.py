"""Cameras added, duplicated, renamed and removed, as ManiSkill then has them."""

from __future__ import annotations

import dataclasses

import pytest

from tests.authoring.camera_source.real_cameras import (
    FILE,
    HEADER,
    close,
    comments,
    key_of,
    planned,
    real_configs,
    run_as,
    run_class,
    settings_of,
)
from tests.authoring.camera_source.shapes import REFUSED, WRITTEN
from workbench.authoring.camera_source.disk import SourceEdit
from workbench.authoring.camera_source.members import plan_add, plan_duplicate, plan_remove, plan_rename
from workbench.authoring.camera_source.plan import plan_edit
from workbench.authoring.source.text import RefusedEdit
from workbench.core.camera_data import CameraKind, CameraSettings
from workbench.core.cameras.conventions import LookAt, pose_from_look_at, with_pose

NEW = CameraSettings((0.1, 0.25, 1.5), (0.5, 0.5, 0.5, -0.5), 1.25, None, 64, 48, 0.02, 12.0, "default")
HUMAN = "_default_human_render_camera_configs"
SENSOR = "_default_sensor_configs"
ALONE = (
    "configs with names of their own",
    "a name used for one after the other",
    "made by a method",
    "a function within the hook",
)
TOP = [name for name, text in WRITTEN.items() if SENSOR in text]


def cameras(text: str) -> dict[tuple[str, str], CameraSettings]:
    return {key: settings_of(config) for key, config in real_configs({FILE: text}).items()}


def same_cameras(a: dict[tuple[str, str], CameraSettings], b: dict[tuple[str, str], CameraSettings]) -> bool:
    return list(a) == list(b) and all(close(a[key], b[key]) for key in a)


@pytest.mark.parametrize("name", TOP)
def test_a_camera_is_added_last(name: str) -> None:
    source = WRITTEN[name]
    plan = planned(plan_add, {FILE: source}, FILE, "Task", ("sensor", "added"), NEW, run_as("Task"))
    if isinstance(plan, RefusedEdit):
        assert "branches with" in name and "2 returns" in plan.reason and plan.snippet
        return
    assert same_cameras(cameras(plan.new_text), cameras(source) | {(SENSOR, "added"): NEW}), plan.diff
    assert comments(plan.new_text) == comments(source)
    assert plan.settings is not None and close(plan.settings, cameras(plan.new_text)[SENSOR, "added"])


@pytest.mark.parametrize("kind", ["sensor", "human"])
def test_a_hook_is_made_where_there_is_none(kind: CameraKind) -> None:
    source = "from __future__ import annotations\n\nclass Task:\n    eye = 1\n\n\nx = 2\n"
    plan = planned(plan_add, {FILE: source}, FILE, "Task", (kind, "added"), NEW, run_as("Task"))
    assert isinstance(plan, SourceEdit), plan
    hook = SENSOR if kind == "sensor" else HUMAN
    assert same_cameras(cameras(plan.new_text), {(hook, "added"): NEW})
    assert len(plan.notes) == 2
    again = planned(plan_add, {FILE: plan.new_text}, FILE, "Task", (kind, "more"), NEW, run_as("Task"))
    assert isinstance(again, SourceEdit) and not again.notes
    assert list(cameras(again.new_text)) == [(hook, "added"), (hook, "more")]
    twice = planned(plan_add, {FILE: plan.new_text}, FILE, "Task", (kind, "added"), NEW, run_as("Task"))
    assert isinstance(twice, RefusedEdit) and "already" in twice.reason


def test_what_cannot_be_added_to_is_refused() -> None:
    plan = planned(
        plan_add,
        {FILE: REFUSED["a comprehension"][0]},
        FILE,
        "Task",
        ("sensor", "added"),
        NEW,
        run_as("Task"),
    )
    assert isinstance(plan, RefusedEdit) and "neither" in plan.reason
    assert 'CameraConfig(\n    "added"' in plan.snippet
    parent = WRITTEN["a pose of nothing"] + "\n\nclass Child(Task):\n    pass\n"
    plan = planned(plan_add, {FILE: parent}, FILE, "Child", ("sensor", "added"), NEW, run_as("Child"))
    assert isinstance(plan, RefusedEdit) and "inherits" in plan.reason
    library = "from mani_skill.envs.tasks import PickCubeEnv\n\n\nclass Task(PickCubeEnv):\n    pass\n"
    plan = planned(plan_add, {FILE: library}, FILE, "Task", ("sensor", "added"), NEW, run_as("Task"))
    assert isinstance(plan, RefusedEdit) and "would remove" in plan.reason
    for name in ("no name", 'x"); import os; ("', ""):
        plan = planned(plan_add, {FILE: parent}, FILE, "Task", ("sensor", name), NEW, run_as("Task"))
        assert isinstance(plan, RefusedEdit) and "is not a name" in plan.reason


@pytest.mark.parametrize("name", WRITTEN)
def test_a_copy_stands_beside_its_original(name: str) -> None:
    source = WRITTEN[name]
    now = cameras(source)
    key = next(key for key in now if key[1] == "cam")
    plan = planned(plan_duplicate, {FILE: source}, key_of(source), "copy", now[key], run_class)
    if isinstance(plan, RefusedEdit):
        assert "is in no list or dict" in plan.reason and plan.snippet
        assert name in ALONE
        return
    assert same_cameras(cameras(plan.new_text), now | {(key[0], "copy"): now[key]}), plan.diff


@pytest.mark.parametrize("name", WRITTEN)
def test_a_camera_has_another_name(name: str) -> None:
    source = WRITTEN[name]
    now = cameras(source)
    key = next(key for key in now if key[1] == "cam")
    plan = planned(plan_rename, {FILE: source}, key_of(source), "front", now[key], run_class)
    assert isinstance(plan, SourceEdit), plan
    wanted = {(hook, "front" if uid == "cam" else uid): value for (hook, uid), value in now.items()}
    assert same_cameras(cameras(plan.new_text), wanted), plan.diff
    other = next((uid for _, uid in now if uid != "cam"), None)
    if other is not None:
        assert isinstance(
            planned(plan_rename, {FILE: source}, key_of(source), other, now[key], run_class), RefusedEdit
        )


@pytest.mark.parametrize("name", WRITTEN)
def test_a_camera_is_taken_out(name: str) -> None:
    source = WRITTEN[name]
    plan = planned(plan_remove, {FILE: source}, key_of(source), run_class)
    if isinstance(plan, RefusedEdit):
        assert "by hand" in plan.reason
        assert name in ALONE
        return
    wanted = {key: value for key, value in cameras(source).items() if key[1] != "cam"}
    assert same_cameras(cameras(plan.new_text), wanted), plan.diff
    assert plan.settings is None


def test_what_is_made_in_a_loop_is_refused() -> None:
    source = REFUSED["a loop with a plain name"][0]
    for plan in (
        planned(plan_remove, {FILE: source}, key_of(source), run_class),
        planned(plan_rename, {FILE: source}, key_of(source), "front", NEW, run_class),
        planned(plan_duplicate, {FILE: source}, key_of(source), "front", NEW, run_class),
    ):
        assert isinstance(plan, RefusedEdit) and "loop" in plan.reason


def hook(body: str) -> str:
    return f"{HEADER}class Task(Base):\n    @property\n    def {SENSOR}(self):\n{body}"


BESIDE_LOOK_AT = """\
        pose = sapien_utils.look_at(eye=[0.45, 0, 0.6], target=[0.08, 0, 0])
        return [CameraConfig("cam", pose=pose, width=128, height=128, fov=1.0, near=0.01, far=10)]
"""


@pytest.mark.parametrize("forward", [(0, 0, -1), (0, 0, 1)])
def test_straight_down_and_up_look_at_is_not_used(forward: tuple[float, float, float]) -> None:
    x, y, z = forward
    wanted = with_pose(NEW, pose_from_look_at(LookAt((0.1, 0.2, 0.9), (0.1 + x, 0.2 + y, 0.9 + z))))
    plan = planned(
        plan_add, {FILE: hook(BESIDE_LOOK_AT)}, FILE, "Task", ("sensor", "side"), wanted, run_as("Task")
    )
    assert isinstance(plan, SourceEdit) and "q=[" in plan.diff
    assert close(wanted, cameras(plan.new_text)[SENSOR, "side"])


@pytest.mark.parametrize(
    "name",
    # How a file writes its cameras and how it ends its lines have little to do with each other.
    [
        pytest.param(name, marks=[pytest.mark.slow] if number % 7 else [])
        for number, name in enumerate(WRITTEN)
    ],
)
def test_a_file_of_windows_is_edited_as_any_other_and_keeps_its_line_ends(name: str) -> None:
    sources = (WRITTEN[name], WRITTEN[name].replace("\n", "\r\n"))
    now = cameras(sources[0])[next(key for key in cameras(sources[0]) if key[1] == "cam")]
    after = dataclasses.replace(now, position=(0.1, 0.25, 1.1), width=320, shader_pack="default")
    key = key_of(sources[0])
    for plan in (
        lambda source: planned(plan_edit, {FILE: source}, key, now, after, run_class),
        lambda source: planned(plan_add, {FILE: source}, FILE, "Task", (key[0], "added"), NEW, run_class),
        lambda source: planned(plan_duplicate, {FILE: source}, key, "copy", after, run_class),
        lambda source: planned(plan_rename, {FILE: source}, key, "front", now, run_class),
        lambda source: planned(plan_remove, {FILE: source}, key, run_class),
    ):
        one, other = (plan(source) for source in sources)
        if isinstance(one, RefusedEdit):
            assert isinstance(other, RefusedEdit) and vars(other) == vars(one)
        else:
            assert isinstance(other, SourceEdit) and other.old_text == sources[1]
            assert other.new_text == one.new_text.replace("\n", "\r\n")
            assert (other.notes, other.settings) == (one.notes, one.settings)
