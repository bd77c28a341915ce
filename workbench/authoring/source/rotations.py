"""Rotations in plain numbers, without importing the simulator.

Quaternions are wxyz. Rotation matrices have a camera's forward, left and up as columns.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from transforms3d.euler import euler2quat
from transforms3d.quaternions import mat2quat

from workbench.core.camera_frames import rotation_matrix

Quaternion = tuple[float, float, float, float]


def unit(quaternion: Sequence[float]) -> Quaternion:
    """Of length one. Raises ValueError for a quaternion without direction."""
    length = math.hypot(*quaternion)
    if not math.isfinite(length) or length < 1e-9:
        raise ValueError("a quaternion of length 0 is no orientation")
    w, x, y, z = (float(part) / length for part in quaternion)
    return w, x, y, z


def look_at(
    eye: Sequence[float], target: Sequence[float], up: Sequence[float] = (0, 0, 1)
) -> Quaternion | None:
    """The orientation of ManiSkill's ``look_at``; None straight along `up`, where that gives none."""
    # It takes floats of 32 bits: of an eye nearly above its target their rounding turns the picture.
    seen = np.asarray(target, np.float32).astype(float), np.asarray(eye, np.float32).astype(float)
    forward, upward = np.subtract(*seen), np.asarray(up, float)
    left = np.cross(upward, forward)
    if np.linalg.norm(left) <= 1e-6 * np.linalg.norm(forward) * np.linalg.norm(upward):
        return None
    columns = (forward, left, np.cross(forward, left))
    return unit(mat2quat(np.stack([column / np.linalg.norm(column) for column in columns], axis=-1)).tolist())


def from_euler(roll: float, pitch: float, yaw: float) -> Quaternion:
    """About fixed x, then y, then z."""
    return unit(euler2quat(roll, pitch, yaw).tolist())


def to_euler(quaternion: Sequence[float], near: Sequence[float]) -> tuple[float, float, float]:
    """The angles of `from_euler`, of the ways to say them the one closest to `near`. Radians."""
    m = rotation_matrix(quaternion)
    level = math.hypot(m[0, 0], m[1, 0])
    if level > 1e-6:
        roll, pitch = math.atan2(m[2, 1], m[2, 2]), math.atan2(-m[2, 0], level)
        yaw = math.atan2(m[1, 0], m[0, 0])
        ways = [(roll, pitch, yaw), (roll + math.pi, math.pi - pitch, yaw + math.pi)]
    else:
        # Looking along z only the sum or the difference of roll and yaw counts: yaw stays what it was.
        pitch = math.copysign(math.pi / 2, -m[2, 0])
        whole = math.atan2(m[0, 1], m[1, 1]) if pitch > 0 else math.atan2(-m[0, 1], m[1, 1])
        ways = [(whole + near[2] if pitch > 0 else whole - near[2], pitch, near[2])]
    turned = [
        tuple(a - 2 * math.pi * round((a - b) / (2 * math.pi)) for a, b in zip(way, near, strict=True))
        for way in ways
    ]
    best = min(turned, key=lambda way: sum(abs(a - b) for a, b in zip(way, near, strict=True)))
    return best[0], best[1], best[2]
