"""Which rows of a long list are shown."""

from __future__ import annotations

from collections.abc import Callable

from workbench.commands.command import Command


class Paged:
    """A part of a list, `most` rows at a time."""

    def __init__(self, most: int) -> None:
        self._most, self.first, self._count = most, 0, 0

    def go_to(self, place: int) -> None:
        """Show the page that holds this row; `places` clamps it to the list."""
        self.first = max(place, 0) // self._most * self._most

    def turn(self, by: int) -> None:
        """Move by this many pages."""
        self.go_to(self.first + by * self._most)

    def places(self, count: int) -> range:
        """The rows to show of a list of this length."""
        self._count = count
        if self.first >= count:
            self.go_to(count - 1)
        return range(self.first, min(self.first + self._most, count))

    def shown(self, turn: Callable[[int], Command]) -> dict[str, object] | None:
        """For a template: first, last, count, and the commands that turn the page; None where one page holds all rows.

        Args:
            turn: the command that moves by so many pages.
        """
        if self._count <= self._most:
            return None
        last = min(self.first + self._most, self._count)
        return {"first": self.first + 1, "last": last, "of": self._count, "back": turn(-1), "on": turn(1)}
