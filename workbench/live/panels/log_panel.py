"""The Log tab: captured output of the author's code in its colours, a filter, and memory use of the processes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import viser
from rich.color import Color, ColorType
from rich.color_triplet import ColorTriplet
from rich.style import Style
from rich.terminal_theme import TerminalTheme

from workbench.live.commands import ClearLog, FilterLog, PauseLog
from workbench.live.process.captured_output import PLAIN, SWITCHES, Printed, StyledText
from workbench.live.process.memory_limit import format_size
from workbench.live.process.supervisor import ProcessMemory
from workbench.live.view import SessionView
from workbench.page.command import Command
from workbench.page.widgets.fields import Field, tick
from workbench.page.widgets.parts import PagePart
from workbench.page.widgets.templates import render
from workbench.page.widgets.tools import tool, tools_html
from workbench.page.widgets.visitors import Visitor

Rgb = tuple[int, int, int]
LIGHT_PAGE: Rgb = (241, 243, 245)
DARK_PAGE: Rgb = (66, 66, 66)
"""Backgrounds of the Log, slightly closer to the text colour than the real ones."""
MIN_CONTRAST = 4.5
"""Minimum contrast ratio of text in WCAG 2.1."""
MAX_SPANS = 1500
"""Maximum number of spans of all lines together, since each character may have its own colour. If there are
more, the oldest lines are shown without colours."""
SIXTEEN = TerminalTheme(
    (255, 255, 255), (0, 0, 0),
    [(0, 0, 0), (205, 49, 49), (13, 138, 90), (170, 130, 0), (36, 114, 200), (188, 63, 188), (17, 130, 165), (229, 229, 229)],
    [(102, 102, 102), (241, 76, 76), (35, 209, 139), (245, 245, 67), (59, 142, 234), (214, 112, 214), (41, 184, 219), (255, 255, 255)],
)  # fmt: skip
"""Theme for the sixteen standard colours where they are a background, or text on a background colour."""


@dataclass(frozen=True)
class Span:
    """Text for the template; `look` and `css` contain nothing of the author's output but numbers."""

    text: str
    look: str = ""
    css: str = ""


def spans_of_lines(lines: Sequence[tuple[str, tuple[StyledText, ...]]]) -> list[list[Span]]:
    """The spans of each line, at most `MAX_SPANS` in total. A line is given as its text and its runs."""
    left = MAX_SPANS
    found: list[list[Span]] = []
    for text, runs in reversed(lines):
        left -= len(runs)
        found.append([_span(run) for run in runs] if runs and left >= 0 else [Span(text)])
    return found[::-1]


def _span(run: StyledText) -> Span:
    return Span(run.text) if run.style == PLAIN else Span(run.text, *_look(run.style))


@lru_cache(maxsize=4096)
def _look(style: Style) -> tuple[str, str]:
    """Classes and inline style."""
    classes = [f"wb-ansi-{name}" for name in SWITCHES if getattr(style, name) and name != "reverse"]
    colour, background = style.color, style.bgcolor
    if style.reverse:
        if colour is None and background is None:
            return " ".join((*classes, "wb-ansi-reverse")), ""
        colour, background = background, colour or Color.from_ansi(7)
    if background is not None:
        behind = background.get_truecolor(SIXTEEN)
        text = _plain_on(behind) if colour is None else colour.get_truecolor(SIXTEEN)
        if contrast(text, behind) < MIN_CONTRAST / 2:
            text = _plain_on(behind)
        return " ".join(classes), f"color:{ColorTriplet(*text).hex};background:{behind.hex}"
    if colour is not None and colour.type is ColorType.STANDARD:
        classes.append(f"wb-ansi-{colour.number}")
    elif colour is not None:
        classes.append("wb-ansi-rgb")
        own = colour.get_truecolor(SIXTEEN)
        light, dark = (ColorTriplet(*readable_on(own, page)) for page in (LIGHT_PAGE, DARK_PAGE))
        return " ".join(classes), f"--on-light:{light.hex};--on-dark:{dark.hex}"
    return " ".join(classes), ""


