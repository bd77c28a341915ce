"""What the author's code printed: the last lines, whatever it prints.

A print in a loop is a gigabyte in a minute. Each line that is split, decoded, kept and sent to a terminal costs
microseconds of the server, which is the page's: a flood of millions would freeze it. So the bytes are taken as
they come, in large pieces; so many lines a second are looked at, of the others only the number is known.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

_LONGEST_LINE = 2000
_LINES_KEPT = 1000
_LINES_PER_SECOND = 400
"""More are counted and dropped. Faster than anybody reads, and 1 % of a core."""
_KEPT_OF_PIECE = 16_384
"""Bytes at the end of a piece that are looked at when the piece is one of a flood."""


@dataclass(frozen=True)
class PrintedLine:
    stream: str
    """``stdout`` or ``stderr``."""
    text: str


@dataclass(frozen=True)
class Printed:
    """The log as it was at one moment."""

    serial: int
    lines: tuple[PrintedLine, ...]
    """Oldest first."""
    dropped: int
    """Lines that came too fast to be kept."""

    @property
    def texts(self) -> tuple[str, ...]:
        return tuple(line.text for line in self.lines)


NOTHING_PRINTED = Printed(0, (), 0)


class PrintedLog:
    """Fed by the threads that read the worker's output; read by the page. All methods are thread-safe."""

    def __init__(self, on_lines: Callable[[list[PrintedLine], int], None]) -> None:
        """
        Args:
            on_lines: called with new lines and how many were dropped before them, on the threads that feed.
        """
        self._on_lines = on_lines
        self._lock = threading.Lock()
        self._lines: deque[PrintedLine] = deque(maxlen=_LINES_KEPT)
        self._dropped = 0
        self._serial = 0
        self._rest: dict[str, bytes] = {}
        self._budget = float(_LINES_PER_SECOND)
        self._refilled = time.monotonic()
        self._view = NOTHING_PRINTED

    def feed(self, stream: str, piece: bytes) -> bool:
        """The next bytes of a stream, in any pieces; none at its end. True while they come too fast."""
        with self._lock:
            if not piece:
                # What stands without an end of line is the last line.
                piece = b"\n" if self._rest.get(stream) else b""
            now = time.monotonic()
            earned = (now - self._refilled) * _LINES_PER_SECOND
            self._budget, self._refilled = min(self._budget + earned, float(_LINES_PER_SECOND)), now
            found, dropped = self._split(stream, piece)
            # The last lines of a flood say more than its first ones, and the very last the most.
            over = len(found) - max(1, int(self._budget))
            if over > 0:
                found, dropped = found[over:], dropped + over
            self._budget = max(0.0, self._budget - len(found))
            lines = [PrintedLine(stream, _text(line)) for line in found]
            self._dropped += dropped
            self._lines.extend(lines)
            if lines or dropped:
                self._serial += 1
        if lines or dropped:
            self._on_lines(lines, dropped)
        return dropped > 0

    def clear(self) -> None:
        with self._lock:
            self._lines.clear()
            self._dropped = 0
            self._serial += 1

    def view(self) -> Printed:
        with self._lock:
            if self._view.serial != self._serial:
                self._view = Printed(self._serial, tuple(self._lines), self._dropped)
            return self._view

    def tail(self, count: int) -> str:
        """The last `count` lines, as one text."""
        return "\n".join(self.view().texts[-count:])

    def _split(self, stream: str, piece: bytes) -> tuple[list[bytes], int]:
        """The lines that end in `piece`, and how many of it were not even looked at."""
        dropped = 0
        if len(piece) > _KEPT_OF_PIECE and self._budget < _LINES_PER_SECOND / 2:
            cut = piece.rfind(b"\n", 0, len(piece) - _KEPT_OF_PIECE) + 1
            dropped = piece.count(b"\n", 0, cut)
            if cut:
                piece, self._rest[stream] = piece[cut:], b""
        *whole, rest = (self._rest.get(stream, b"") + piece).split(b"\n")
        # Without an end of line in sight: cut there, or a gigabyte without one would fill us up.
        if len(rest) > _LONGEST_LINE:
            whole.append(rest)
            rest = b""
        self._rest[stream] = rest
        return whole, dropped


def _text(line: bytes) -> str:
    cut = line if len(line) <= _LONGEST_LINE else line[:_LONGEST_LINE] + "…".encode()
    return cut.decode(errors="replace").rstrip("\r")
