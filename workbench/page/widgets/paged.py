"""Which rows of a long list are shown."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from workbench.page.command import Command


@dataclass(frozen=True)
class Paged:
    """A part of a list, `most` rows at a time. It is clamped to the list's length, which may change."""

    most: int
    first: int = 0
    """Row that the page begins with."""

    def at(self, place: int) -> Paged:
        """The page that holds this row."""
        return replace(self, first=max(place, 0) // self.most * self.most)

    def turned(self, by: int, count: int) -> Paged:
        """The page that is so many pages further in a list of this length."""
        return self.at(self.places(count).start + by * self.most)

    def places(self, count: int) -> range:
        """The rows to show of a list of this length."""
        first = min(self.first, self.at(count - 1).first)
        return range(first, min(first + self.most, count))

    def shown(self, count: int, turn: Callable[[int], Command]) -> dict[str, object] | None:
        """For a template: first, last, count, and the commands that turn the page; None where one page holds all rows.

        Args:
            turn: the command that moves by so many pages.
        """
        if count <= self.most:
            return None
        places = self.places(count)
        return {"first": places.start + 1, "last": places.stop, "of": count, "back": turn(-1), "on": turn(1)}
