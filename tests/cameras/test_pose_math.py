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
    nudged,
    panned,
    picture_corners,
    snapped,
    turned_in_world,
    viewer_pose,
)
from workbench.envs.camera_data import CameraSettings
from workbench.pictures.camera_conventions import (
    LookAt,
    axes_of,
    compose,
    intrinsic_of,
    make_pose,
    opencv_extrinsic,
    pose_from_look_at,
    quaternion_from_rpy,
    rpy_of,
    target_of,
    with_pose,
)

SETTINGS = CameraSettings((0, 0, 0), (1, 0, 0, 0), 1.0, None, 64, 48, 0.01, 10.0, "minimal")
LOOKING_DOWN = pose_from_look_at(LookAt((0.45, 0.0, 0.6), (0.08, 0.0, 0.0)))
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


def test_snapping_in_world_axes_uses_the_envs_grid() -> None:
    start, origin = make_pose((1.233, 2.0, 0.557), UNTURNED), (0.5, 0.0, 0.0)
    moved = make_pose((1.301, 2.0, 0.557), UNTURNED)
    result = snapped(start, moved, Snap(metres=0.05), False, origin)
    np.testing.assert_allclose(result[:3], [1.3, 2.0, 0.557])


@given(st.floats(-179, 179))
def test_turning_snaps_to_whole_steps(degrees: float) -> None:
    start = make_pose((0, 0, 0), UNTURNED)
    turned = make_pose((0, 0, 0), quaternion_from_rpy(0, 0, degrees))
    yaw = rpy_of(snapped(start, turned, Snap(degrees=15), False, (0, 0, 0))[3:])[2]
    assert abs((yaw - degrees + 180) % 360 - 180) <= 7.5 + 1e-6
    assert yaw / 15 == pytest.approx(round(yaw / 15), abs=1e-6)


def test_a_turn_of_the_world_gizmo_turns_about_the_worlds_axis() -> None:
    turned = turned_in_world(LOOKING_DOWN, LOOKING_DOWN[:3], quaternion_from_rpy(0, 0, 90))
    forward = axes_of(LOOKING_DOWN[3:])[0]
    np.testing.assert_allclose(axes_of(turned[3:])[0], [-forward[1], forward[0], forward[2]], atol=1e-9)


def test_keys_move_along_the_view_and_turn_in_place() -> None:
    # The camera looks along -x, so its left is -y.
    np.testing.assert_allclose(nudged(LOOKING_DOWN, (0, 0.01, 0))[:3], [0.45, -0.01, 0.6], atol=1e-9)
    up = panned(LOOKING_DOWN, 0, 5)
    assert rpy_of(up[3:])[1] == pytest.approx(rpy_of(LOOKING_DOWN[3:])[1] - 5)
    left = panned(LOOKING_DOWN, 5, 0)
    assert axes_of(left[3:])[0][1] < 0
    np.testing.assert_allclose(left[:3], LOOKING_DOWN[:3])


def test_the_viewers_rotation_is_opencvs() -> None:
    # viser looks along its own z; unrotated that is the world's z, with x to the right.
    forward, left, up = axes_of(viewer_pose((1, 2, 3), UNTURNED)[3:])
    np.testing.assert_allclose([forward, left, up], [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], atol=1e-12)
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
