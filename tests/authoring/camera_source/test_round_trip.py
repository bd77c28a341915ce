"""Any pose and any lens, in any form: what the edit says is what ManiSkill makes of the text, and what was asked for."""

from __future__ import annotations

import dataclasses
import math
import re

import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from mani_skill.utils import sapien_utils

from tests.authoring.camera_source.real_cameras import (
    FILE,
    close,
    looking,
    planned,
    real_settings,
    run_class,
    unit,
)
from tests.authoring.camera_source.shapes import WRITTEN
from workbench.authoring.camera_source.cameras import changed_fields
from workbench.authoring.camera_source.disk import SourceEdit
from workbench.authoring.camera_source.plan import plan_edit
from workbench.authoring.source.text import RefusedEdit
from workbench.core.camera_data import CameraKey, CameraSettings
from workbench.core.cameras.conventions import angle_between

KEY: CameraKey = ("sensor", "cam")
FORMS = (
    "a list, positional to the end",
    "sapien.Pose, positional",
    "a pose of nothing",
    "Pose.create_from_pq in a robot",
    "euler angles in degrees",
    "constants that are read twice",
    "arithmetic with a height",
    "almost straight down",
)
metres = st.floats(-4, 4, allow_nan=False)
points = st.tuples(metres, metres, metres)
quaternions = (
    st.tuples(*[st.floats(-1, 1) for _ in range(4)]).filter(lambda q: math.hypot(*q) > 0.1).map(unit)
)


@st.composite
def poses(draw: st.DrawFn) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Of all kinds: level ones, rolled ones, and such as look straight up or down, or almost."""
    eye = draw(points)
    kind = draw(st.sampled_from(("level", "any", "vertical")))
    if kind == "any":
        return eye, draw(quaternions)
    if kind == "vertical":
        aside = draw(st.sampled_from((0.0, 1e-7, 1e-5, 1e-4, 1e-3, 1e-2)))
        target = (eye[0] + aside, eye[1] - aside / 2, eye[2] + draw(st.sampled_from((-1, 1))))
    else:
        target = draw(points)
    quaternion = tuple(sapien_utils.look_at(eye, target).raw_pose[0, 3:].tolist())
    length = math.hypot(*quaternion)
    if abs(length - 1) > 1e-4:
        quaternion = draw(st.sampled_from(((0.5, 0.5, 0.5, -0.5), (0.7071068, 0, -0.7071068, 0))))
    assume(math.dist(eye, target) > 1e-3)
    return eye, unit(quaternion)


@pytest.mark.parametrize("form", FORMS)
@settings(max_examples=20)
@given(pose=poses(), fov=st.none() | st.floats(0.05, 3.0))
# Nearly straight down: an eye and a target of 32 bits each are 1e-7 m off, and that turns the picture.
@example(
    pose=(
        (0.0, 2.7949906740438433, 0.0),
        (0.688562431632316, 0.16242461897460614, 0.6877929952965568, -0.1626063237286198),
    ),
    fov=None,
)
def test_write_and_read_back(form: str, pose: tuple, fov: float | None) -> None:
    source = WRITTEN[form]
    before = _before(form)
    after = dataclasses.replace(before, position=pose[0], quaternion=pose[1], fov=fov or before.fov)
    assume(changed_fields(before, after))
    plan = planned(plan_edit, {FILE: source}, KEY, before, after, run_class)
    if isinstance(plan, RefusedEdit):
        assert "smaller than what is written" in plan.reason
        assume(False)
    assert isinstance(plan, SourceEdit) and plan.settings is not None
    real = real_settings({FILE: plan.new_text}, "cam")
    assert close(plan.settings, real), plan.diff
    assert math.dist(real.position, after.position) <= 1e-4
    assert angle_between(real.quaternion, after.quaternion) <= math.radians(0.011), plan.diff
    assert abs((real.fov or 0) - (after.fov or 0)) <= math.radians(0.01)


_known: dict[str, CameraSettings] = {}


def _before(form: str) -> CameraSettings:
    if form not in _known:
        _known[form] = real_settings({FILE: WRITTEN[form]}, "cam")
    return _known[form]


def test_a_second_edit_goes_on_from_the_first() -> None:
    source = WRITTEN["a list, positional to the end"]
    before = real_settings({FILE: source}, "cam")
    for pose in (((0.4, 0.1, 0.7), (0.1, 0.2, 0.3, 0.4)), ((0.2, 0.0, 0.9), (0.5, 0.5, 0.5, -0.5))):
        after = dataclasses.replace(before, position=pose[0], quaternion=unit(pose[1]))
        plan = planned(plan_edit, {FILE: source}, KEY, before, after, run_class)
        assert isinstance(plan, SourceEdit) and plan.settings is not None
        source, before = plan.new_text, plan.settings
    assert "q=[0.5, 0.5, 0.5, -0.5]" in source


def test_the_target_that_was_placed_is_the_one_that_is_written() -> None:
    source = WRITTEN["a list, positional to the end"]
    before = real_settings({FILE: source}, "cam")
    eye, point = before.position, (1.5, 0.25, 0.3)
    after = dataclasses.replace(before, quaternion=looking(eye, point), distance=math.dist(eye, point))
    plan = planned(plan_edit, {FILE: source}, KEY, before, after, run_class)
    assert isinstance(plan, SourceEdit)
    assert math.dist(_look_at_numbers(plan.new_text)[1], point) < 1e-3


def _look_at_numbers(source: str) -> tuple[tuple[float, ...], tuple[float, ...]]:
    found = re.search(r"look_at\((?:eye=)?\[(.*?)\], (?:target=)?\[(.*?)\]\)", source)
    assert found is not None, source
    eye, target = (tuple(float(number) for number in text.split(",")) for text in found.groups())
    return eye, target
