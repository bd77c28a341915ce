"""Log lines that a stranger can cause: said at once, then rarely, with how often it happened meanwhile."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Hashable

PAUSE = 60.0
"""Seconds in which the same thing is said once."""
MOST_KINDS = 256
LONGEST = 300

log = logging.getLogger("workbench.door")


class ToldRarely:
    """Says each kind of thing at most once in `pause` seconds; it may be called from any thread.

    Args:
        say: Prints one line.
    """

    def __init__(self, say: Callable[[str], None] = log.warning, pause: float = PAUSE) -> None:
        self._say, self._pause = say, pause
        self._told: dict[Hashable, float] = {}
        self._untold: dict[Hashable, int] = {}
        self._lock = threading.Lock()

    def happened(self, kind: Hashable, sentence: str) -> None:
        """
        Args:
            kind: What counts as the same thing.
            sentence: What is said, with a full stop; characters that a terminal would obey are taken out.
        """
        now = time.monotonic()
        with self._lock:
            if now - self._told.get(kind, -self._pause) < self._pause:
                self._untold[kind] = self._untold.get(kind, 0) + 1
                return
            if len(self._told) >= MOST_KINDS:
                self._told.clear()
                self._untold.clear()
            self._told[kind] = now
            before = self._untold.pop(kind, 0)
        more = f" ({before} more times since this was last said.)" if before else ""
        self._say(printable(sentence) + more)


def printable(text: str) -> str:
    """One line of bounded length without control or direction characters, for a terminal."""
    short = text if len(text) <= LONGEST else f"{text[:LONGEST]}…"
    return "".join(character if character.isprintable() else "�" for character in short)
