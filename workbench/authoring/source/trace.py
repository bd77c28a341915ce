"""Source positions of the values of a call that ran, as plain data from a worker."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

DEGREE = math.pi / 180


@dataclass(frozen=True)
class Place:
    """An expression in a file: offsets of its first character and of its end, without parentheses around it."""

    file: str
    start: int
    end: int


@dataclass(frozen=True)
class Read:
    """A name (``EYE``, ``self.eye``, ``EYES[0]``) that was followed to the assignment of its value."""

    at: Place
    others: str | None
    """Text: the place of another reader of that value; None if there is no other."""


if TYPE_CHECKING:
    Plain = float | str | None | tuple["Plain", ...]
else:  # the decoder of messages has no recursive types: numbers, vectors, matrices and lists of these
    _One = float | str | None
    Plain = _One | tuple[_One | tuple[_One | tuple[_One | tuple[_One, ...], ...], ...], ...]


@dataclass(frozen=True, eq=False)
class Part:
    """An expression that is not a name, its value in the run, and its parts that may be edited."""

    at: Place
    reads: tuple[Read, ...]
    """The names that lead to it, the call's own first."""
    value: Plain
    """A pose is seven numbers: p, then q as wxyz."""
    function: str = ""
    """Name (`KnownFunction.name`) of the called function; empty for other expressions."""
    parts: Mapping[str, Part] = field(default_factory=dict)
    """Elements of a list by index; arguments of a call by parameter; ``of``: the number within an expression that may be
    edited instead of it."""
    slope: float = 1.0
    offset: float = 0.0
    """value = slope * `parts["of"].value` + offset"""
    literal: bool = False
    """Written as a plain number, perhaps with a sign, or as a list of its items."""

    @property
    def numbers(self) -> tuple[float, ...]:
        """All numbers of the value, in order."""
        return tuple(_numbers(self.value))

    def walk(self) -> Iterator[Part]:
        """This part and all parts within it."""
        yield self
        for part in self.parts.values():
            yield from part.walk()


@dataclass(frozen=True, eq=False)
class Trace:
    """A call, with its arguments by parameter."""

    at: Place
    function: str
    """Qualified name of the function that contains it."""
    parts: Mapping[str, Part]
    """Arguments that could be followed."""
    unknown: Mapping[str, str]
    """Reasons for the other arguments."""


def _numbers(value: Plain) -> Iterator[float]:
    if isinstance(value, tuple):
        for item in value:
            yield from _numbers(item)
    elif isinstance(value, float):
        yield value
