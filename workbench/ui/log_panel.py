"""The Log tab: what the author's code printed, with a filter, and what the worker's processes hold.

Redrawn a few times a second and only the last lines of what fits the filter, so that a task that prints in every
hook of every step costs the page no more than one that prints once.
"""

from __future__ import annotations

from collections.abc import Callable

import viser

from workbench.session.kept_worker import Vitals
from workbench.session.memory_limit import in_words
from workbench.session.printed import Printed
from workbench.session.view import SessionView
from workbench.ui.checked import checked_text
from workbench.ui.fragments import render
from workbench.ui.log_colours import spans_of_lines
from workbench.ui.parts import Part

LINES_SHOWN = 200
LONGEST_FILTER = 200


class LogPanel(Part[SessionView]):
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
        self._hold = server.gui.add_checkbox("Hold still", False, hint="Let new lines wait while you read.")
        self._html = server.gui.add_html("")
        self._clear = server.gui.add_button("Clear", icon=viser.Icon.ERASER, color="gray")
        self._vitals = server.gui.add_html("")
        self._clear.on_click(lambda _: self._on_clear(clear))
        self._filter.on_update(self._on_filter)
        self._wanted = ""
        self._asked, self._drawn = 0, -1
        """How often somebody asked for other lines, and when drawn: also while it is held."""

    def key(self, view: SessionView) -> object:
        return view.printed.serial, self._hold.value, self._asked, view.vitals

    def draw(self, view: SessionView) -> None:
        self._vitals.content = vitals_html(view.vitals)
        if self._hold.value and self._drawn == self._asked:
            return
        self._drawn = self._asked
        self._html.content = log_html(view.printed, self._wanted)
        # With nothing there, there is nothing to filter, to hold or to clear.
        for control in (self._filter, self._hold, self._clear):
            control.visible = bool(view.printed.lines or view.printed.dropped)

    def _on_filter(self, event: viser.GuiEvent) -> None:
        try:
            self._wanted = checked_text(self._filter.value, LONGEST_FILTER, "filter").strip()
        except ValueError as error:
            if event.client is not None:
                event.client.add_notification(
                    "Not possible", str(error), color="orange", auto_close_seconds=6.0
                )
            return
        self._asked += 1

    def _on_clear(self, clear: Callable[[], None]) -> None:
        self._asked += 1
        clear()


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
