"""The first pose of an added sensor: in the view's direction, close enough to see the task's objects."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from tests.drive.scenes import running
from workbench.cameras.edit_panel import NEW, first_place, objects_in
from workbench.pictures.camera_conventions import LookAt, axes_of, pose_from_look_at, with_pose
from workbench.pictures.camera_report import ObjectToSee

metres = st.floats(-0.5, 0.5)
places = st.lists(st.tuples(metres, metres, metres), min_size=1, max_size=9).map(np.array)
sides = st.tuples(metres, metres, st.floats(0.2, 1.0)).map(lambda v: np.array(v) / np.linalg.norm(v))


@given(places, sides)
def test_from_a_distant_view_the_sensor_moves_closer_and_sees_most_objects(things, side) -> None:
    middle = np.median(things, axis=0)
    (ex, ey, ez), (x, y, z) = (middle + 30 * side).tolist(), middle.tolist()
    seen_from = with_pose(NEW, pose_from_look_at(LookAt((ex, ey, ez), (x, y, z))))
    found, words = first_place(seen_from, ("cube",), things)
    assert found.quaternion == seen_from.quaternion and "at cube from where you look" in words
    towards = middle - found.position
    forward = axes_of(found.quaternion)[0]
    assert 0.55 < np.linalg.norm(towards) < 5 and np.allclose(np.cross(forward, towards), 0, atol=1e-3)
    # 90 % of the objects lie within its view cone.
    away = things - found.position
    angles = np.arccos(np.clip(away @ forward / np.linalg.norm(away, axis=1), -1, 1))
    assert np.quantile(angles, 0.9, method="lower") < 0.5 * 1.0  # half of its field of view


def test_a_close_view_is_used_unchanged() -> None:
    near = with_pose(NEW, pose_from_look_at(LookAt((0.5, 0.1, 0.4), (0.2, 0.3, 0.0))))
    assert first_place(near, ("cube",), np.array([[0.0, 0.0, 0.02]]))[0] == near
    far = replace(near, position=(50.0, 0.0, 9.0))
    assert first_place(far, (), np.zeros((0, 3)))[0] == far, "without objects the view is used unchanged"


def test_robots_and_hidden_objects_are_not_objects_to_see() -> None:
    view = running(2)
    assert view.task is not None and view.step is not None
    objects = (
        ObjectToSee("cube", False),
        ObjectToSee("table", True),
        ObjectToSee("arm", False, ("arm/hand",), robot=True),
    )
    poses = view.step.poses.copy()
    poses[1, 3] = math.nan  # the second env has no cube
    view = replace(view, task=replace(view.task, objects=objects), step=replace(view.step, poses=poses))
    names, where = objects_in(view)
    assert names == ("cube",) and np.allclose(where, [[0.0, 0.0, 0.02]])
