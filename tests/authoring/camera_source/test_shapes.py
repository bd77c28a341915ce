"""Cameras written in many ways, edited in many ways: right by ManiSkill's own account, or refused with a reason."""

from __future__ import annotations

import ast
import dataclasses
import math
from collections.abc import Callable

import pytest

from tests.authoring.camera_source.real_cameras import (
    FILE,
    close,
    comments,
    key_of,
    looking,
    planned,
    real_configs,
    real_settings,
    run_class,
    settings_of,
    unit,
)
from tests.authoring.camera_source.shapes import REFUSED, WRITTEN
from workbench.authoring.camera_source.disk import SourceEdit
from workbench.authoring.camera_source.plan import plan_edit
from workbench.authoring.source.text import RefusedEdit
from workbench.core.camera_data import CameraSettings
from workbench.core.cameras.conventions import angle_between

Edit = Callable[[CameraSettings], CameraSettings]


def moved(now: CameraSettings) -> CameraSettings:
    x, y, z = now.position
    return dataclasses.replace(now, position=(x + 0.0512, y, z + 0.1))


def level(now: CameraSettings) -> CameraSettings:
    eye = (now.position[0] + 0.1, now.position[1] - 0.2034, now.position[2] + 0.3)
    return dataclasses.replace(now, position=eye, quaternion=looking(eye, (0.05, 0.1, 0.02)))


def down(now: CameraSettings) -> CameraSettings:
    return dataclasses.replace(now, position=(0.1, 0.0, 1.1), quaternion=unit((0.5, 0.5, 0.5, -0.5)))


def lens(now: CameraSettings) -> CameraSettings:
    if now.fov is None:
        assert now.intrinsic is not None
        return dataclasses.replace(now, intrinsic=((430.25, 0, 301), *now.intrinsic[1:]))
    return dataclasses.replace(now, fov=now.fov * 0.81, width=320, near=0.02)


EDITS: list[Edit] = [moved, level, down, lens]


@pytest.mark.parametrize("name", WRITTEN)
@pytest.mark.parametrize("edit", EDITS)
def test_what_is_written_is_what_maniskill_then_makes(name: str, edit: Edit) -> None:
    source = WRITTEN[name]
    before = real_settings({FILE: source}, "cam")
    after = edit(before)
    plan = planned(plan_edit, {FILE: source}, key_of(source), before, after, run_class)
    if name == "more arguments by **" and edit is lens:
        assert isinstance(plan, RefusedEdit) and "`near` is given by * or **" in plan.reason
        return
    assert isinstance(plan, SourceEdit), plan
    assert plan.settings is not None
    real = real_configs({FILE: plan.new_text})
    for (_, uid), was in real_configs({FILE: source}).items():
        settings = settings_of(next(config for (_, other), config in real.items() if other == uid))
        assert close(settings, plan.settings if uid == "cam" else settings_of(was)), plan.diff
    assert near_enough(plan.settings, after), plan.diff
    assert comments(plan.new_text) == comments(source)
    assert untouched(source, plan.new_text) >= 0.8


def near_enough(written: CameraSettings, wanted: CameraSettings) -> bool:
    """0.1 mm and 0.01 degree."""
    return (
        max(abs(a - b) for a, b in zip(written.position, wanted.position, strict=True)) <= 1e-4
        and angle_between(written.quaternion, wanted.quaternion) <= math.radians(0.01)
        and (wanted.fov is None or abs((written.fov or 0) - wanted.fov) <= math.radians(0.01))
        and (written.width, written.height) == (wanted.width, wanted.height)
        and abs(written.near - wanted.near) <= 1e-4
    )


def untouched(old: str, new: str) -> float:
    """The share of the old lines that are in the new text."""
    lines = old.splitlines()
    return sum(line in new.splitlines() for line in lines) / len(lines)


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_edited_safely_is_refused_with_reason_and_snippet(name: str) -> None:
    source, reason = REFUSED[name]
    before = real_settings({FILE: source}, "cam")
    after = level(before)
    plan = planned(plan_edit, {FILE: source}, key_of(source), before, after, run_class)
    assert isinstance(plan, RefusedEdit), plan.diff
    assert reason in plan.reason
    assert ast.parse(plan.snippet)
    # What it gives to copy is the camera that was asked for.
    task = f"{source}\n\nclass Copied(Base):\n    _sensor_configs = [{plan.snippet}]\n"
    assert near_enough(real_settings({FILE: task}, "cam", class_name="Copied"), after)


@pytest.mark.parametrize(
    ("name", "edit", "text"),
    [
        ("an argument a line, with remarks", lens, "fov=48.6 * np.pi / 180,"),
        ("euler angles in degrees", lens, "np.radians(48.6)"),
        ("arithmetic with a height", moved, "eye = [0.3512, 0, TABLE + 0.7]"),
    ],
)
def test_the_number_that_a_person_would_change_is_changed_and_the_rest_is_followed_on(
    name: str, edit: Edit, text: str
) -> None:
    source = WRITTEN[name]
    before = real_settings({FILE: source}, "cam")
    plan = planned(plan_edit, {FILE: source}, key_of(source), before, edit(before), run_class)
    assert isinstance(plan, SourceEdit) and text in plan.new_text
