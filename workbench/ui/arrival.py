"""What was asked for has just come: then, and for a moment only, the page brings it into sight.

A result opens under the button that asks for it, and at the lower end of a panel that is out of sight. HTML that is to
be seen carries ``into_sight.html`` while it is new. Only a moment: a page that opens a tab again draws its HTML anew,
and nobody wants to be taken there then.
"""

from __future__ import annotations

import time

JUST = 1.0
"""Seconds."""


class Arrival:
    def __init__(self) -> None:
        self._before: object = None
        self._waiting = False
        self._came = -1e9

    def asked(self, now: object) -> None:
        """Something was asked for, which is to come in place of what there is now."""
        self._before, self._waiting = now, True

    def just_came(self, now: object) -> bool:
        """Whether it came a moment ago. To be asked at every draw, with what there is."""
        if self._waiting and now is not self._before and now:
            self._waiting, self._came = False, time.monotonic()
        return time.monotonic() - self._came < JUST
