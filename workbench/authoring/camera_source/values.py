"""What an expression in the source is worth, with the place in the text that says so.

To change a number one must know where it stands, and who else reads it there. So a value is kept with the
expression that gave it and with the names that were read on the way from the camera's config to it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import libcst as cst

from workbench.authoring.camera_source.source_file import SourceFile


@dataclass(frozen=True, eq=False)
class Read:
    """A name (``EYE``, ``self.eye``, ``EYES[0]``) that was followed to where it is defined."""

    file: SourceFile
    node: cst.BaseExpression
    others: str | None
    """Who else reads the same definition, in words; None if nobody does."""


@dataclass(frozen=True, eq=False)
class Place:
    """An expression that is no name, and the names that were read to come to it, the camera's own first."""

    file: SourceFile
    node: cst.BaseExpression
    reads: tuple[Read, ...]


@dataclass(frozen=True, eq=False)
class Number:
    value: float
    at: Place
    literal: bool
    """Written as nothing but a number, perhaps with a sign."""
    part: tuple[Number, float, float] | None = None
    """A number within the expression that may be changed in its place: value = part * slope + offset."""


@dataclass(frozen=True, eq=False)
class Text:
    value: str
    at: Place


@dataclass(frozen=True, eq=False)
class Nothing:
    at: Place


@dataclass(frozen=True, eq=False)
class Vector:
    items: tuple[Number | Vector, ...]
    at: Place
    array: bool
    """An array, which can be calculated with, and not a list."""
    literal: bool
    """Written as a list of its items, so that one of them can be changed."""

    @property
    def numbers(self) -> tuple[float, ...]:
        found: list[float] = []
        for item in self.items:
            found += item.numbers if isinstance(item, Vector) else [item.value]
        return tuple(found)


PoseForm = Literal["look_at", "pose", "euler"]


@dataclass(frozen=True, eq=False)
class PoseValue:
    """A call that makes a pose, and its arguments by name."""

    form: PoseForm
    """``pose`` is anything of a position and a quaternion; ``euler`` the same with ``q=euler2quat(...)``."""
    at: Place
    parts: dict[str, Vector | Angles]
    """``eye target up`` or ``p q``, as far as they are given."""
    position: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]
    """As upstream computes it: not always of unit length."""


@dataclass(frozen=True, eq=False)
class Angles:
    """``euler2quat(roll, pitch, yaw)``."""

    at: Place
    items: tuple[Number, Number, Number]


Value = Number | Text | Nothing | Vector | PoseValue | Angles


def parts_of(value: Value) -> Iterator[Value]:
    """What may be changed within `value`."""
    if isinstance(value, (Vector, Angles)):
        yield from value.items
    elif isinstance(value, PoseValue):
        yield from value.parts.values()
    elif isinstance(value, Number) and value.part is not None:
        yield value.part[0]
