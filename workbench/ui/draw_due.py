"""When a part of the page is drawn again: there is something new to show, and the last drawing could be read.

The clock is given by who draws, so that all parts of a page go by one, and a test lets it pass.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

Clock = Callable[[], float]
"""Seconds from some moment on: `time.monotonic`, or what a test says."""


class DrawDue:
    """Of one part of a page.

    Args:
        every: Seconds between two drawings at least.
        clock: Of the page.
    """

    def __init__(self, every: float, clock: Clock = time.monotonic) -> None:
        self._every, self._clock = every, clock
        self._drawn: object = object()
        self._drawn_at = -math.inf

    def is_due(self, wanted: object, at_once: bool = False) -> bool:
        """Whether to draw now what `wanted` stands for; if so, that is what is drawn from here on.

        Args:
            at_once: somebody waits for it, so the time since the last drawing does not count.
        """
        now = self._clock()
        if wanted == self._drawn or not (at_once or now - self._drawn_at >= self._every):
            return False
        self._drawn, self._drawn_at = wanted, now
        return True
