"""Maps a gamepad in the browser's standard layout to what the driving keys do."""

from __future__ import annotations

from collections.abc import Sequence

DEAD_ZONE = 0.12
"""Deflection of a stick or trigger below which it counts as released."""
LABELS = (
    "left stick ↑↓",
    "left stick ←→",
    "RT, LT; right stick ↑↓",
    "RB, LB",
    "D-pad ↑↓",
    "right stick ←→",
    "D-pad ←→",
)
"""The controls that raise and lower the numbers of the action, in the order of `drive_keys.PAIRS`."""
GRIPPER_LABEL = "A"
B, X, Y = (1, "B"), (2, "X"), (3, "Y")
"""Index and label of the buttons that end the episode (`drive_panel.SET`)."""
_LEFT_X, _LEFT_Y, _RIGHT_X, _RIGHT_Y = range(4)
"""Indices of the axes; right and down are positive."""
_A, _LB, _RB, _LT, _RT, _UP, _DOWN, _LEFT, _RIGHT = 0, 4, 5, 6, 7, 12, 13, 14, 15
"""Indices of the buttons."""


def pad_amounts(axes: Sequence[float], buttons: Sequence[float]) -> tuple[float, ...]:
    """How far each of `LABELS` is deflected, from -1 to 1.

    Args:
        axes: deflections of the sticks, -1 to 1; fewer than four for a gamepad with fewer axes.
        buttons: deflections of the buttons, 0 to 1; fewer than 17 for a gamepad with fewer buttons.
    """

    def axis(which: int) -> float:
        return _live(axes[which]) if which < len(axes) else 0.0

    def pair(raises: int, lowers: int) -> float:
        return _button(buttons, raises) - _button(buttons, lowers)

    amounts = (
        -axis(_LEFT_Y),
        -axis(_LEFT_X),
        pair(_RT, _LT) - axis(_RIGHT_Y),
        pair(_RB, _LB),
        pair(_UP, _DOWN),
        -axis(_RIGHT_X),
        pair(_LEFT, _RIGHT),
    )
    return tuple(min(1.0, max(-1.0, amount)) for amount in amounts)


def pad_grips(buttons: Sequence[float]) -> bool:
    """Whether the button of the gripper is held."""
    return _button(buttons, _A) > 0.5


def _button(buttons: Sequence[float], which: int) -> float:
    return _live(buttons[which]) if which < len(buttons) else 0.0


def _live(deflection: float) -> float:
    """The deflection beyond the dead zone, scaled to -1 to 1."""
    beyond = max(0.0, abs(deflection) - DEAD_ZONE) / (1 - DEAD_ZONE)
    return beyond if deflection > 0 else -beyond
