"""Keeps the last lines that the worker printed, with their colours."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

from rich.ansi import AnsiDecoder
from rich.style import Style

from workbench.machine.text import COLOURS, HARMLESS, colour_codes, plain_text

PLAIN = Style.null()
SWITCHES = ("bold", "dim", "italic", "underline", "reverse", "strike")

_MAX_LINE_BYTES = 2000
_LINES_KEPT = 1000
_LINES_PER_SECOND = 400
"""Maximum number of lines per second that are kept; handling them costs 1 % of a core. Further lines are
counted and dropped."""
_BAR_PERIOD_SECONDS = 0.1
"""Minimum interval between two reports of an unfinished line that overwrites itself (a progress bar)."""
_FLOOD_BYTES = 16_384
"""During a flood, only this many bytes at the end of each piece are split into lines."""


class StyledText(NamedTuple):
    """A text in one style, without control characters."""

    text: str
    style: Style


@dataclass(frozen=True)
class PrintedLine:
    stream: str
    """``stdout`` or ``stderr``."""
    text: str
    """The text without colours, control characters escaped."""
    runs: tuple[StyledText, ...] = ()
    """The text as coloured runs; empty if it has no colour."""


@dataclass(frozen=True)
class Printed:
    """A copy of the log."""

    serial: int
    lines: tuple[PrintedLine, ...]
    """Oldest first; an unfinished line that overwrites itself (a progress bar) is last."""
    dropped: int
    """Number of lines that arrived too fast to be kept."""

    @property
    def texts(self) -> tuple[str, ...]:
        return tuple(line.text for line in self.lines)


NOTHING_PRINTED = Printed(0, (), 0)


class PrintedLog:
    """The last lines of a worker's output. Thread-safe: reader threads feed it, the page reads it.

    A print in a loop writes a gigabyte per minute. Splitting and decoding a line takes microseconds in the server process,
    so millions of lines would freeze the page: at most `_LINES_PER_SECOND` are decoded, the others are only
    counted. Of a line that overwrites itself, such as a progress bar, the last version is kept.
    """

    def __init__(self, on_lines: Callable[[list[PrintedLine], int], None]) -> None:
        """
        Args:
            on_lines: called on the feeding threads with the new lines and the number of lines dropped before
                them. If only an unfinished line was overwritten, it is called without lines.
        """
        self._on_lines = on_lines
        self._lock = threading.Lock()
        self._lines: deque[PrintedLine] = deque(maxlen=_LINES_KEPT)
        self._dropped = 0
        self._serial = 0
        self._rest: dict[str, bytes] = {}
        self._styles: dict[str, Style] = {}
        """Style at the start of each stream's next line."""
        self._budget = float(_LINES_PER_SECOND)
        self._refilled = time.monotonic()
        self._bar_reported = 0.0
        self._view = NOTHING_PRINTED

    def feed(self, stream: str, piece: bytes) -> bool:
        """Add the next bytes of a stream; they may end within a line. An empty `piece` means that the stream
        has ended. Returns True during a flood."""
        ended = not piece
        with self._lock:
            if ended:
                # The rest, which has no newline, becomes the last line.
                piece = b"\n" if self._rest.get(stream) else b""
            now = time.monotonic()
            earned = (now - self._refilled) * _LINES_PER_SECOND
            self._budget, self._refilled = min(self._budget + earned, float(_LINES_PER_SECOND)), now
            found, dropped = self._split(stream, piece)
            # The last lines of a flood are kept.
            over = len(found) - max(1, int(self._budget))
            if over > 0:
                found, dropped = found[over:], dropped + over
            self._budget = max(0.0, self._budget - len(found))
            lines = [self._line(stream, line) for line in found]
            if ended:
                self._styles.pop(stream, None)
            self._dropped += dropped
            self._lines.extend(lines)
            bar = b"\r" in self._rest[stream]
            if lines or dropped or bar:
                self._serial += 1
            report = bool(lines or dropped) or (bar and now - self._bar_reported > _BAR_PERIOD_SECONDS)
            if report and bar:
                self._bar_reported = now
        if report:
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
                self._view = Printed(self._serial, (*self._lines, *self._unfinished()), self._dropped)
            return self._view

    def tail(self, count: int) -> str:
        """The last `count` lines as one text."""
        return "\n".join(self.view().texts[-count:])

    def _split(self, stream: str, piece: bytes) -> tuple[list[bytes], int]:
        """The lines that end in `piece`, and the number of dropped lines."""
        dropped = 0
        if len(piece) > _FLOOD_BYTES and self._budget < _LINES_PER_SECOND / 2:
            cut = piece.rfind(b"\n", 0, len(piece) - _FLOOD_BYTES) + 1
            dropped = piece.count(b"\n", 0, cut)
            if cut:
                piece, self._rest[stream] = piece[cut:], b""
        *whole, rest = (self._rest.get(stream, b"") + piece).split(b"\n")
        # Of a progress bar keep only the last whole version, and the one that is being written.
        if rest.count(b"\r") > 1:
            rest = b"\r".join(rest.rsplit(b"\r", 2)[1:])
        # Cut an endless line, or it would fill this process's memory.
        if len(rest) > _MAX_LINE_BYTES:
            whole.append(rest)
            rest = b""
        self._rest[stream] = rest
        return whole, dropped

    def _line(self, stream: str, raw: bytes) -> PrintedLine:
        line, self._styles[stream] = _read(stream, raw, self._styles.get(stream, PLAIN))
        return line

    def _unfinished(self) -> list[PrintedLine]:
        found = [
            _read(stream, rest, self._styles.get(stream, PLAIN))[0]
            for stream, rest in self._rest.items()
            if b"\r" in rest
        ]
        return [line for line in found if line.text]


