"""Widths of the columns of the table of envs, and the columns that are left out where its panel is narrow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

CHARACTER, PADDING, NARROW_PADDING = 6.2, 14.6, 9.2
"""Widths in pixels: of an average character, and of the padding between two columns."""
DOT = 13.0
"""Width in pixels of the dot before the name of a state."""
MARGINS = 36.0
"""Width in pixels of the margins next to the table in its panel, and of the arrow in the heading that it is sorted
by."""


@dataclass(frozen=True)
class EnvColumn:
    """A column of the table.

    Args:
        name: In its heading, which breaks behind each underscore.
        text: Characters of its longest cell.
        word: Characters of them that are left out first: a dot says the same.
        fixed: Further pixels of a cell.
        rank: Place among the columns that are left out, 0 first; None stays.
    """

    name: str
    text: int
    word: int = 0
    fixed: float = 0.0
    rank: int | None = None

    @property
    def wide(self) -> float:
        """Width in pixels with the heading in one line."""
        return PADDING + max(CHARACTER * len(self.name), self._cell(self.text))

    def least(self, words: bool) -> float:
        """Minimum width in pixels, without padding."""
        part = max(map(len, self.name.replace("_", "_ ").split()))
        return max(CHARACTER * part, self._cell(self.text if words else self.text - self.word))

    def _cell(self, characters: int) -> float:
        return CHARACTER * characters + self.fixed


@dataclass(frozen=True)
class LeftOut:
    """Content that is left out where the panel is not wider than `below` pixels: that of this level and of the
    levels before."""

    below: int
    columns: tuple[int, ...] = ()
    """Numbers of the columns, from 1, that are left out here."""
    names: tuple[str, ...] = ()
    """Names of everything that is left out."""


def wanted_width(columns: Sequence[EnvColumn]) -> float:
    """Width in pixels of a panel that shows everything."""
    return MARGINS + sum(column.wide for column in columns)


def levels(columns: Sequence[EnvColumn]) -> list[LeftOut]:
    """The words go first, then half of the padding, then the columns by rank."""
    with_words = MARGINS + sum(column.least(words=True) + PADDING for column in columns)
    without = MARGINS + sum(column.least(words=False) + PADDING for column in columns)
    room = without - (PADDING - NARROW_PADDING) * len(columns)
    found = [LeftOut(round(with_words)), LeftOut(round(without))]
    names: tuple[str, ...] = ()
    for number, column in sorted(
        ((number, column) for number, column in enumerate(columns, 1) if column.rank is not None),
        key=lambda one: one[1].rank or 0,
    ):
        names = (*names, column.name)
        found.append(LeftOut(round(room), (number,), names))
        room -= column.least(words=False) + NARROW_PADDING
    return found
