"""Maps held keys to the action of a robot."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import zip_longest

import numpy as np

from workbench.task.description import ActionDimension

PAIRS = (
    ("w", "s"),
    ("a", "d"),
    ("e", "q"),
    ("r", "f"),
    ("arrowup", "arrowdown"),
    ("arrowleft", "arrowright"),
    ("t", "y"),
)
"""The keys of each pair raise and lower one number of the action. The pairs belong, in order, to the numbers
for which zero means no motion (`ActionDimension.zero_holds`): for an end effector x, y, z and rotations about
x, y, z."""
GRIPPER_KEY = "g"
KEYS = (*(key for pair in PAIRS for key in pair), GRIPPER_KEY)
SHARE = 0.5
"""Share of its bound that a number has while a key is held. At the bound itself, 0.1 m per step for
ManiSkill's Panda, an end effector moves too fast for a person to place it."""


@dataclass(frozen=True)
class KeyBinding:
    """The keys of one number of the action."""

    dimension: int
    name: str
    raises: str
    lowers: str
    low: float
    high: float


def bindings(dimensions: Sequence[ActionDimension]) -> tuple[KeyBinding, ...]:
    """The keys of each number for which zero means no motion. Empty for a mode of absolute targets."""
    relative = [(k, one) for k, one in enumerate(dimensions) if one.zero_holds]
    return tuple(
        KeyBinding(k, one.name, *keys, *_bounds(one)) for keys, (k, one) in zip(PAIRS, relative, strict=False)
    )


def gripper(dimensions: Sequence[ActionDimension]) -> tuple[tuple[int, float, float], ...]:
    """Index in the action, closed value and open value of each absolute target of a controller called
    ``gripper``."""
    return tuple(
        (k, *_bounds(one))
        for k, one in enumerate(dimensions)
        if not one.zero_holds and "gripper" in one.name.split("/")[:-1]
    )


def driven_action(
    dimensions: Sequence[ActionDimension], keys: Collection[str], yaw: float, sticks: Sequence[float] = ()
) -> tuple[tuple[int, ...], tuple[float, ...]]:
    """Indices of the numbers to set in the action, and their values, while these keys are held.

    Args:
        yaw: direction in which the person looks, in radians: counter-clockwise from the x axis, seen from
            above. ``w`` moves an end effector in this direction.
        sticks: deflections of a gamepad, -1 to 1, in the order of `PAIRS`; they add to those of the keys.
    """
    bound = bindings(dimensions)
    held = [SHARE * ((one.raises in keys) - (one.lowers in keys)) for one in bound]
    both = [key + stick for key, stick in zip_longest(held, sticks[: len(bound)], fillvalue=0.0)]
    amounts = np.clip(np.array(both, float), -1.0, 1.0)
    if is_end_effector(bound):
        ahead, left = amounts[:2]
        cos, sin = np.cos(yaw), np.sin(yaw)
        amounts[:2] = cos * ahead - sin * left, sin * ahead + cos * left
    values = [
        min(abs(amount), 1.0) * (one.high if amount > 0 else one.low)
        for amount, one in zip(amounts, bound, strict=True)
    ]
    return tuple(one.dimension for one in bound), tuple(map(float, values))


def is_end_effector(bound: Sequence[KeyBinding]) -> bool:
    """Whether the first two numbers move an end effector along x and y, so that the keys follow the view."""
    return [one.name.rpartition("/")[2] for one in bound[:2]] == ["x", "y"]


def _bounds(dimension: ActionDimension) -> tuple[float, float]:
    low, high = dimension.low, dimension.high
    return (low if np.isfinite(low) else -1.0), (high if np.isfinite(high) else 1.0)
