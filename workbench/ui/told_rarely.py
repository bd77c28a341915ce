"""Log lines that a stranger can cause: said at once, then rarely, with how often it happened meanwhile."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Hashable

from workbench.machine.terminal_text import short_line

PAUSE = 60.0
"""Seconds in which the same thing is said once, at first."""
LONGEST_PAUSE = 3600.0
"""A tab that was left open knocks once a second for as long as it is there."""
MOST_KINDS = 256
LONGEST = 300
"""Characters of a line."""

log = logging.getLogger("workbench.door")


class ToldRarely:
    """Says each kind of thing at once, and again after `pause` seconds, twice that, and so on. From any thread.

    Args:
        say: Prints one line.
    """

    def __init__(self, say: Callable[[str], None] = log.warning, pause: float = PAUSE) -> None:
        self._say, self._pause = say, pause
        self._silent_until: dict[Hashable, float] = {}
        self._pauses: dict[Hashable, float] = {}
        self._untold: dict[Hashable, tuple[int, str]] = {}
        """How often, and what was to be said the last time."""
        self._lock = threading.Lock()

    def happened(self, kind: Hashable, sentence: str) -> None:
        """
        Args:
            kind: What counts as the same thing.
            sentence: What is said, with a full stop; controls are shown escaped.
        """
        now = time.monotonic()
        with self._lock:
            if now < self._silent_until.get(kind, 0.0):
                self._untold[kind] = self._untold.get(kind, (0, ""))[0] + 1, sentence
                return
            if len(self._pauses) >= MOST_KINDS:
                rest = self._forget()
            else:
                rest = ()
            pause = self._pauses.get(kind, self._pause)
            self._silent_until[kind] = now + pause
            self._pauses[kind] = min(2 * pause, LONGEST_PAUSE)
            before, _ = self._untold.pop(kind, (0, ""))
        for line in (*rest, _line(sentence, before)):
            self._say(line)

    def say_the_rest(self) -> None:
        """What happened since each was last said: at the end, when nothing further comes that would say it."""
        with self._lock:
            rest = self._forget()
        for line in rest:
            self._say(line)

    def _forget(self) -> tuple[str, ...]:
        rest = tuple(_line(sentence, times) for times, sentence in self._untold.values())
        self._silent_until.clear()
        self._pauses.clear()
        self._untold.clear()
        return rest


def _line(sentence: str, times: int) -> str:
    more = "once more" if times == 1 else f"{times} more times"
    return short_line(sentence, LONGEST) + (f" ({more} since this was last said.)" if times else "")
