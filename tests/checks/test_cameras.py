"""Rules for sensor cameras, each with a task that breaks it and one that keeps it."""

from __future__ import annotations

import pytest

from tests.checks.checked import Checked, the_finding

pytestmark = pytest.mark.thorough

EYE = "pose = sapien_utils.look_at(eye=[0.45, 0, 0.6], target=[0.08, 0, 0])"
HUMAN_EYE = "pose = sapien_utils.look_at(eye=[0.7, 0.7, 0.6], target=[0.0, 0.0, 0.2])"
CAMERA = '[CameraConfig("base_camera", pose=pose, width=128, height=128, fov=1.0, near=0.01, far=10)]'


@pytest.mark.slow
def test_a_camera_that_looks_past_the_objects(checked: Checked, renderer: None) -> None:
    away = "pose = sapien_utils.look_at(eye=[0.45, 0, 0.6], target=[1.5, 0, 0])"
    result = checked("camera-sees", (EYE, away))
    assert [finding.message.partition(" ")[0] for finding in result.findings] == ["cube", "goal"]
    assert "8 of 8 pictures" in result.findings[0].message
    assert result.findings[0].code.startswith("return [CameraConfig")


@pytest.mark.slow
def test_an_object_must_be_in_one_camera_and_a_fixed_camera_must_see_an_object(
    checked: Checked, renderer: None
) -> None:
    above = CAMERA.replace("[", '[CameraConfig("above", pose=pose, width=64, height=64, fov=0.6), ', 1)
    assert checked("camera-sees", (CAMERA, above)).state == "kept"
    away = "sapien_utils.look_at(eye=[0.45, 0, 0.6], target=[1.5, 0, 0])"
    two = CAMERA.replace("[", f'[CameraConfig("away", pose={away}, width=64, height=64, fov=1.0), ', 1)
    assert (
        "'away' has none of the task's objects" in the_finding(checked("camera-sees", (CAMERA, two))).message
    )


def test_each_reset_of_the_check_has_other_seeds(checked: Checked, renderer: None) -> None:
    """The cube is in view at the first two seeds alone."""
    far = "cube[:, 2] = CUBE_HALF_SIZE\n            cube[:, 0] += 3.0 * (self._episode_seed[env_idx.cpu()].max() > 1)"
    result = checked("camera-sees", ("cube[:, 2] = CUBE_HALF_SIZE", far))
    assert "6 of 8 pictures" in result.findings[0].message


def test_a_camera_that_looks_at_the_sky(checked: Checked, renderer: None) -> None:
    up = "pose = sapien_utils.look_at(eye=[0.45, 0, 0.6], target=[0.08, 0, 1.5])"
    finding = the_finding(checked("camera-background", (EYE, up)))
    assert "'base_camera'" in finding.message and finding.function == "_default_sensor_configs"


def test_a_camera_that_looks_straight_down(checked: Checked) -> None:
    down = "pose = sapien_utils.look_at(eye=[0.1, 0, 0.6], target=[0.1, 0, 0])"
    finding = the_finding(checked("camera-pose", (EYE, down)))
    assert "length 0.707" in finding.message and finding.code.startswith("return [CameraConfig")
    finding = the_finding(checked("camera-pose", (HUMAN_EYE, down)))
    assert finding.function == "_default_human_render_camera_configs"


def test_two_cameras_with_one_name(checked: Checked) -> None:
    second = CAMERA.replace("[", '[CameraConfig("hand_camera", pose=pose, width=64, height=64, fov=1.0), ', 1)
    supported = 'SUPPORTED_ROBOTS = ["panda", "fetch"]', 'SUPPORTED_ROBOTS = ["panda", "panda_wristcam"]'
    finding = the_finding(checked("camera-names", (CAMERA, second), supported, robot_uids="panda_wristcam"))
    assert "'hand_camera'" in finding.message
    assert checked("camera-names", supported, robot_uids="panda_wristcam").state == "kept"
