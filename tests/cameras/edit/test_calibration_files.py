"""Calibration files for other programs: OpenCV reads ours, and we read ours and theirs."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from workbench.cameras.calibration_files import (
    FORMAT,
    CameraToExport,
    camera_as_ros_yaml,
    camera_pose,
    cameras_as_json,
    cameras_as_opencv_yaml,
    find_poses,
)
from workbench.envs.camera_data import CameraSettings
from workbench.pictures import camera_conventions as frames
from workbench.pictures.camera_conventions import LookAt

POSE = frames.pose_from_look_at(LookAt((0.5, -0.4, 0.7), (0.0, 0.1, 0.05), 0.2))
PLAIN = CameraSettings((0, 0, 0), (1, 0, 0, 0), 0.9, None, 320, 240, 0.01, 10.0, "minimal")
FIXED = CameraToExport(("sensor", "base: camera/1"), frames.with_pose(PLAIN, POSE))
MOUNTED = CameraToExport(
    ("sensor", "base: camera 1"),
    CameraSettings(
        (0.1, 0, 0), (1, 0, 0, 0), None, ((200, 0, 150), (0, 210, 110), (0, 0, 1)), 320, 240, 0.01, 5, "rt"
    ),
    mount="panda/panda_hand",
    mount_pose=POSE,
)
CONVENTIONS: Any = ["maniskill", "opencv", "opengl"]
DIRECTIONS: Any = ["camera_to_world", "world_to_camera"]


def assert_same_pose(a: Any, b: Any, atol: float = 1e-9) -> None:
    assert_allclose(a[:3], b[:3], atol=atol)
    assert abs(float(np.dot(a[3:], b[3:]))) == pytest.approx(1, abs=1e-7)


def test_json_survives_a_round_trip_and_explains_keys_that_it_has() -> None:
    text = cameras_as_json([FIXED, MOUNTED])
    exported = json.loads(text)
    assert set(exported["conventions"]) <= {"length", "fov"} | set(exported["cameras"][0])
    assert len(text.splitlines()) < 80, "a matrix row must be one line"
    for found, camera in zip(find_poses(text), (FIXED, MOUNTED), strict=True):
        assert_same_pose(camera_pose(found), camera.pose_in_env)


def test_every_number_of_the_json_is_that_of_its_camera() -> None:
    for camera in (FIXED, MOUNTED):
        (found,) = json.loads(cameras_as_json([camera]))["cameras"]
        s, pose, k = camera.settings, camera.pose_in_env, frames.intrinsic_of(camera.settings)
        assert (found["kind"], found["name"], found["width"], found["height"]) == (
            *camera.key,
            s.width,
            s.height,
        )
        assert (found["near"], found["far"], found["shader_pack"]) == (s.near, s.far, s.shader_pack)
        assert_allclose(found["fov_vertical"], 2 * math.atan(s.height / 2 / k[1, 1]))
        assert_allclose(found["fov_horizontal"], 2 * math.atan(s.width / 2 / k[0, 0]))
        assert_allclose(found["intrinsic"], k)
        assert_allclose([*found["position"], *found["quaternion"]], pose)
        assert_allclose(found["extrinsic_opencv"], frames.opencv_extrinsic(pose))
        assert_allclose(found["model_matrix_opengl"], frames.opengl_model_matrix(pose))
        mounted = camera.mount is not None
        assert found["mount"] == camera.mount
        assert (found["position_in_mount"] == [*s.position]) is mounted
        assert (found["quaternion_in_mount"] == [*s.quaternion]) is mounted
    with pytest.raises(ValueError, match="panda/panda_hand"):
        cameras_as_json([replace(MOUNTED, mount_pose=None)])


def test_rosyaml_has_the_lens_and_the_pose_of_the_optical_frame() -> None:
    for camera in (FIXED, MOUNTED):
        text = camera_as_ros_yaml(camera)
        found, k = yaml.safe_load(text), frames.intrinsic_of(camera.settings)
        assert (found["image_width"], found["image_height"]) == (320, 240)
        assert found["camera_name"] == camera.key[1] and found["distortion_model"] == "plumb_bob"
        for name, matrix in (
            ("camera_matrix", k),
            ("distortion_coefficients", np.zeros((1, 5))),
            ("rectification_matrix", np.eye(3)),
            ("projection_matrix", np.hstack([k, np.zeros((3, 1))])),
        ):
            given = found[name]
            assert_allclose(np.reshape(given["data"], (given["rows"], given["cols"])), matrix)
        numbers = {name: float(number) for name, number in re.findall(r"--(q?[wxyz]) (\S+)", text)}
        optical = [numbers[name] for name in ("x", "y", "z", "qw", "qx", "qy", "qz")]
        # The optical frame's axes are right, down and forward.
        forward, left, up = frames.axes_of(camera.pose_in_env[3:])
        assert_allclose(frames.axes_of(optical[3:]), [-left, -up, forward], atol=1e-9)
        assert_allclose(optical[:3], camera.pose_in_env[:3])


def test_opencv_reads_its_yaml(tmp_path: Path) -> None:
    path = tmp_path / "cameras.yaml"
    path.write_text(cameras_as_opencv_yaml([FIXED, MOUNTED]))
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    for key, camera in [("sensor_base__camera_1", FIXED), ("sensor_base__camera_1_", MOUNTED)]:
        node = storage.getNode(key)
        assert int(node.getNode("image_width").real()) == 320
        assert_allclose(node.getNode("camera_matrix").mat(), frames.intrinsic_of(camera.settings), rtol=1e-12)
        assert_allclose(
            node.getNode("extrinsic").mat(), frames.opencv_extrinsic(camera.pose_in_env), rtol=1e-12
        )
        assert node.getNode("distortion_coefficients").mat().shape == (1, 5)
        assert_allclose(
            node.getNode("camera_to_world").mat() @ [*node.getNode("extrinsic").mat(), [0, 0, 0, 1]],
            np.eye(4),
            atol=1e-12,
        )
    storage.release()
    found = {pose.label: pose for pose in find_poses(path.read_text())}
    assert_same_pose(
        camera_pose(found["sensor_base__camera_1 / extrinsic"], "opencv", "world_to_camera"), POSE
    )


@pytest.mark.parametrize("suffix", ["yaml", "json"])
def test_files_written_by_opencv_are_read(tmp_path: Path, suffix: str) -> None:
    extrinsic = frames.matrix_of(POSE, "opencv", "world_to_camera")
    rvec, _ = cv2.Rodrigues(extrinsic[:3, :3])
    path = tmp_path / f"calibration.{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("camera_matrix", np.eye(3))
    storage.write("rvec", rvec)
    storage.write("tvec", extrinsic[:3, 3:] * 1000)
    storage.write("T_cam_base", np.linalg.inv(extrinsic))
    storage.write("small", extrinsic[:3].astype(np.float32))
    storage.release()
    found = {pose.label: pose for pose in find_poses(path.read_text())}
    assert set(found) == {"rotation and translation", "T_cam_base", "small"}
    pair = camera_pose(found["rotation and translation"], "opencv", "world_to_camera", metres_per_unit=0.001)
    assert_same_pose(pair, POSE, atol=1e-7)
    assert_same_pose(camera_pose(found["T_cam_base"], "opencv", "camera_to_world"), POSE, atol=1e-7)
    assert_same_pose(camera_pose(found["small"], "opencv", "world_to_camera"), POSE, atol=1e-5)


@pytest.mark.parametrize("convention", CONVENTIONS)
@pytest.mark.parametrize("direction", DIRECTIONS)
@pytest.mark.parametrize(
    "write", [str, repr, lambda m: json.dumps(m.tolist()), lambda m: repr(m[:3].tolist())]
)
def test_a_pasted_matrix_is_read_in_the_chosen_convention(
    convention: Any, direction: Any, write: Any
) -> None:
    matrix = frames.matrix_of(POSE, convention, direction)
    (found,) = find_poses(write(matrix))
    assert found.stated is None
    assert_same_pose(camera_pose(found, convention, direction), POSE, atol=1e-6)
    with pytest.raises(ValueError, match="choose the direction"):
        camera_pose(found, convention)


@pytest.mark.parametrize(
    "text",
    [
        "1 0 0 0\n0 1 0 0\n0 0 1 2\n0 0 0 1",
        "1, 0, 0, 0; 0, 1, 0, 0; 0, 0, 1, 2e0",
        "np.array([[1.,0,0,0],[0,1,0,0],[0,0,1,2],[0,0,0,1]], dtype=np.float32)",
        "tensor([[1.,0,0,0],[0,1,0,0],[0,0,1,2],[0,0,0,1]])",
        '{"calib": [{"R": [[1,0,0],[0,1,0],[0,0,1]], "t": [0, 0, 2]}]}',
        "rotation_matrix: [1, 0, 0, 0, 1, 0, 0, 0, 1]\ntranslation: [0, 0, 2]",
        "rvec: [0, 0, 0]\ntvec: [[0], [0], [2]]",
        '{"T": [1,0,0,0, 0,1,0,0, 0,0,1,2]}',
        '{"T": [1,0,0,0, 0,1,0,0, 0,0,1,2, 0,0,0,1], "P": [[1,0,0,9],[0,1,0,9],[0,0,1,9]]}',
        '{"names": ["a", "b", "c"], "on": [true, false], "T": [["1",0,0,0],[0,1,0,0],[0,0,1,2]]}',
        "%YAML:1.0\nT: !!opencv-matrix\n   rows: 3\n   cols: 4\n   dt: d\n   data: [1.,0,0,0, 0,1.,0,0, 0,1e-12,1.,2.]",
    ],
)
def test_many_formats_of_one_pose_are_read(text: str) -> None:
    (found,) = find_poses(text)
    assert_same_pose(camera_pose(found, "maniskill", "camera_to_world"), (0, 0, 2, 1, 0, 0, 0))


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "nothing to read"),
        ('{"a": ', "begins like JSON"),
        ("!!python/object/apply:os.system ['true']", "neither YAML"),
        ('{"camera_matrix": [[1,0,0],[0,1,0],[0,0,1]]}', "the text has no pose"),
        ("a: " + "[" * 5000, "neither YAML"),
        ("a: &a [*a]", "alias"),
        ("9" * 300_000, "characters"),
        ("# " + "x" * 25_000 + "\na: 1", "too many for YAML"),
        ("a: !!opencv-matrix [1, 2]", "rows, cols"),
        ("1 2 3", "has 3"),
        ("hello", "neither JSON"),
        ("rvec: [1, 2]\ntvec: [0, 0, 2]", "no pose"),
        (
            json.dumps({"format": FORMAT, "cameras": [7, {"position": [1, 2]}, {"position": [1, 2, 3]}]}),
            "no pose",
        ),
    ],
)
def test_a_text_without_a_pose_is_refused_with_a_reason(text: str, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        find_poses(text)


def test_a_matrix_that_is_no_rotation_is_refused_with_a_reason() -> None:
    (mirrored,) = find_poses("1 0 0 0  0 1 0 0  0 0 -1 0  0 0 0 1")
    with pytest.raises(ValueError, match="mirror image"):
        camera_pose(mirrored, "opencv", "world_to_camera")
    with pytest.raises(ValueError, match="positive number of metres"):
        camera_pose(mirrored, "opencv", "world_to_camera", metres_per_unit=0)


@given(st.text(max_size=300) | st.text('0123456789.,:-[]{}!%&*\n eE"RtvecTrows', max_size=300))
def test_any_text_gives_poses_or_a_value_error(text: str) -> None:
    try:
        for found in find_poses(text):
            assert found.matrix.shape == (4, 4)
    except ValueError as error:
        assert str(error)
