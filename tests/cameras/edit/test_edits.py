"""Edits of cameras in any style: the file parses, ManiSkill builds the requested camera, and nothing else changes."""

from __future__ import annotations

import ast
import dataclasses
import math
import re
from typing import Any

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from mani_skill.utils import sapien_utils

from tests.cameras.edit.real_cameras import (
    FILE,
    HEADER,
    close,
    comments,
    looking,
    planned,
    real_configs,
    real_settings,
    run_as,
    run_class,
    settings_of,
    unit,
)
from tests.cameras.edit.shapes import REFUSED, WRITTEN
from tests.drive.tiers import tries
from workbench.cameras.edit.hook_cameras import HOOKS as KINDS
from workbench.cameras.edit.hook_cameras import changed_fields
from workbench.cameras.edit.members import plan_add, plan_duplicate, plan_remove, plan_rename
from workbench.cameras.edit.plan import plan_edit
from workbench.envs.camera_data import CameraKey, CameraKind, CameraSettings
from workbench.pictures.camera_conventions import angle_between
from workbench.source.parsed import RefusedEdit
from workbench.task.write_edits import SourceEdit

NEW = CameraSettings((0.1, 0.25, 1.5), (0.5, 0.5, 0.5, -0.5), 1.25, None, 64, 48, 0.02, 12.0, "default")
HUMAN = "_default_human_render_camera_configs"
SENSOR = "_default_sensor_configs"
KEY: CameraKey = ("sensor", "cam")
LIST = WRITTEN["a list, positional to the end"]
WHY_NOT = {
    "edit": "smaller than the precision|is given by [*] or",
    "add": "2 returns",
    "duplicate": "not in a list or dict",
    "rename": "$.",
    "remove": "by hand",
}
"""Allowed reasons to refuse an edit of a camera in `WRITTEN`, by kind of edit; a rename is never refused."""
Cameras = dict[tuple[str, str], CameraSettings]
metres = st.floats(-4, 4)
points = st.tuples(metres, metres, metres)
quaternions = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: math.hypot(*q) > 0.1).map(unit)


