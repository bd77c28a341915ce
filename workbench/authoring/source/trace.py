"""Where the values of a call that ran stand in the source, as plain data: what a worker tells of its author's files."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

DEGREE = math.pi / 180


@dataclass(frozen=True)
class Place:
    """An expression in a text: its first character and the one behind its last, without parentheses around it."""

    file: str
    start: int
    end: int


@dataclass(frozen=True)
class Read:
    """A name (``EYE``, ``self.eye``, ``EYES[0]``) that was followed to where it gets its value."""

    at: Place
    others: str | None
    """Who else reads it there, in words; None if nobody does."""


if TYPE_CHECKING:
    Plain = float | str | None | tuple["Plain", ...]
else:  # what reads it off a line knows no type that names itself: numbers, vectors, matrices and lists of these
    _One = float | str | None
    Plain = _One | tuple[_One | tuple[_One | tuple[_One | tuple[_One, ...], ...], ...], ...]


@dataclass(frozen=True, eq=False)
class Part:
    """An expression that is no name, what it was worth, and what may be changed within it."""

    at: Place
    reads: tuple[Read, ...]
    """The names that were read to come to it, the call's own first."""
    value: Plain
    """A pose is its seven numbers: p, then q as wxyz."""
    function: str = ""
    """Of a call: what it calls, by the name that `Library` has for it."""
    parts: Mapping[str, Part] = field(default_factory=dict)
    """The elements of what is written as a list, by index; the arguments of a call, by parameter; ``of`` is the number
    within an expression that may be changed in its place."""
    slope: float = 1.0
    offset: float = 0.0
    """value = slope * ``of`` + offset"""
    literal: bool = False
    """Written as nothing but a number, perhaps with a sign, or as a list of its items."""

    @property
    def numbers(self) -> tuple[float, ...]:
        """All of them, in order."""
        return tuple(_numbers(self.value))

    def walk(self) -> Iterator[Part]:
        """It and all within it."""
        yield self
        for part in self.parts.values():
            yield from part.walk()


@dataclass(frozen=True, eq=False)
class Trace:
    """A call, with its arguments by parameter."""

    at: Place
    function: str
    """Qualified name of the code that it is in."""
    parts: Mapping[str, Part]
    """Those that can be followed."""
    unknown: Mapping[str, str]
    """Why the others cannot."""


def _numbers(value: Plain) -> Iterator[float]:
    if isinstance(value, tuple):
        for item in value:
            yield from _numbers(item)
    elif isinstance(value, float):
        yield value
