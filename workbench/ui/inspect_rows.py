"""The inspectors' cells: numbers as text, which of them changed, and where a joint stands between its limits.

Pure functions of an `Inspection` and of poses. A number counts as changed when it differs from the reading before
of the same env, however little: whether something moves at all is what one looks for.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from workbench.core.inspection import JointReadings, Leaf, Touching
from workbench.session.number_text import number_text
from workbench.ui.fragments import counted

NEAR_A_LIMIT = 0.02
"""Part of a joint's range."""

Row = dict[str, Any]
"""As the template ``inspect`` reads it."""


def leaf_rows(leaves: Sequence[Leaf], before: Sequence[Leaf] | None) -> list[Row]:
    """One row an array.

    Args:
        before: the reading before, of the same env; None marks nothing.
    """
    known = {leaf.name: leaf.values for leaf in before or ()}
    rows = []
    for leaf in leaves:
        old = known.get(leaf.name)
        if old is None or old.shape != leaf.values.shape:
            changed = np.zeros(leaf.values.shape, bool)
        else:
            # NaN differs from itself, and an entry that stays NaN has not changed.
            changed = (old != leaf.values) & ~((old != old) & (leaf.values != leaf.values))
        count = math.prod(leaf.shape)
        whole = len(leaf.values) == count
        rows.append(
            {
                "name": leaf.name,
                "kind": f"{leaf.dtype} {leaf.shape}" if leaf.shape else leaf.dtype,
                "numbers": tuple(
                    {"text": number(value), "changed": bool(new)}
                    for value, new in zip(leaf.values.tolist(), changed.tolist(), strict=True)
                )
                if whole
                else (),
                "note": "" if whole else f"{count} numbers from {number(leaf.low)} to {number(leaf.high)}",
            }
        )
    return rows


def joint_rows(joints: JointReadings) -> list[Row]:
    rows = []
    for i, name in enumerate(joints.names):
        low, high = float(joints.low[i]), float(joints.high[i])
        unit = "m" if joints.kinds[i] == "prismatic" else "rad"
        bounded = math.isfinite(low) and math.isfinite(high) and high > low
        place = _place(float(joints.position[i]), low, high) if bounded else None
        target = float(joints.target[i])
        rows.append(
            {
                "name": name,
                "position": number(float(joints.position[i])),
                "target": "" if math.isnan(target) else number(target),
                "velocity": number(float(joints.velocity[i])),
                "limits": f"{number(low)} to {number(high)} {unit}" if bounded else f"no limits, {unit}",
                "place": place,
                "target_place": None if place is None or math.isnan(target) else _place(target, low, high),
                "at_limit": place is not None and not 100 * NEAR_A_LIMIT < place < 100 * (1 - NEAR_A_LIMIT),
            }
        )
    return rows


def contact_rows(contacts: Sequence[Touching]) -> list[Row]:
    return [
        {
            "first": pair.bodies[0],
            "second": pair.bodies[1],
            "force": f"{number_text(float(np.linalg.norm(pair.force)), '.3g')} N",
            "vector": vector(pair.force),
            "impulse": f"{number_text(float(np.linalg.norm(pair.impulse)), '.3g')} N s",
            "point": vector(pair.points.mean(axis=0)) if len(pair.points) else "",
            "note": _depth(pair),
        }
        for pair in contacts
    ]


def pose_rows(names: Sequence[str], poses: NDArray[np.float32]) -> list[Row]:
    """Of the bodies that an env has; `poses` is (B, 7), p and q (wxyz), NaN where it has none."""
    rows = []
    for name, pose in zip(names, poses, strict=True):
        if np.isfinite(pose).all():
            p, q = pose[:3], pose[3:]
            code = f"sapien.Pose(p={_code(p)}, q={_code(q)})"
            rows.append({"name": name, "p": vector(p), "q": vector(q), "copy": code})
    return rows


def number(value: object) -> str:
    """Short, with a width that does not jump about while it changes."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return str(value)
    if not isinstance(value, float):
        return str(value)
    if not math.isfinite(value):
        return number_text(value)
    if value and not 1e-3 <= abs(value) < 1e4:
        return "0.000" if abs(value) < 1e-6 else f"{value:.1e}"
    return f"{value:.3f}"


def vector(values: NDArray) -> str:
    return ", ".join(number(float(value)) for value in values)


def _place(value: float, low: float, high: float) -> float:
    return round(100 * min(max((value - low) / (high - low), 0.0), 1.0), 1)


def _depth(pair: Touching) -> str:
    points = counted(len(pair.points), "point")
    return f"{points}, {1000 * -pair.separation:.2f} mm deep" if pair.separation < 0 else points


def _code(values: NDArray[np.float32]) -> str:
    # Six decimals: a micrometre, and what float32 has.
    return "[" + ", ".join(f"{float(value):.6f}".rstrip("0").rstrip(".") or "0" for value in values) + "]"
