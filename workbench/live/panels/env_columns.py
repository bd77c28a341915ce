"""Widths of the columns of the table of envs, and which columns are left out if its panel is narrow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

CHARACTER_PIXELS, PADDING_PIXELS, NARROW_PADDING_PIXELS = 6.7, 15.7, 9.9
"""Widths of an average character, of the padding between two columns, and of this padding in a narrow
panel."""
DOT_PIXELS = 14.0
"""Width of the dot before the name of a state."""
MARGIN_PIXELS = 36.0
"""Width of the margins of the table in its panel plus the sort arrow in a heading."""


@dataclass(frozen=True)
class EnvColumn:
    """A column of the table.

    Args:
        name: Its heading, which may break after each underscore.
        text: Length of its longest cell in characters.
        word: Length of the word in this cell. The word is left out first: the dot before it means the same.
        fixed: Width of what a cell contains besides text, in pixels.
        rank: Order in which columns are left out, 0 first; None: never.
    """

    name: str
    text: int
    word: int = 0
    fixed: float = 0.0
    rank: int | None = None

    @property
    def wide(self) -> float:
        """Width in pixels with the heading in one line."""
        return PADDING_PIXELS + max(CHARACTER_PIXELS * len(self.name), self._cell(self.text))

    def least(self, words: bool) -> float:
        """Minimum width in pixels, without padding."""
        part = max(map(len, self.name.replace("_", "_ ").split()))
        return max(CHARACTER_PIXELS * part, self._cell(self.text if words else self.text - self.word))

    def _cell(self, characters: int) -> float:
        return CHARACTER_PIXELS * characters + self.fixed


@dataclass(frozen=True)
class LeftOut:
    """Content that is left out if the panel is at most `below` pixels wide, in addition to what the previous
    levels leave out."""

    below: int
    columns: tuple[int, ...] = ()
    """Numbers of the columns, from 1, that this level leaves out."""
    names: tuple[str, ...] = ()
    """Names of all columns that this level and the previous ones leave out."""


def wanted_width(columns: Sequence[EnvColumn]) -> float:
    """Width in pixels of a panel that shows everything."""
    return MARGIN_PIXELS + sum(column.wide for column in columns)


def levels(columns: Sequence[EnvColumn]) -> list[LeftOut]:
    """The levels: first the words are left out, then part of the padding, then the columns by rank."""
    with_words = MARGIN_PIXELS + sum(column.least(words=True) + PADDING_PIXELS for column in columns)
    without = MARGIN_PIXELS + sum(column.least(words=False) + PADDING_PIXELS for column in columns)
    room = without - (PADDING_PIXELS - NARROW_PADDING_PIXELS) * len(columns)
    found = [LeftOut(round(with_words)), LeftOut(round(without))]
    names: tuple[str, ...] = ()
    for number, column in sorted(
        ((number, column) for number, column in enumerate(columns, 1) if column.rank is not None),
        key=lambda one: one[1].rank or 0,
    ):
        names = (*names, column.name)
        found.append(LeftOut(round(room), (number,), names))
        room -= column.least(words=False) + NARROW_PADDING_PIXELS
    return found
