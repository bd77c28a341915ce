"""Rotations in plain numbers, and `look_at` as ManiSkill computes it, without importing either library.

The server process writes the file and must not import torch. What a written text evaluates to has to be known
to 1e-6, so `look_at` and the conversion behind it are repeated here in single precision, operation by operation
(mani_skill 3.0.1, ``mani_skill/utils/sapien_utils.py`` and ``utils/geometry/rotation_conversions.py``).

Quaternions are wxyz. Rotation matrices have the camera's forward, left and up as columns.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Quaternion = tuple[float, float, float, float]
Array = NDArray[np.floating]


def unit(quaternion: Sequence[float]) -> Quaternion:
    """Of length one. Raises ValueError for a quaternion without direction."""
    w, x, y, z = (float(part) for part in quaternion)
    length = math.sqrt(w * w + x * x + y * y + z * z)
    if not math.isfinite(length) or length < 1e-9:
        raise ValueError("a quaternion of length 0 is no orientation")
    return w / length, x / length, y / length, z / length


def matrix(quaternion: Sequence[float]) -> Array:
    """(3, 3), of a quaternion of any length but 0."""
    w, x, y, z = unit(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def angle_between(a: Sequence[float], b: Sequence[float]) -> float:
    """Radians of the rotation from one orientation to the other; q and -q are the same one."""
    w1, x1, y1, z1 = unit(a)
    w2, x2, y2, z2 = unit(b)
    # By the vector part of a * conj(b), which keeps its digits where the angle is small.
    x = -w1 * x2 + x1 * w2 - y1 * z2 + z1 * y2
    y = -w1 * y2 + y1 * w2 - z1 * x2 + x1 * z2
    z = -w1 * z2 + z1 * w2 - x1 * y2 + y1 * x2
    w = w1 * w2 + x1 * x2 + y1 * y2 + z1 * z2
    return 2 * math.atan2(math.sqrt(x * x + y * y + z * z), abs(w))


def look_at(eye: Sequence[float], target: Sequence[float], up: Sequence[float] = (0, 0, 1)) -> Quaternion:
    """The quaternion of ManiSkill's ``look_at``, which is not of unit length straight along `up`."""
    near, far = np.array(eye, np.float32), np.array(target, np.float32)
    forward = _normalized(far - near)
    upward = _normalized(np.array(up, np.float32))
    left = _normalized(np.cross(upward, forward).astype(np.float32))
    return from_matrix(np.stack([forward, left, np.cross(forward, left)], axis=-1))


def _normalized(vector: Array) -> Array:
    length = np.float32(np.linalg.norm(vector))
    return np.zeros(3, np.float32) if length < 1e-6 else (vector / length).astype(np.float32)


def from_matrix(rotation: Array) -> Quaternion:
    """As ``matrix_to_quaternion``, the same of two opposite ones, in the precision of `rotation`."""
    m = rotation
    one = m.dtype.type(1)
    squares = np.array(
        [
            one + m[0, 0] + m[1, 1] + m[2, 2],
            one + m[0, 0] - m[1, 1] - m[2, 2],
            one - m[0, 0] + m[1, 1] - m[2, 2],
            one - m[0, 0] - m[1, 1] + m[2, 2],
        ]
    )
    roots = np.sqrt(np.maximum(squares, 0))
    rows = (
        (roots[0] ** 2, m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]),
        (m[2, 1] - m[1, 2], roots[1] ** 2, m[1, 0] + m[0, 1], m[0, 2] + m[2, 0]),
        (m[0, 2] - m[2, 0], m[1, 0] + m[0, 1], roots[2] ** 2, m[1, 2] + m[2, 1]),
        (m[1, 0] - m[0, 1], m[2, 0] + m[0, 2], m[2, 1] + m[1, 2], roots[3] ** 2),
    )
    best = int(np.argmax(roots))
    w, x, y, z = (float(part / (2 * max(roots[best], m.dtype.type(0.1)))) for part in rows[best])
    return (-w, -x, -y, -z) if w < 0 else (w, x, y, z)


def from_euler(roll: float, pitch: float, yaw: float) -> Quaternion:
    """As ``transforms3d.euler.euler2quat`` with its default axes (sxyz): about fixed x, then y, then z."""
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a / 2), math.sin(a / 2)) for a in (roll, pitch, yaw))
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def to_euler(quaternion: Sequence[float], near: Sequence[float]) -> tuple[float, float, float]:
    """The angles of `from_euler`, of the ways to say them the one closest to `near`. Radians."""
    m = matrix(quaternion)
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