@st.composite
def poses(draw: st.DrawFn) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Draw level poses, rolled poses, and poses that look straight or almost straight up or down."""
    eye, kind = draw(points), draw(st.sampled_from(("level", "any", "vertical")))
    if kind == "any":
        return eye, draw(quaternions)
    aside = draw(st.sampled_from((0.0, 1e-7, 1e-5, 1e-4, 1e-3, 1e-2)))
    up = draw(st.sampled_from((-1, 1)))
    target = draw(points) if kind == "level" else (eye[0] + aside, eye[1] - aside / 2, eye[2] + up)
    quaternion = tuple(sapien_utils.look_at(eye, target).raw_pose[0, 3:].tolist())
    if abs(math.hypot(*quaternion) - 1) > 1e-4:
        quaternion = draw(st.sampled_from(((0.5, 0.5, 0.5, -0.5), (0.7071068, 0, -0.7071068, 0))))
    assume(math.dist(eye, target) > 1e-3)
    return eye, unit(quaternion)


@st.composite
def changes(draw: st.DrawFn, before: CameraSettings) -> CameraSettings:
    """Draw settings with a new pose, a new lens or a new size, or several of them."""
    after = before
    what = draw(st.sets(st.sampled_from(("pose", "lens", "size")), min_size=1))
    if "pose" in what:
        eye, quaternion = draw(poses())
        after = dataclasses.replace(after, position=eye, quaternion=quaternion)
    if "lens" in what and before.fov is not None:
        after = dataclasses.replace(after, fov=draw(st.floats(0.05, 3.0)))
    elif "lens" in what and before.intrinsic is not None:
        row = (draw(st.floats(100, 900)), 0.0, 301.0)
        after = dataclasses.replace(after, intrinsic=(row, *before.intrinsic[1:]))
    if "size" in what:
        after = dataclasses.replace(after, width=draw(st.integers(1, 2000)), near=0.02)
    return after


def cameras(text: str) -> Cameras:
    return {key: settings_of(config) for key, config in real_configs({FILE: text}).items()}


def same_cameras(a: Cameras, b: Cameras) -> bool:
    return list(a) == list(b) and all(close(a[key], b[key]) for key in a)


def near_enough(written: CameraSettings, wanted: CameraSettings) -> bool:
    """Return whether both agree to the precision that is written into files: 0.1 mm and 0.01 degrees."""
    return (
        math.dist(written.position, wanted.position) <= 2e-4
        and angle_between(written.quaternion, wanted.quaternion) <= math.radians(0.011)
        and abs((written.fov or 0) - (wanted.fov or 0)) <= math.radians(0.01)
        and (written.width, written.height) == (wanted.width, wanted.height)
        and abs(written.near - wanted.near) <= 1e-4
    )


@pytest.mark.thorough
@pytest.mark.parametrize("name", WRITTEN)
@settings(max_examples=tries(4, 10))
@given(data=st.data(), what=st.sampled_from(["edit", "edit", "add", "duplicate", "rename", "remove"]))
def test_an_edit_changes_only_the_requested_camera(name: str, data: st.DataObject, what: str) -> None:
    source = WRITTEN[name]
    now = cameras(source)
    ((hook, _),) = [key for key in now if key[1] == "cam"]
    key, before = (KINDS[hook], "cam"), now[hook, "cam"]
    if windows := data.draw(st.booleans(), "Windows line endings"):
        source = source.replace("\n", "\r\n")
    after = data.draw(changes(before), "after")
    assume(changed_fields(before, after))
    given: Any
    if what == "edit":
        given = planned(plan_edit, {FILE: source}, key, before, after, run_class)
    elif what == "add":
        given = planned(plan_add, {FILE: source}, FILE, "Task", ("sensor", "added"), NEW, run_as("Task"))
    elif what == "duplicate":
        given = planned(plan_duplicate, {FILE: source}, key, "copy", before, run_class)
    elif what == "rename":
        given = planned(plan_rename, {FILE: source}, key, "front", before, run_class)
    else:
        given = planned(plan_remove, {FILE: source}, key, run_class)
    if isinstance(given, RefusedEdit):
        assert re.search(WHY_NOT[what], given.reason), given.reason
        return
    found = cameras(given.new_text)
    if what == "edit":
        assert given.settings is not None and near_enough(given.settings, after), given.diff
        wanted = {**now, (hook, "cam"): given.settings}
        lines = given.new_text.splitlines()
        assert sum(line in lines for line in source.splitlines()) >= 0.7 * len(source.splitlines())
    elif what == "add":
        wanted = {**now, (SENSOR, "added"): NEW}
    elif what == "duplicate":
        wanted = {**now, (hook, "copy"): before}
    elif what == "rename":
        wanted = {(of, "front" if uid == "cam" else uid): value for (of, uid), value in now.items()}
    else:
        wanted = {key: value for key, value in now.items() if key[1] != "cam"}
    assert found.keys() == wanted.keys() and all(close(found[key], wanted[key]) for key in wanted), given.diff
    if what in ("edit", "add", "rename"):  # a duplicate copies comments, too
        assert comments(given.new_text.replace("\r\n", "\n")) == comments(source.replace("\r\n", "\n"))
    assert given.new_text.count("\n") == given.new_text.count("\r\n") or not windows


@pytest.mark.parametrize("name", REFUSED)
def test_an_unsafe_edit_is_refused_with_reason_and_snippet(name: str) -> None:
    source, reason = REFUSED[name]
    before = real_settings({FILE: source}, "cam")
    ((hook, _),) = [key for key in real_configs({FILE: source}) if key[1] == "cam"]
    eye = (before.position[0] + 0.1, before.position[1] - 0.2034, before.position[2] + 0.3)
    after = dataclasses.replace(before, position=eye, quaternion=looking(eye, (0.05, 0.1, 0.02)))
    plan = planned(plan_edit, {FILE: source}, (KINDS[hook], "cam"), before, after, run_class)
    assert isinstance(plan, RefusedEdit), plan.diff
    assert reason in plan.reason
    assert ast.parse(plan.snippet)
    # The snippet builds the requested camera.
    task = f"{source}\n\nclass Copied(Base):\n    _sensor_configs = [{plan.snippet}]\n"
    assert near_enough(real_settings({FILE: task}, "cam", class_name="Copied"), after)


@pytest.mark.parametrize(
    ("name", "change", "text"),
    [
        ("one argument per line, with comments", {"fov": math.radians(48.6)}, "fov=48.6 * np.pi / 180,"),
        ("euler angles in degrees", {"fov": math.radians(48.6)}, "np.radians(48.6)"),
        ("arithmetic with a height", {"position": (0.3512, 0, 0.9)}, "eye = [0.3512, 0, TABLE + 0.7]"),
    ],
)
def test_an_edit_changes_the_number_that_an_author_would_change(
    name: str, change: dict[str, Any], text: str
) -> None:
    before = real_settings({FILE: WRITTEN[name]}, "cam")
    after = dataclasses.replace(before, **change)
    plan = planned(plan_edit, {FILE: WRITTEN[name]}, KEY, before, after, run_class)
    assert isinstance(plan, SourceEdit) and text in plan.new_text


TWO = f"""{HEADER}
class Task(Base):
    @property
    def _default_sensor_configs(self):
        return [
            CameraConfig("cam", sapien.Pose([0.450, 0.00, 0.90]), 64, 48, 1.0, 0.01, 10),  # over the table
            CameraConfig("other", sapien.Pose([1, 0, 1]), 64, 48, 1.0, 0.01, 10),
        ]
