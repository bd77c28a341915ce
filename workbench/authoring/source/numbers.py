"""Numbers as a person would write them: rounded to what matters, without digits that say nothing."""

from __future__ import annotations

from collections.abc import Sequence

from workbench.authoring.source import rotations


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
    exact = rotations.unit(quaternion)
    for decimals in (1, 2, 3, 4, 5, 6):
        rounded = [round(part, decimals) for part in exact]
        if max(abs(a - b) for a, b in zip(rounded, exact, strict=True)) < 1e-7:
            return [number_text(part, decimals) for part in rounded]
    return [number_text(part, 7) for part in exact]


def matrix_text(rows: Sequence[Sequence[float]]) -> str:
    """Pixels to a thousandth."""
    return "[" + ", ".join(list_text(row, 3) for row in rows) + "]"
