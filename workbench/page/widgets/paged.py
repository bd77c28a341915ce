"""Pagination of long lists."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from workbench.page.command import Command


@dataclass(frozen=True)
class Paged:
    """A page of a list with `most` rows per page. It is clamped to the list's length, which may change."""

    most: int
    first: int = 0
    """Index of the page's first row."""

    def at(self, place: int) -> Paged:
        """The page that contains this row."""
        return replace(self, first=max(place, 0) // self.most * self.most)

    def turned(self, by: int, count: int) -> Paged:
        """The page `by` pages further in a list of this length."""
        return self.at(self.places(count).start + by * self.most)

    def places(self, count: int) -> range:
        """The indices of the rows to show in a list of this length."""
        first = min(self.first, self.at(count - 1).first)
        return range(first, min(first + self.most, count))

    def shown(self, count: int, turn: Callable[[int], Command]) -> dict[str, object] | None:
        """Values for a template: first, last, count, and the commands that turn the page; None if one page holds all rows.

        Args:
            turn: returns the command that moves by a number of pages.
        """
        if count <= self.most:
            return None
        places = self.places(count)
        return {"first": places.start + 1, "last": places.stop, "of": count, "back": turn(-1), "on": turn(1)}