"""


def test_a_number_that_stays_the_same_keeps_its_text() -> None:
    before = real_settings({FILE: TWO}, "cam")
    after = dataclasses.replace(before, position=(0.45, 0.25, 0.9))
    plan = planned(plan_edit, {FILE: TWO}, KEY, before, after, run_class)
    assert isinstance(plan, SourceEdit) and "[0.450, 0.25, 0.90]" in plan.new_text


def test_a_rename_notes_the_places_that_still_have_the_old_name() -> None:
    for text, count in ((TWO, 0), (TWO + '\nSHOWN, OTHERS = ["cam", \'cam\'], "cameras"\n', 2)):
        plan = planned(plan_rename, {FILE: text}, KEY, "front", real_settings({FILE: text}, "cam"), run_class)
        assert isinstance(plan, SourceEdit) and plan.notes
        notes = [note for note in plan.notes if "'cam'" in note]
        assert len(notes) == bool(count) and all(f" {count} " in note for note in notes)


def test_a_camera_to_copy_is_mounted_where_the_refused_one_is() -> None:
    source = WRITTEN["Pose.create_from_pq in a robot"]
    before = dataclasses.replace(real_settings({FILE: source}, "cam"), fov=0.5)  # other code sets it
    after = dataclasses.replace(before, fov=0.7)
    plan = planned(plan_edit, {FILE: source}, KEY, before, after, run_class)
    assert isinstance(plan, RefusedEdit) and 'entity_uid="gripper_link"' in plan.snippet


def test_a_removed_camera_takes_its_comment_with_it() -> None:
    plan = planned(plan_remove, {FILE: TWO}, KEY, run_class)
    assert isinstance(plan, SourceEdit)
    lines = TWO.splitlines(keepends=True)
    assert plan.new_text == "".join(line for line in lines if '"cam"' not in line)


def test_a_second_edit_builds_on_the_first_and_the_placed_target_is_written() -> None:
    source, point = LIST, (1.5, 0.25, 0.3)
    before = real_settings({FILE: source}, "cam")
    eye = before.position
    after = dataclasses.replace(before, quaternion=looking(eye, point), distance=math.dist(eye, point))
    plan = planned(plan_edit, {FILE: source}, KEY, before, after, run_class)
    assert isinstance(plan, SourceEdit) and plan.settings is not None
    found = re.search(r"target=\[(.*?)\]\)", plan.new_text)
    assert found and math.dist([float(number) for number in found[1].split(",")], point) < 1e-3
    rolled = dataclasses.replace(plan.settings, position=(0.2, 0.0, 0.9), quaternion=(0.5, 0.5, 0.5, -0.5))
    again = planned(plan_edit, {FILE: plan.new_text}, KEY, plan.settings, rolled, run_class)
    assert isinstance(again, SourceEdit) and "q=[0.5, 0.5, 0.5, -0.5]" in again.new_text


@pytest.mark.parametrize("kind", ["sensor", "human"])
def test_a_missing_hook_is_added(kind: CameraKind) -> None:
    source = "from __future__ import annotations\n\nclass Task:\n    eye = 1\n\n\nx = 2\n"

    def add(text: str, name: str) -> SourceEdit | RefusedEdit:
        return planned(plan_add, {FILE: text}, FILE, "Task", (kind, name), NEW, run_as("Task"))

    plan, hook = add(source, "added"), SENSOR if kind == "sensor" else HUMAN
    assert isinstance(plan, SourceEdit), plan
    assert same_cameras(cameras(plan.new_text), {(hook, "added"): NEW}) and len(plan.notes) == 2
    again, twice = add(plan.new_text, "more"), add(plan.new_text, "added")
    assert isinstance(again, SourceEdit) and not again.notes
    assert list(cameras(again.new_text)) == [(hook, "added"), (hook, "more")]
    assert isinstance(twice, RefusedEdit) and "already" in twice.reason


def test_impossible_additions_and_removals_are_refused() -> None:
    def add(text: str, class_name: str = "Task", name: str = "added") -> SourceEdit | RefusedEdit:
        key = ("sensor", name)
        return planned(plan_add, {FILE: text}, FILE, class_name, key, NEW, run_as(class_name))

    plan = add(REFUSED["a comprehension"][0])
    assert isinstance(plan, RefusedEdit) and 'CameraConfig(\n    "added"' in plan.snippet
    parent = WRITTEN["a default pose"] + "\n\nclass Child(Task):\n    pass\n"
    library = "from mani_skill.envs.tasks import PickCubeEnv\n\n\nclass Task(PickCubeEnv):\n    pass\n"
    loop = REFUSED["a loop with a plain name"][0]
    for refused, reason in (
        (add(parent, "Child"), "inherits"),
        (add(library), "would remove"),
        *((add(parent, name=name), "is not a name") for name in ("no name", 'x"); import os; ("', "")),
        (planned(plan_remove, {FILE: loop}, KEY, run_class), "loop"),
        (planned(plan_rename, {FILE: loop}, KEY, "front", NEW, run_class), "loop"),
        (planned(plan_duplicate, {FILE: loop}, KEY, "front", NEW, run_class), "loop"),
    ):
        assert isinstance(refused, RefusedEdit) and reason in refused.reason
