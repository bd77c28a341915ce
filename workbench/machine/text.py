"""Formats numbers and lengths for people, and makes text from other sources safe for a terminal."""

from __future__ import annotations

import logging
import math
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

_UNITS = (("m", 1.0, 1.0), ("cm", 1e-2, 1e-2), ("mm", 1e-3, 1e-4), ("µm", 1e-6, 1e-6), ("nm", 1e-9, 0.0))
"""(name, size in metres, shortest length in metres for which the unit is used)."""


def number_text(value: float, form: str = ".4g") -> str:
    """A number as text: ``0.25``, ``NaN``, ``infinite``, ``-infinite``."""
    if math.isnan(value):
        return "NaN"
    if math.isinf(value):
        return "infinite" if value > 0 else "-infinite"
    return format(value, form)


def rate_text(value: float) -> str:
    """A rate of zero or more as text, with two significant digits below 10: ``5 125``, ``240``, ``9.6``,
    ``0.93``, ``0.045``."""
    return f"{value:,.0f}".replace(",", " ") if value >= 9.95 else f"{value:.2g}"


def nonfinite_text(values: ArrayLike) -> str:
    """Counts of values that are not finite: ``NaN in 3 of 16``, ``NaN in 3, infinite in 1 of 16``; empty if
    all are finite."""
    flat = np.asarray(values).reshape(-1)
    counts = {"NaN": int(np.isnan(flat).sum()), "infinite": int(np.isinf(flat).sum())}
    counted = ", ".join(f"{word} in {count}" for word, count in counts.items() if count)
    return f"{counted} of {len(flat)}" if counted else ""


def mean_text(values: ArrayLike, form_text: Callable[[float], str] = number_text) -> str:
    """Mean of the finite values, and counts of the others: ``0.25, NaN in 3 of 16``."""
    flat = np.asarray(values, np.float64).reshape(-1)
    finite = flat[np.isfinite(flat)]
    return ", ".join(
        part
        for part in (form_text(float(finite.mean())) if len(finite) else "", nonfinite_text(flat))
        if part
    )


def length(metres: float) -> str:
    """A length as text: ``3.2 cm``, ``0.4 mm``, ``70 nm``, ``0``."""
    if metres == 0:
        return "0"
    if not math.isfinite(metres):
        return "infinite"
    unit, size = next((unit, size) for unit, size, least in _UNITS if metres >= least)
    return f"{metres / size:.2g} {unit}"


# --- text from elsewhere, made safe for a terminal and a page: controls are escaped, colours kept -----


_ESCAPED = re.compile(
    "[\x00-\x1f\x7f-\x9f"  # C0, DEL and C1, which some terminals take for ESC and a letter
    "\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069"  # the direction of writing
    "\u2028\u2029"  # line ends, to some programs
    "\u200b\u2060\ufeff\U000e0000-\U000e007f"  # invisible
    "\ud800-\udfff]"  # bytes of a file's name that are not UTF-8: they cannot be printed
)
COLOURS = re.compile("\x1b\\[([0-9;:]{0,64})m")
"""Pattern of a colour sequence with its numbers."""
HARMLESS = frozenset((0, 1, 2, 3, 4, 7, 9, 22, 23, 24, 27, 29, *range(30, 50), *range(90, 108)))
"""Codes of colours and styles that neither hide text nor blink."""


def plain_text(text: str, keep: str = "") -> str:
    r"""`text` with control, invisible and direction characters escaped as Python does (``\x1b``), except
    those in `keep`.

    Such characters can clear a terminal, rename its window, write to the clipboard, move the cursor over other text, or make a
    name look like another.
    """
    if not _ESCAPED.search(text):
        return text
    return _ESCAPED.sub(
        lambda found: found[0] if found[0] in keep else found[0].encode("unicode_escape").decode(), text
    )


def short_line(text: str, longest: int) -> str:
    """`text`, escaped as `plain_text` does, on one line. If it is longer than `longest` characters, its
    middle is replaced by ``...``."""
    if len(text) > longest:
        text = f"{text[: longest // 2]} ... {text[-longest // 2 :]}"
    return plain_text(text)


def only_colours(text: str, keep: str = "\n\t") -> str:
    """`text`, escaped as `plain_text` does; a colour sequence stays if all its codes are `HARMLESS`."""
    if not _ESCAPED.search(text):
        return text
    parts: list[str] = []
    end = 0
    for found in COLOURS.finditer(text):
        parts.append(plain_text(text[end : found.start()], keep))
        harmless = all(code[0] in HARMLESS for code in colour_codes(found[1]))
        parts.append(found[0] if harmless else plain_text(found[0]))
        end = found.end()
    parts.append(plain_text(text[end:], keep))
    return "".join(parts)


def colour_codes(numbers: str) -> Iterator[tuple[int, ...]]:
    """Yield each code of a colour sequence with its arguments: (31,), (38, 5, 208), (48, 2, 0, 0, 0)."""
    parts = iter(numbers.split(";"))
    for part in parts:
        if ":" in part:
            values = [int(value) if value else 0 for value in part.split(":")]
            # There are two forms, 38:2:COLOUR_SPACE:r:g:b and the common 38:2:r:g:b: drop the colour space.
            if values[0] in (38, 48) and len(values) > 5 and values[1] == 2:
                del values[2]
            yield tuple(values)
            continue
        code = int(part) if part else 0
        if code not in (38, 48):
            yield (code,)
            continue
        kind = next(parts, "")
        wanted = {"5": 1, "2": 3}.get(kind, 0)
        following = [next(parts, "") for _ in range(wanted)]
        yield (code, *(int(value) if value.isdigit() else 0 for value in (kind, *following)))


class SafeStream:
    """A text stream that writes through `only_colours`."""

    def __init__(self, raw: Any) -> None:
        self.raw = raw

    def write(self, text: str) -> int:
        self.raw.write(only_colours(text))
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.raw, name)


def guard_terminal() -> None:
    """Let this process print only text and colours to its terminal.

    This is never undone, since a traceback that ends the process is printed last. Output of native code and
    of other programs is not filtered.
    """
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is not None and not isinstance(stream, SafeStream):
            setattr(sys, name, SafeStream(stream))
    # Without a logging set-up all records go through this handler.
    if logging.lastResort is not None:
        logging.lastResort.setFormatter(_OneLine())


MAX_TRACEBACK_LINES = 80
"""Maximum lines of a traceback."""
MAX_LINE_CHARACTERS = 500


class _OneLine(logging.Formatter):
    """Formats a log record as one line, followed by its traceback."""

    def formatMessage(self, record: logging.LogRecord) -> str:
        return plain_text(super().formatMessage(record))

    def formatException(self, ei: Any) -> str:
        # An error message may quote all that a recording or a page sent.
        lines = [line[:MAX_LINE_CHARACTERS] for line in super().formatException(ei).splitlines()]
        if len(lines) > MAX_TRACEBACK_LINES:
            lines = [*lines[: MAX_TRACEBACK_LINES // 2], "    ...", *lines[-MAX_TRACEBACK_LINES // 2 :]]
        return plain_text("\n".join(lines), "\n\t")


def of(count: int, total: int, what: str) -> str:
    """A count as text: ``3 of 32 seeds``."""
    return f"{count} of {total} {what}{'' if total == 1 else 's'}"


def listed(values: Sequence[object], most: int = 5) -> str:
    """Values as text: ``1, 2, 3 ...``."""
    return ", ".join(map(str, values[:most])) + (" ..." if len(values) > most else "")
