"""The Log tab: what the author's code printed, in its colours, with a filter, and what the worker's processes hold.

Only the last lines of what fits the filter are drawn, so that a task that prints in every hook costs no more than one
that prints once. Colours beyond the page's sixteen are made lighter on the dark page and darker on the light one until
they can be read; with a background they are the author's on both.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import viser
from rich.color import Color, ColorType
from rich.color_triplet import ColorTriplet
from rich.style import Style
from rich.terminal_theme import TerminalTheme

from workbench.session.live.view import SessionView
from workbench.session.process.captured_output import PLAIN, SWITCHES, Printed, Run
from workbench.session.process.memory_limit import in_words
from workbench.session.process.supervisor import Vitals
from workbench.ui.server.control_values import limit_text
from workbench.ui.widgets.parts import PagePart
from workbench.ui.widgets.templates import render

Rgb = tuple[int, int, int]
LIGHT_PAGE: Rgb = (241, 243, 245)
DARK_PAGE: Rgb = (66, 66, 66)
"""The Log's background, or a little nearer to the text than that."""
READABLE = 4.5
"""Contrast between text and background that WCAG 2.1 asks for."""
MOST_SPANS = 1500
"""Over all lines; older ones are shown plain. A line may change its colour with each character."""
SIXTEEN = TerminalTheme(
    (255, 255, 255), (0, 0, 0),
    [(0, 0, 0), (205, 49, 49), (13, 138, 90), (170, 130, 0), (36, 114, 200), (188, 63, 188), (17, 130, 165), (229, 229, 229)],
    [(102, 102, 102), (241, 76, 76), (35, 209, 139), (245, 245, 67), (59, 142, 234), (214, 112, 214), (41, 184, 219), (255, 255, 255)],
)  # fmt: skip
"""Where one of them is a background, or stands on one."""


@dataclass(frozen=True)
class Span:
    """Text for the template; `look` and `css` hold nothing that the author wrote but numbers."""

    text: str
    look: str = ""
    css: str = ""


def spans_of_lines(lines: Sequence[tuple[str, tuple[Run, ...]]]) -> list[list[Span]]:
    """The spans of each line, given as its text and its runs; no more than `MOST_SPANS` in all."""
    left = MOST_SPANS
    found: list[list[Span]] = []
    for text, runs in reversed(lines):
        left -= len(runs)
        found.append([_span(run) for run in runs] if runs and left >= 0 else [Span(text)])
    return found[::-1]


def _span(run: Run) -> Span:
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
        if contrast(text, behind) < READABLE / 2:
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
    """`colour`, or the nearest to it towards black or white that can be read on `page`."""
    end = 255 if _luminance(page) < 0.2 else 0
    found = colour
    for share in range(1, 21):
        if contrast(found, page) >= READABLE:
            break
        red, green, blue = (round(value + (end - value) * share / 20) for value in colour)
        found = red, green, blue
    return found


def contrast(one: Rgb, other: Rgb) -> float:
    """1 for the same, 21 for black on white, as WCAG 2.1 defines it."""
    dark, light = sorted((_luminance(one), _luminance(other)))
    return (light + 0.05) / (dark + 0.05)


def _luminance(colour: Rgb) -> float:
    parts = [value / 255 for value in colour]
    red, green, blue = (p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


def _plain_on(behind: Rgb) -> Rgb:
    return (0, 0, 0) if contrast((0, 0, 0), behind) >= contrast((255, 255, 255), behind) else (255, 255, 255)


LINES_SHOWN = 200
LONGEST_FILTER = 200


class LogPanel(PagePart[SessionView]):
    """
    Args:
        server: The page.
        clear: Asks the session to forget what was printed.
    """

    every = 0.3

    def __init__(self, server: viser.ViserServer, clear: Callable[[], None]) -> None:
        self._filter = server.gui.add_text(
            "Filter", "", hint="Only lines with this in them; stderr: or stdout: before it takes one stream."
        )
        limit_text(self._filter, LONGEST_FILTER)
        self._hold = server.gui.add_checkbox("Hold still", False, hint="Let new lines wait while you read.")
        self._html = server.gui.add_html("")
        self._clear = server.gui.add_button("Clear", icon=viser.Icon.ERASER, color="gray")
        self._vitals = server.gui.add_html("")
        self._clear.on_click(lambda _: self._on_clear(clear))
        self._cleared = 0
        self._drawn: object = None
        """What somebody asked for when it was drawn; for another thing also while it is held."""

    def key(self, view: SessionView) -> object:
        return view.printed.serial, self._hold.value, self._filter.value, self._cleared, view.vitals

    def draw(self, view: SessionView) -> None:
        self._vitals.content = vitals_html(view.vitals)
        wanted = self._filter.value.strip()
        if self._hold.value and self._drawn == (wanted, self._cleared):
            return
        self._drawn = wanted, self._cleared
        self._html.content = log_html(view.printed, wanted)
        # With nothing there, there is nothing to filter, to hold or to clear.
        for control in (self._filter, self._hold, self._clear):
            control.visible = bool(view.printed.lines or view.printed.dropped)

    def _on_clear(self, clear: Callable[[], None]) -> None:
        clear()
        self._cleared += 1


def log_html(printed: Printed, wanted: str) -> str:
    """The last lines that fit; every value escaped.

    Args:
        wanted: text that a line must have in it, in any case of letters; ``stderr:`` or ``stdout:`` before it
            takes the lines of one stream only.
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


def vitals_html(vitals: Vitals) -> str:
    """What the processes hold, in words that change only when it matters."""
    if not vitals.memory:
        return ""
    return render("vitals", vitals=vitals, in_words=in_words)
