"""Units and limits of a robot's joints, and a robot's state as source text."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from workbench.envs.robots import Joint

Floats = NDArray[np.floating[Any]]
FREE_DEGREES, FREE_METRES = 180.0, 2.0
"""A joint without limits has a slider from minus this value to plus this value."""


def display_value(joint: Joint, position: float) -> float:
    """A position in the unit of the page: degrees or metres, rounded."""
    return round(position, 4) if joint.prismatic else round(math.degrees(position), 2)


def position_of(joint: Joint, value: float) -> float:
    """Position in radians or metres for a value in the page's unit, clipped to the joint's limits."""
    return min(max(value if joint.prismatic else math.radians(value), joint.low), joint.high)


def slider_bounds(joint: Joint, position: float) -> tuple[float, float]:
    """Ends of the joint's slider in the page's unit: the joint's limits or, without limits, a range
    that contains the position."""
    free, value = FREE_METRES if joint.prismatic else FREE_DEGREES, display_value(joint, position)
    low = display_value(joint, joint.low) if math.isfinite(joint.low) else min(-free, value)
    high = display_value(joint, joint.high) if math.isfinite(joint.high) else max(free, value)
    return low, max(high, low)


def limits_text(joint: Joint) -> str:
    """The joint's limits with their unit."""
    low, high = (display_value(joint, end) for end in (joint.low, joint.high))
    unit = " m" if joint.prismatic else "°"
    if math.isinf(low) and math.isinf(high):
        return f"no limits, {unit.strip()}"
    return f"{low:.3g} to {high:.3g}{unit}"


def qpos_code(qpos: Sequence[float] | Floats) -> str:
    """The joint positions as an assignment."""
    return f"qpos = {_array_code(qpos)}"


def keyframe_code(qpos: Sequence[float] | Floats, root: Sequence[float] | Floats) -> str:
    """An entry of an agent's ``keyframes``.

    Args:
        root: (7,) position and quaternion wxyz of the robot's root.
    """
    # Six decimals: a micrometre.
    p, q = (
        f"[{', '.join(_number(round(float(value), 6)) for value in part)}]" for part in (root[:3], root[3:])
    )
    return f'"new": Keyframe(\n    qpos={_array_code(qpos)},\n    pose=sapien.Pose(p={p}, q={q}),\n),'


def _array_code(values: Sequence[float] | Floats) -> str:
    return f"np.array([{', '.join(map(_number, values))}])"


def _number(value: float) -> str:
    """The shortest text that reads back as this float32."""
    return np.format_float_positional(np.float32(value) + np.float32(0), unique=True, trim="0")
