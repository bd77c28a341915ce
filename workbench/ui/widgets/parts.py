"""A page is a list of parts, and each is drawn when there is something new to show and the last drawing could be read.

The clock is given by who draws, so that all parts of a page go by one, and a test lets it pass.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from typing import ClassVar, Generic, TypeVar

Clock = Callable[[], float]
"""Seconds from some moment on: `time.monotonic`, or what a test says."""
View = TypeVar("View", contravariant=True)


class PagePart(Generic[View]):
    """One part of a page, drawn from an immutable view.

    It is drawn again when its `key` is another, `every` seconds after the last time at the soonest; and at once when
    what is `urgent` is another. As it stands here every view is drawn: viser sends nothing of what is equal
    (``tests/ui/test_assigning.py``), so a part needs a key only where it is dear to make what it shows.
    """

    every: ClassVar[float] = 0.0
    """Seconds."""

    def key(self, view: View) -> object:
        """What it shows of the view: equal to that of an equal drawing."""
        return object()

    def urgent(self, view: View) -> object:
        """What of it somebody waits for."""
        return None

    def draw(self, view: View) -> None:
        raise NotImplementedError


class DrawDue:
    """When to draw one thing.

    Args:
        every: Seconds between two drawings at least.
        clock: Of the page.
    """

    def __init__(self, every: float, clock: Clock = time.monotonic) -> None:
        self._every, self._clock = every, clock
        self._drawn: tuple[object, object, float] | None = None
        """Key, urgent, and when."""

    def is_due(self, key: object, urgent: object = None) -> bool:
        """Whether to draw now; if so, this is what is drawn from here on."""
        now = self._clock()
        if self._drawn is not None:
            drawn, was_urgent, at = self._drawn
            if urgent == was_urgent and (key == drawn or now - at < self._every):
                return False
        self._drawn = key, urgent, now
        return True


class Parts(Generic[View]):
    """The parts of a page, in the order in which they are drawn."""

    def __init__(self, parts: Iterable[PagePart[View]], clock: Clock = time.monotonic) -> None:
        self._parts = [(part, DrawDue(part.every, clock)) for part in parts]

    def draw(self, view: View) -> None:
        for part, due in self._parts:
            if due.is_due(part.key(view), part.urgent(view)):
                part.draw(view)
