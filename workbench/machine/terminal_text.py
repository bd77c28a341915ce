"""Text that comes from elsewhere, made harmless for a terminal and a page: controls are shown, colours are kept.

What a terminal gets can clear it, rename its window, write to the clipboard or move the cursor over what stood there;
characters that turn the direction of writing make a name look like another. So all of these are shown as Python would
write them (``\\x1b``, ``\\u202e``). Of an author's prints the colours are kept: only ``ESC [ numbers m``, and of the numbers
only those that a reader can still see through.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace

_SHOWN = re.compile(
    "[\x00-\x1f\x7f-\x9f"  # C0, DEL and C1, which some terminals take for ESC and a letter
    "\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069"  # the direction of writing
    "\u2028\u2029"  # line ends, to some programs
    "\u200b\u2060\ufeff\U000e0000-\U000e007f"  # seen by nobody
    "\ud800-\udfff]"  # bytes of a file's name that are not UTF-8: they cannot be printed
)
_COLOURS = re.compile("\x1b\\[([0-9;:]{0,64})m")
_SHORT = {"\n": "\\n", "\r": "\\r", "\t": "\\t"}

Rgb = tuple[int, int, int]
Colour = int | Rgb
"""0 to 15 as the terminal, or the page, has them; or red, green and blue, 0 to 255 each."""
_LEVELS = (0, 95, 135, 175, 215, 255)
"""Of the 6 x 6 x 6 colours after the first 16."""


@dataclass(frozen=True)
class Style:
    """How a run of characters looks."""

    colour: Colour | None = None
    background: Colour | None = None
    bold: bool = False
    dim: bool = False
    italic: bool = False
    underline: bool = False
    reverse: bool = False
    strike: bool = False


PLAIN = Style()
_SWITCHES: dict[int, tuple[str, bool]] = {
    1: ("bold", True),
    2: ("dim", True),
    3: ("italic", True),
    4: ("underline", True),
    7: ("reverse", True),
    9: ("strike", True),
    23: ("italic", False),
    24: ("underline", False),
    27: ("reverse", False),
    29: ("strike", False),
}


@dataclass(frozen=True)
class Run:
    """Characters of one style, none of them a control."""

    text: str
    style: Style


def plain_text(text: str, keep: str = "") -> str:
    """`text` with every control, unseen and direction character shown escaped, but for those in `keep`."""
    if not _SHOWN.search(text):
        return text
    return _SHOWN.sub(lambda found: found[0] if found[0] in keep else _escaped(found[0]), text)


def short_line(text: str, longest: int) -> str:
    """`text` on one line of about `longest` characters, as in `plain_text`; what is too long lacks its middle."""
    if len(text) > longest:
        text = f"{text[: longest // 2]} ... {text[-longest // 2 :]}"
    return plain_text(text)


def only_colours(text: str, keep: str = "\n\t") -> str:
    """`text` with its colours as they are and all else as in `plain_text`."""
    if not _SHOWN.search(text):
        return text
    parts: list[str] = []
    end = 0
    for found in _COLOURS.finditer(text):
        parts.append(plain_text(text[end : found.start()], keep))
        harmless = all(_is_harmless(code) for code in _codes(found[1]))
        parts.append(found[0] if harmless else plain_text(found[0]))
        end = found.end()
    parts.append(plain_text(text[end:], keep))
    return "".join(parts)


def coloured_runs(text: str, style: Style = PLAIN) -> tuple[list[Run], Style]:
    """One line as runs, and the style that the next line begins with.

    Args:
        style: the one that the line before ended with.
    """
    if not _SHOWN.search(text):
        return [Run(text, style)] if text else [], style
    runs: list[Run] = []
    end = 0
    for found in _COLOURS.finditer(text):
        _add(runs, text[end : found.start()], style)
        style = _changed(style, found[1])
        end = found.end()
    _add(runs, text[end:], style)
    return runs, style


def for_terminal(runs: tuple[Run, ...]) -> str:
    """These runs for a terminal that has colours; it is plain again after them."""
    said = [
        f"\x1b[{_numbers(run.style)}m{run.text}\x1b[0m" if run.style != PLAIN else run.text for run in runs
    ]
    return "".join(said)


def _add(runs: list[Run], text: str, style: Style) -> None:
    if not text:
        return
    text = plain_text(text, "\t")
    if runs and runs[-1].style == style:
        text = runs.pop().text + text
    runs.append(Run(text, style))


def _escaped(character: str) -> str:
    if character in _SHORT:
        return _SHORT[character]
    code = ord(character)
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"


# --- colours: ESC [ numbers m --------------------------------------------------------------------


def _codes(numbers: str) -> Iterator[tuple[int, ...]]:
    """The codes, each with what belongs to it: (31,), (38, 5, 208), (48, 2, 0, 0, 0)."""
    parts = iter(numbers.split(";"))
    for part in parts:
        if ":" in part:
            values = [int(value) if value else 0 for value in part.split(":")]
            # 38:2:SPACE:r:g:b and the 38:2:r:g:b that many write.
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


def _is_harmless(code: tuple[int, ...]) -> bool:
    first = code[0]
    return (
        first in (0, 22, 39, 49, *_SWITCHES, 38, 48)
        or 30 <= first <= 37
        or 40 <= first <= 47
        or 90 <= first <= 107
    )


def _changed(style: Style, numbers: str) -> Style:
    for code in _codes(numbers):
        first = code[0]
        if first == 0:
            style = PLAIN
        elif first == 22:
            style = replace(style, bold=False, dim=False)
        elif first == 4 and code[1:] == (0,):
            style = replace(style, underline=False)
        elif first in _SWITCHES:
            name, value = _SWITCHES[first]
            style = replace(style, **{name: value})
        elif first in (38, 39) or 30 <= first <= 37 or 90 <= first <= 97:
            style = replace(style, colour=_colour(code, 30))
        elif first in (48, 49) or 40 <= first <= 47 or 100 <= first <= 107:
            style = replace(style, background=_colour(code, 40))
    return style


def _colour(code: tuple[int, ...], base: int) -> Colour | None:
    first = code[0] - base
    if first == 9:
        return None
    if first == 8:
        if len(code) == 3 and code[1] == 5:
            return _of_256(min(code[2], 255))
        if len(code) == 5 and code[1] == 2:
            red, green, blue = (min(value, 255) for value in code[2:])
            return red, green, blue
        return None
    return first if first < 8 else first - 60 + 8


def _of_256(number: int) -> Colour:
    if number < 16:
        return number
    if number >= 232:
        grey = 8 + 10 * (number - 232)
        return grey, grey, grey
    number -= 16
    return _LEVELS[number // 36], _LEVELS[number // 6 % 6], _LEVELS[number % 6]


def _numbers(style: Style) -> str:
    """The style after a plain one."""
    switches = ("bold", "dim", "italic", "underline", "reverse", "strike")
    numbers = [str(code) for code, name in zip((1, 2, 3, 4, 7, 9), switches) if getattr(style, name)]
    for colour, base in ((style.colour, 30), (style.background, 40)):
        if isinstance(colour, tuple):
            numbers.append(f"{base + 8};2;" + ";".join(map(str, colour)))
        elif colour is not None:
            numbers.append(str(base + colour if colour < 8 else base + 60 + colour - 8))
    return ";".join(numbers)
