"""Conversions between pose and lens conventions agree with ManiSkill's and SAPIEN's matrices and are invertible."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import sapien
import sapien.render
import transforms3d
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils
from numpy.testing import assert_allclose

from tests.drive.render_device import RENDER_BACKEND
from tests.envs.stock_env import Bare, batch_of
from workbench.pictures import camera_conventions as frames
from workbench.pictures.camera_conventions import LookAt

fewer = settings(max_examples=50)
numbers = st.floats(-10, 10, allow_subnormal=False)
positions = st.tuples(numbers, numbers, numbers)
quaternions = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: float(np.linalg.norm(q)) > 1e-3)
poses = st.builds(frames.make_pose, positions, quaternions)
sizes = st.integers(1, 4096)
fovs = st.floats(0.02, 3.0)
DOWN, UP = (0.0, 0.0, -1.0), (0.0, 0.0, 1.0)


def assert_same_pose(a: Any, b: Any, atol: float = 1e-9) -> None:
    assert_allclose(a[:3], b[:3], atol=atol)
    # q and -q are the same rotation, and rounding may decide the sign.
    assert abs(float(np.dot(a[3:], b[3:]))) == pytest.approx(1, abs=atol)


class Posed(Bare):
    """Cameras at four poses, one with unequal focal lengths and an off-centre principal point."""

    EYES = ((0.3, 0.0, 0.6), (1.0, -2.0, 0.1), (-0.5, 0.5, 3.0), (0.2, 0.1, 0.05))
    TARGET = (-0.1, 0.0, 0.1)
    K = np.array([[70.0, 0, 30], [0, 90, 26], [0, 0, 1]])

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        lens: list[dict[str, Any]] = [{"fov": 0.7}, {"fov": 1.5}, {"fov": 2.4}, {"intrinsic": self.K}]
        return [
            CameraConfig(
                f"c{i}", sapien_utils.look_at(eye, self.TARGET), 64, 48, near=0.01, far=10, **lens[i]
            )
            for i, eye in enumerate(self.EYES)
        ]


def test_matrices_equal_those_of_maniskills_cameras(renderer: None) -> None:
    env: Any = batch_of(Posed, 2, obs_mode="rgb", render_backend=RENDER_BACKEND)
    for i, eye in enumerate(Posed.EYES):
        camera = env._sensors[f"c{i}"]
        theirs = {key: value[0].numpy() for key, value in camera.get_params().items()}
        pose = frames.pose_from_look_at(LookAt(eye, Posed.TARGET))
        config = camera.config.pose.raw_pose[0].numpy()
        assert_same_pose(pose, config, atol=1e-6)
        assert_allclose(frames.opencv_extrinsic(pose), theirs["extrinsic_cv"], atol=2e-6)
        assert_allclose(frames.opengl_model_matrix(pose), theirs["cam2world_gl"], atol=2e-6)
        intrinsic = Posed.K if i == 3 else frames.intrinsic_from_fov(camera.config.fov, 64, 48)
        assert_allclose(intrinsic, theirs["intrinsic_cv"], rtol=1e-6, atol=1e-5)
        component = camera.camera._render_cameras[0]
        if i < 3:
            assert frames.vertical_fov(intrinsic, 48) == pytest.approx(component.fovy, abs=1e-6)
            assert frames.horizontal_fov(intrinsic, 64) == pytest.approx(component.fovx, abs=1e-6)
        # SAPIEN computes its matrices independently of ManiSkill.
        assert_allclose(frames.opencv_extrinsic(pose), component.get_extrinsic_matrix(), atol=2e-6)
    env.close()


@fewer
@given(positions, positions)
def test_look_at_equals_maniskills_where_that_is_correct(eye: Any, target: Any) -> None:
    away = np.subtract(target, eye)
    # Near the vertical or with a target close to the eye, upstream's float32 result loses all precision.
    assume(np.linalg.norm(away) > 0.1 and math.hypot(*away[:2]) > 0.02 * np.linalg.norm(away))
    theirs = sapien_utils.look_at(eye, target).raw_pose[0].numpy()
    assert_same_pose(frames.pose_from_look_at(LookAt(eye, target)), theirs, atol=2e-4)


@pytest.mark.parametrize(("forward", "top"), [(DOWN, (1, 0, 0)), (UP, (-1, 0, 0))])
def test_straight_down_and_up_are_correct_where_upstream_is_not(forward: Any, top: Any) -> None:
    eye = (0.2, -0.1, 0.5)
    target = tuple(np.add(eye, forward))
    upstream = sapien_utils.look_at(eye, target).raw_pose[0, 3:].numpy()
    assert np.linalg.norm(upstream) < 0.9, "upstream fixed it, so the page's warning can go"
    pose = frames.pose_from_look_at(LookAt(eye, target))
    assert np.linalg.norm(pose[3:]) == pytest.approx(1)
    ahead, left, up = frames.axes_of(pose[3:])
    assert_allclose([ahead, left, up], [forward, (0, 1, 0), top], atol=1e-12)
    # The limit of an upright camera as it tilts to vertical, so there is no jump.
    nearly = frames.pose_from_look_at(LookAt(eye, tuple(np.add(target, (0.001, 0, 0)))))
    assert_same_pose(pose, nearly, atol=2e-3)


@fewer
@given(poses, st.floats(0.05, 20))
def test_look_at_survives_a_round_trip(pose: Any, distance: float) -> None:
    looking = frames.look_at_of(pose, distance)
    assert np.linalg.norm(np.subtract(looking.target, looking.eye)) == pytest.approx(distance)
    assert_same_pose(frames.pose_from_look_at(looking), pose, atol=1e-8)


def test_a_positive_roll_turns_the_camera_clockwise_seen_from_behind() -> None:
    level, rolled = (frames.pose_from_look_at(LookAt((0, 0, 1), (1, 0, 1), roll)) for roll in (0.0, 0.3))
    assert_allclose(frames.axes_of(level[3:])[1], (0, 1, 0), atol=1e-12)
    assert frames.axes_of(rolled[3:])[1][2] > 0.2, "the camera's left side must rise"
    assert frames.rpy_of(rolled[3:])[0] == pytest.approx(math.degrees(0.3))


@fewer
@given(quaternions)
def test_quaternion_matrix_axes_and_rpy_describe_the_same_rotation(quaternion: Any) -> None:
    q = frames.normalised(quaternion)
    r = frames.rotation_matrix(q)
    assert_allclose(r, transforms3d.quaternions.quat2mat(q), atol=1e-9)
    assert_allclose(r @ r.T, np.eye(3), atol=1e-12)
    assert abs(frames.quaternion_of(r) @ q) == pytest.approx(1)
    forward, left, up = frames.axes_of(q)
    assert_allclose(np.cross(forward, left), up, atol=1e-9)
    assert abs(frames.quaternion_from_axes(forward, up) @ q) == pytest.approx(1)
    rpy = frames.rpy_of(q)
    assert_allclose(frames.rotation_matrix(frames.quaternion_from_rpy(*rpy)), r, atol=3e-6)


@pytest.mark.parametrize("pitch", [90.0, -90.0])
@fewer
@given(yaw=st.floats(-179, 179))
def test_straight_down_or_up_the_whole_rotation_is_yaw(pitch: float, yaw: float) -> None:
    q = frames.quaternion_from_rpy(0, pitch, yaw)
    assert_allclose(frames.rpy_of(q), (0, pitch, yaw), atol=1e-3)


@fewer
@given(st.floats(-180, 180), st.floats(-90, 90), st.floats(-180, 180))
def test_rpy_follows_urdf_and_ros(roll: float, pitch: float, yaw: float) -> None:
    theirs = transforms3d.euler.euler2mat(*np.radians([roll, pitch, yaw]), axes="sxyz")
    assert_allclose(frames.rotation_matrix(frames.quaternion_from_rpy(roll, pitch, yaw)), theirs, atol=1e-9)


@pytest.mark.thorough
@fewer
@given(poses)
@pytest.mark.parametrize("convention", ["maniskill", "opencv", "opengl"])
@pytest.mark.parametrize("direction", ["camera_to_world", "world_to_camera"])
def test_matrices_survive_a_round_trip(convention: Any, direction: Any, pose: Any) -> None:
    matrix = frames.matrix_of(pose, convention, direction)
    assert_same_pose(frames.pose_from_matrix(matrix, convention, direction), pose, atol=1e-8)
    assert_same_pose(frames.pose_from_matrix(matrix[:3], convention, direction), pose, atol=1e-8)
    other: Any = "world_to_camera" if direction == "camera_to_world" else "camera_to_world"
    assert_allclose(matrix @ frames.matrix_of(pose, convention, other), np.eye(4), atol=1e-8)


@fewer
@given(poses, poses)
def test_a_mounts_frame_equals_sapiens_and_survives_a_round_trip(mount: Any, local: Any) -> None:
    world = frames.compose(mount, local)
    theirs = sapien.Pose(mount[:3], mount[3:]) * sapien.Pose(local[:3], local[3:])
    assert_same_pose(world, np.concatenate([theirs.p, theirs.q]), atol=1e-4)
    assert_same_pose(frames.relative_to(mount, world), local, atol=1e-8)
    assert_same_pose(frames.compose(mount, frames.inverse(mount)), (0, 0, 0, 1, 0, 0, 0), atol=1e-8)


@fewer
@given(fovs, sizes, sizes)
def test_fov_and_intrinsic_describe_the_same_lens(fov: float, width: int, height: int) -> None:
    k = frames.intrinsic_from_fov(fov, width, height)
    assert frames.vertical_fov(k, height) == pytest.approx(fov)
    larger = frames.scaled_intrinsic(k, (width, height), (2 * width, 3 * height))
    assert frames.vertical_fov(larger, 3 * height) == pytest.approx(fov)
    assert frames.horizontal_fov(larger, 2 * width) == pytest.approx(frames.horizontal_fov(k, width))
    assert frames.matrix3(k) == tuple(map(tuple, k.tolist()))


EYE = np.eye(4)
LENS = np.array([[100.0, 0, 64], [0, 90, 48], [0, 0, 1]])


def changed(matrix: np.ndarray, **numbers: float) -> np.ndarray:
    """The matrix with these numbers, by row and column: ``r03=1.0``."""
    matrix = matrix.copy()
    for place, number in numbers.items():
        matrix[int(place[1]), int(place[2])] = number
    return matrix


@pytest.mark.parametrize(
    ("matrix", "says"),
    [
        (np.eye(3), "3 x 3"),
        (changed(EYE, r03=math.nan), "finite"),
        (changed(EYE, r30=0.5, r33=1.0), "last row"),
        (changed(EYE, r30=0.5).T * 1.0, None),
        (changed(EYE, r03=0.5).T, "transposed"),
        (changed(EYE, r22=-1.0), "mirror"),
        (changed(EYE, r22=0.0), "determinant is 0"),
        (changed(EYE, r00=2.0, r11=2.0, r22=2.0), "scales by 2"),
        (changed(EYE, r01=0.3), "right angles"),
        (changed(EYE, r00=1.0005), None),
        (changed(EYE, r00=1.01), "right angles"),
    ],
)
def test_a_matrix_that_is_no_pose_is_refused_with_what_is_wrong(matrix: np.ndarray, says: str | None) -> None:
    if says is None:
        frames.pose_from_matrix(matrix, "maniskill", "camera_to_world")
    else:
        with pytest.raises(ValueError, match=says):
            frames.pose_from_matrix(matrix, "maniskill", "camera_to_world")


@pytest.mark.parametrize(
    ("matrix", "valid"),
    [
        (LENS, True),
        (LENS[:2], False),
        (changed(LENS, r02=math.inf), False),
        (changed(LENS, r20=0.1), False),
        (changed(LENS, r10=0.1), False),
        (changed(LENS, r00=0.0), False),
        (changed(LENS, r11=-1.0), False),
        (changed(LENS, r01=0.5), False),
        (changed(LENS, r01=1e-6), True),
    ],
)
def test_a_lens_that_cannot_be_rendered_is_refused(matrix: np.ndarray, valid: bool) -> None:
    if valid:
        assert_allclose(frames.checked_intrinsic(matrix), matrix)
    else:
        with pytest.raises(ValueError):
            frames.checked_intrinsic(matrix)


def test_fields_of_view_and_sizes_have_limits_and_a_target_is_ahead() -> None:
    for fov, width, height in ((0.0, 4, 3), (math.pi, 4, 3), (1.0, 0, 3), (1.0, 4, 0)):
        with pytest.raises(ValueError):
            frames.intrinsic_from_fov(fov, width, height)
    for distance in (0.0, -1.0, math.nan):
        with pytest.raises(ValueError):
            frames.look_at_of(frames.make_pose((0, 0, 1), (1, 0, 0, 0)), distance)
    for vector in ((1.0, 2.0), (1.0, 2.0, math.nan)):
        with pytest.raises(ValueError):
            frames.make_pose(vector, (1, 0, 0, 0))
