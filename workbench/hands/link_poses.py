"""Forward kinematics: the poses of a robot's links for given joint positions."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from viser.transforms import SE3

from workbench.envs.robots import RobotDescription

Floats = NDArray[np.floating[Any]]


def link_poses(robot: RobotDescription, poses: Floats, qpos: Floats) -> NDArray[np.float32]:
    """Poses of all bodies of n envs with the robot's links where these joint positions put them.

    Args:
        poses: (n, B, 7) present position and quaternion wxyz; the robot's root keeps its pose.
        qpos: (n, len(robot.joints)) in radians or metres.
    """
    moved = np.array(poses, np.float32)
    placed: list[SE3] = []
    for link in robot.links:
        if link.parent < 0:
            placed.append(_transform(poses[:, link.body]))
            continue
        own = np.zeros((len(poses), 6))
        if link.joint >= 0:
            own[:, 0 if robot.joints[link.joint].prismatic else 3] = qpos[:, link.joint]
        in_parent, in_link = (_transform(np.array([pose])) for pose in (link.in_parent, link.in_link))
        placed.append(placed[link.parent] @ in_parent @ SE3.exp(own) @ in_link.inverse())
        moved[:, link.body] = placed[-1].wxyz_xyz[:, [4, 5, 6, 0, 1, 2, 3]]
    return moved


def _transform(pose: Floats) -> SE3:
    """Args: pose: (n, 7)"""
    return SE3(np.asarray(pose, np.float64)[:, [3, 4, 5, 6, 0, 1, 2]])
