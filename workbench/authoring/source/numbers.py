"""Numbers as a person would write them: rounded to what matters, without digits that say nothing.

And rotations in numbers, without importing the simulator. Quaternions are wxyz. Rotation matrices have a camera's
forward, left and up as columns.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from transforms3d.quaternions import mat2quat

from workbench.core.cameras.conventions import normalised, rotation_matrix


def number_text(value: float, decimals: int, like: str = "0.0") -> str:
    """`value` rounded. Whole numbers are written as integers where `like`, what stood there, is one."""
    rounded = round(value, decimals)
    if rounded == int(rounded):
        whole = str(int(rounded))
        return whole if decimals == 0 or like.lstrip("+-").isdigit() else f"{whole}.0"
    return f"{rounded:.{decimals}f}".rstrip("0")


def list_text(values: Sequence[float], decimals: int) -> str:
    return "[" + ", ".join(number_text(value, decimals) for value in values) + "]"


def quaternion_texts(quaternion: Sequence[float]) -> list[str]:
    """Four numbers as short as they can be while they are of unit length and of the same direction to 1e-7.

    SAPIEN keeps a quaternion as it is given, and one that is not of unit length makes the camera's frame no
    rotation: so not 0.7071 but 0.7071068.
    """
    exact = same_side(quaternion, quaternion)
    for decimals in (1, 2, 3, 4, 5, 6):
        rounded = [round(part, decimals) for part in exact]
        if max(abs(a - b) for a, b in zip(rounded, exact, strict=True)) < 1e-7:
            return [number_text(part, decimals) for part in rounded]
    return [number_text(part, 7) for part in exact]


def matrix_text(rows: Sequence[Sequence[float]]) -> str:
    """Pixels to a thousandth."""
    return "[" + ", ".join(list_text(row, 3) for row in rows) + "]"


def same_side(quaternion: Sequence[float], old: Sequence[float]) -> list[float]:
    """Of the two quaternions of unit length of one orientation the one that resembles what stood there."""
    found = normalised(quaternion)
    return (found if found @ np.asarray(old) >= 0 else -found).tolist()


def look_at(
    eye: Sequence[float], target: Sequence[float], up: Sequence[float] = (0, 0, 1)
) -> NDArray[np.float64] | None:
    """The orientation of ManiSkill's ``look_at``; None straight along `up`, where that gives none."""
    # It takes floats of 32 bits: of an eye nearly above its target their rounding turns the picture.
    seen = np.asarray(target, np.float32).astype(float), np.asarray(eye, np.float32).astype(float)
    forward, upward = np.subtract(*seen), np.asarray(up, float)
    left = np.cross(upward, forward)
    if np.linalg.norm(left) <= 1e-6 * np.linalg.norm(forward) * np.linalg.norm(upward):
        return None
    columns = (forward, left, np.cross(forward, left))
    return mat2quat(np.stack([column / np.linalg.norm(column) for column in columns], axis=-1))


def to_euler(quaternion: ArrayLike, near: Sequence[float]) -> tuple[float, float, float]:
    """The angles of transforms3d's ``euler2quat``, of the ways to say them the one closest to `near`. Radians."""
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