def readable_on(colour: Rgb, page: Rgb) -> Rgb:
    """`colour`, moved towards black or white until it is readable on `page`."""
    end = 255 if _luminance(page) < 0.2 else 0
    found = colour
    for share in range(1, 21):
        if contrast(found, page) >= MIN_CONTRAST:
            break
        red, green, blue = (round(value + (end - value) * share / 20) for value in colour)
        found = red, green, blue
    return found


def contrast(one: Rgb, other: Rgb) -> float:
    """Contrast ratio of WCAG 2.1: 1 for equal colours, 21 for black on white."""
    dark, light = sorted((_luminance(one), _luminance(other)))
    return (light + 0.05) / (dark + 0.05)


def _luminance(colour: Rgb) -> float:
    parts = [value / 255 for value in colour]
    red, green, blue = (p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


def _plain_on(behind: Rgb) -> Rgb:
    return (0, 0, 0) if contrast((0, 0, 0), behind) >= contrast((255, 255, 255), behind) else (255, 255, 255)


LINES_SHOWN = 200
MAX_FILTER_CHARACTERS = 200


class LogPanel(PagePart[SessionView]):
    """The last lines that pass the filter. Only these are drawn, so that the panel stays cheap while a task
    prints in every hook.

    Args:
        server: The page.
        clear: Clears the session's output.
    """

    every = 0.3
    does = (FilterLog, PauseLog, ClearLog)

    def __init__(self, server: viser.ViserServer, clear: Callable[[], None]) -> None:
        self._wanted, self._held = "", False
        self._clear = clear
        self._filter = Field(
            server,
            "Filter",
            FilterLog,
            "text",
            hint="Show only lines that contain this text. Begin with stderr: or stdout: for one stream.",
            live=True,
            longest=MAX_FILTER_CHARACTERS,
        )
        self._hold = tick(
            server, "Pause", PauseLog, "on", False, hint="New lines are shown after you switch this off."
        )
        self._html = server.gui.add_html("")
        self._tools = server.gui.add_html("")
        self._vitals = server.gui.add_html("")
        self._cleared = 0
        self._drawn: object = None
        """Filter and number of clears at the last drawing; a change of either is drawn even while the log is
        paused."""

    def key(self, view: SessionView) -> object:
        return view.printed.serial, self._held, self._wanted, self._cleared, view.vitals

    def do(self, command: Command, visitor: Visitor) -> None:
        match command:
            case FilterLog(text=text):
                self._wanted = text
            case PauseLog(on=on):
                self._held = on
            case ClearLog():
                self._clear()
                self._cleared += 1

    def draw(self, view: SessionView) -> None:
        self._vitals.content = vitals_html(view.vitals)
        # An empty log needs no controls. A paused log needs them once there are lines, so that the user can
        # resume it.
        some = bool(view.printed.lines or view.printed.dropped)
        self._filter.visible = self._hold.visible = some
        self._hold.show(self._held)
        self._tools.content = tools_html([tool("Clear", ClearLog())] if some else [])
        wanted = self._wanted.strip()
        if self._held and self._drawn == (wanted, self._cleared):
            return
        self._drawn = wanted, self._cleared
        self._html.content = log_html(view.printed, wanted)


def log_html(printed: Printed, wanted: str) -> str:
    """The last lines that pass the filter.

    Args:
        wanted: text that a line must contain, case-insensitive; the prefix ``stderr:`` or ``stdout:`` selects one stream.
    """
    stream, colon, rest = wanted.partition(":")
    if not (colon and stream in ("stdout", "stderr")):
        stream, rest = "", wanted
    part = rest.strip().lower()
    fits = [
        line
        for line in printed.lines
        if (not stream or line.stream == stream) and (not part or part in line.text.lower())
    ]
    lines = fits[-LINES_SHOWN:]
    spans = spans_of_lines([(line.text, line.runs) for line in lines])
    return render(
        "log",
        lines=list(zip((line.stream for line in lines), spans)),
        shown=len(lines),
        kept=len(printed.lines),
        wanted=wanted,
        dropped=printed.dropped,
    )


def vitals_html(vitals: ProcessMemory) -> str:
    """Memory use of the processes, as text that changes only with a relevant difference."""
    if not vitals.memory:
        return ""
    return render("vitals", vitals=vitals, format_size=format_size)
