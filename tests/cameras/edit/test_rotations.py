"""Rotations in plain Python agree with transforms3d and ManiSkill."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from mani_skill.utils import sapien_utils
from transforms3d.euler import euler2quat
from transforms3d.quaternions import quat2mat

from workbench.cameras.edit.pose_text import look_at, to_euler
from workbench.pictures.camera_conventions import angle_between
from workbench.source.traced_edits import quaternion_texts

turns = st.floats(-2 * math.pi, 2 * math.pi)
parts = st.floats(-1, 1)
quaternions = st.tuples(parts, parts, parts, parts).filter(lambda q: math.hypot(*q) > 0.1)


@settings(max_examples=60)
@given(quaternions, quaternions)
def test_the_angle_between_two_orientations_is_the_relative_rotations(
    a: tuple[float, ...], b: tuple[float, ...]
) -> None:
    cosine = (np.trace(quat2mat(a).T @ quat2mat(b)) - 1) / 2
    assert math.cos(angle_between(a, b)) == pytest.approx(cosine, abs=1e-9)
    assert angle_between(a, [-part for part in a]) < 1e-7


@settings(max_examples=100)
@given(turns, turns, turns, st.tuples(turns, turns, turns))
def test_euler_angles_of_a_quaternion_are_the_nearest_to_the_old_ones(
    roll: float, pitch: float, yaw: float, near: tuple[float, float, float]
) -> None:
    quaternion = euler2quat(roll, pitch, yaw)
    found = to_euler(quaternion, near)
    assert angle_between(euler2quat(*found), quaternion) < 1e-5
    # The result must be at least as close to the old angles as the original triple.
    apart = sum(abs(a - b) for a, b in zip(found, near, strict=True))
    given_apart = sum(abs(a - b) for a, b in zip((roll, pitch, yaw), near, strict=True))
    level = abs(math.cos(pitch)) > 1e-3
    assert not level or apart <= given_apart + 1e-6


@settings(max_examples=100)
@given(turns, st.sampled_from((-1, 1)), turns, turns)
def test_straight_up_or_down_the_yaw_stays_and_the_roll_takes_the_turn(
    roll: float, side: int, yaw: float, old_yaw: float
) -> None:
    quaternion = euler2quat(roll, side * math.pi / 2, yaw)
    found = to_euler(quaternion, (0.25, side * math.pi / 2, old_yaw))
    assert angle_between(euler2quat(*found), quaternion) < 1e-6
    assert found[1] == pytest.approx(side * math.pi / 2) and found[2] == pytest.approx(old_yaw)
    assert abs(found[0] - 0.25) <= math.pi + 1e-6


points = st.tuples(*[st.floats(-4, 4)] * 3)


@settings(max_examples=60)
@given(points, points, st.sampled_from(((0, 0, 1), (0, 0, -2), (0, 1, 0), (0.5, 0.5, 0.5))))
def test_look_at_equals_maniskills(
    eye: tuple[float, ...], target: tuple[float, ...], up: tuple[float, ...]
) -> None:
    ahead = np.subtract(target, eye)
    # Almost parallel to `up` the result is rounding noise, and so are the signs where the quaternion's w is zero.
    assume(np.linalg.norm(np.cross(ahead, up)) > 1e-2 * np.linalg.norm(ahead) > 1e-5)
    wanted = sapien_utils.look_at(eye, target, up).raw_pose[0, 3:].tolist()
    found = look_at(eye, target, up)
    assert found is not None and angle_between(found, wanted) < 1e-4


def test_quaternions_are_normalized_and_zero_ones_refused() -> None:
    assert quaternion_texts((0, 0, 3, 4)) == ["0.0", "0.0", "0.6", "0.8"]
    assert quaternion_texts((-0.6, 0, 0, 0.8)) == ["-0.6", "0.0", "0.0", "0.8"], "the sign must stay"
    assert quaternion_texts((0.5 + 7e-8, 0.5 - 7e-8, 0.5, 0.5)) == ["0.5"] * 4, "shortest text within 1e-7"
    assert quaternion_texts((0.5 + 2e-7, 0.5 - 2e-7, 0.5, 0.5))[0] == "0.5000002"
    for wrong in ((0, 0, 0, 0), (math.nan, 0, 0, 1), (math.inf, 0, 0, 1)):
        with pytest.raises(ValueError, match="not a rotation|not finite"):
            quaternion_texts(wrong)
