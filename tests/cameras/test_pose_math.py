"""Camera poses under a user's gestures: conversion between view and config, snapping, rotation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from workbench.cameras.pose_math import (
    Frame,
    Snap,
    looking_at,
    picture_corners,
    snapped,
    viewer_pose,
)
from workbench.envs.camera_data import CameraSettings
from workbench.pictures.camera_conventions import (
    axes_of,
    compose,
    intrinsic_of,
    make_pose,
    opencv_extrinsic,
    quaternion_from_rpy,
    rpy_of,
    target_of,
    with_pose,
)

SETTINGS = CameraSettings((0, 0, 0), (1, 0, 0, 0), 1.0, None, 64, 48, 0.01, 10.0, "minimal")
UNTURNED = (1.0, 0.0, 0.0, 0.0)
metres = st.floats(-3, 3)
points = st.tuples(metres, metres, metres)
angles = st.tuples(st.floats(-180, 180), st.floats(-89, 89), st.floats(-180, 180))
poses = st.builds(lambda p, a: make_pose(p, quaternion_from_rpy(*a)), points, angles)


@given(poses, poses, points, st.booleans())
def test_view_and_config_poses_survive_a_round_trip(pose, mount, offset, mounted: bool) -> None:
    camera = with_pose(SETTINGS, pose)
    frame = Frame(mount.astype(np.float32) if mounted else None, np.array(offset, np.float32))
    # A camera that was not moved keeps its exact numbers.
    assert frame.from_view(camera, frame.to_view(camera)) == camera
    expected = compose(frame.mount, pose) if frame.mount is not None else pose
    np.testing.assert_allclose(frame.to_view(camera)[:3], expected[:3] + frame.offset, atol=1e-9)
    np.testing.assert_allclose(frame.point_to_view(pose[:3]), frame.to_view(camera)[:3], atol=1e-9)


@given(poses, points)
def test_looking_at_a_target_keeps_the_eye_and_the_roll(pose, target) -> None:
    if np.linalg.norm(np.subtract(target, pose[:3])[:2]) < 0.05:
        return  # straight up or down, roll is defined differently
    roll = rpy_of(pose[3:])[0]
    result = looking_at(pose, pose[:3], target)
    np.testing.assert_allclose(result[:3], pose[:3])
    aimed = np.subtract(target, pose[:3]) / np.linalg.norm(np.subtract(target, pose[:3]))
    np.testing.assert_allclose(axes_of(result[3:])[0], aimed, atol=1e-9)
    assert (rpy_of(result[3:])[0] - roll + 180) % 360 - 180 == pytest.approx(0, abs=1e-5)


@given(poses, poses, points, st.booleans())
def test_turning_a_camera_to_a_point_keeps_its_position(pose, mount, target, mounted: bool) -> None:
    if np.linalg.norm(np.subtract(target, pose[:3])) < 0.05:
        return
    camera = with_pose(SETTINGS, pose)
    frame = Frame(mount if mounted else None, np.array([1.0, 2.0, 0.0], np.float32))
    turned = frame.turned_to(camera, np.array(target))
    assert turned.position == camera.position
    np.testing.assert_allclose(target_of(turned), target, atol=1e-6)


@given(st.floats(-179, 179))
def test_turning_snaps_to_whole_steps(degrees: float) -> None:
    start = make_pose((0, 0, 0), UNTURNED)
    turned = make_pose((0, 0, 0), quaternion_from_rpy(0, 0, degrees))
    yaw = rpy_of(snapped(start, turned, Snap(degrees=15), False, (0, 0, 0))[3:])[2]
    assert abs((yaw - degrees + 180) % 360 - 180) <= 7.5 + 1e-6
    assert yaw / 15 == pytest.approx(round(yaw / 15), abs=1e-6)


def test_a_viewpoint_without_a_rotation_is_refused() -> None:
    with pytest.raises(ValueError, match="zeros"):
        viewer_pose((0, 0, 0), (0, 0, 0, 0))


@given(poses, st.floats(0.1, 2.5))
def test_projected_picture_corners_are_the_pixel_corners(pose, fov: float) -> None:
    camera = replace(SETTINGS, fov=fov)
    extrinsic = opencv_extrinsic(pose)
    in_camera = picture_corners(camera, pose, 0.2) @ extrinsic[:, :3].T + extrinsic[:, 3]
    pixels = in_camera @ intrinsic_of(camera).T / in_camera[:, 2:]
    np.testing.assert_allclose(pixels[:, :2], [[0, 0], [64, 0], [64, 48], [0, 48]], atol=1e-6)
    np.testing.assert_allclose(in_camera[:, 2], 0.2)