def _read(stream: str, raw: bytes, style: Style) -> tuple[PrintedLine, Style]:
    """A line, and the style at the start of the next one."""
    # Text after a carriage return overwrites the line.
    seen = raw.rstrip(b"\r").rpartition(b"\r")[2]
    cut = seen if len(seen) <= _MAX_LINE_BYTES else seen[:_MAX_LINE_BYTES] + "…".encode()
    runs, after = coloured_runs(cut.decode(errors="replace"), style)
    text = "".join(run.text for run in runs)
    return PrintedLine(stream, text, tuple(runs) if any(run.style != PLAIN for run in runs) else ()), after


def coloured_runs(text: str, style: Style = PLAIN) -> tuple[list[StyledText], Style]:
    """One line as runs, and the style at the start of the next line.

    Args:
        style: style at the end of the previous line.
    """
    runs: list[StyledText] = []
    end = 0
    for found in COLOURS.finditer(text):
        _add(runs, text[end : found.start()], style)
        style = _changed(style, found[1])
        end = found.end()
    _add(runs, text[end:], style)
    return runs, style


def for_terminal(runs: Iterable[StyledText]) -> str:
    """The text of these runs with escape codes; the terminal's style is plain after it."""
    return "".join(run.style.render(run.text) for run in runs)


def _add(runs: list[StyledText], text: str, style: Style) -> None:
    if not text:
        return
    text = plain_text(text, "\t")
    if runs and runs[-1].style == style:
        text = runs.pop().text + text
    runs.append(StyledText(text, style))


@lru_cache(4096)
def _changed(style: Style, numbers: str) -> Style:
    """The style after ``ESC [ numbers m``."""
    decoder = AnsiDecoder()
    decoder.style = style
    for first, *more in colour_codes(numbers):
        if first in (38, 48):
            decoder.decode_line(f"\x1b[{';'.join(map(str, (first, *more)))}m")
        elif first in HARMLESS:
            decoder.decode_line(f"\x1b[{24 if (first, more) == (4, [0]) else first}m")
    found = decoder.style
    # A colour that was switched off equals one that was never set.
    colour, background = (None if c is None or c.is_default else c for c in (found.color, found.bgcolor))
    on = Style.parse(" ".join(name for name in SWITCHES if getattr(found, name)))
    return Style(color=colour, bgcolor=background) + on
