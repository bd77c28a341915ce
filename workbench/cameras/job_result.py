"""Shows the progress bar of a background job, and scrolls its result into view."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import ClassVar

import viser

from workbench.cameras.commands import StopMeasuring
from workbench.live.process.background_jobs import JobProgress
from workbench.page.widgets.templates import render
from workbench.page.widgets.tools import tool, tools_html

NEW_SECONDS = 1.0
"""Time for which a result counts as new."""


class NewResult:
    """Detects that a result has just replaced an older one, so that it is scrolled into view once.

    A result counts as new only for a moment (``into_sight.html``): a tab that is reopened redraws its HTML
    and must not scroll.
    """

    def __init__(self) -> None:
        self._before: object = None
        self._waiting = False
        self._came = -1e9

    def asked(self, now: object) -> None:
        """Store that a new result was requested; `now` is the result that it will replace."""
        self._before, self._waiting = now, True

    def just_came(self, now: object) -> bool:
        """Whether the result arrived less than `NEW_SECONDS` ago. Call it at every draw, with the present result."""
        if self._waiting and now is not self._before and now:
            self._waiting, self._came = False, time.monotonic()
        return time.monotonic() - self._came < NEW_SECONDS


BAR_DELAY_SECONDS = 0.5
"""Time after which a job gets a progress bar."""


class JobResult:
    """A progress bar with a Stop button, then the result, in the present container.

    Each folder has a `JobResult` under its own button. Only the one whose button was pressed last shows the
    running job. A single bar for all folders would push the pressed button away if it were at the top, and
    would be out of sight if it were at the end.
    """

    _asked_last: ClassVar[JobResult | None] = None

    def __init__(self, server: viser.ViserServer) -> None:
        gui = server.gui
        self._bar = gui.add_html("", visible=False)
        self._stop = gui.add_html(tools_html([tool("Stop", StopMeasuring())]), visible=False)
        self._html = gui.add_html("", visible=False)
        self._began: float | None = None
        self._new = NewResult()
        self._result: object = None
        self._drawn: object = None

    def asked(self, now: object) -> None:
        """Store that a job was requested here; `now` is the result that the new one will replace."""
        JobResult._asked_last = self
        self._new.asked(now)

    def draw(
        self, running: JobProgress | None, result: object, other: object, html: Callable[[bool], str]
    ) -> None:
        """Draw the bar and the result, if they changed.

        Args:
            result: the result, if there is one.
            other: all other values that the HTML shows; the HTML is rendered again if they change.
            html: renders the result, given whether it is new.
        """
        self._draw_bar(running)
        new = self._new.just_came(result)
        if result is not self._result or (other, new) != self._drawn:
            self._result, self._drawn = result, (other, new)
            self._html.visible = bool(result)
            if result:
                self._html.content = html(new)

    def _draw_bar(self, running: JobProgress | None) -> None:
        if running is None or JobResult._asked_last is not self:
            self._began = None
        elif self._began is None:
            self._began = time.monotonic()
        shown = self._began is not None and time.monotonic() - self._began >= BAR_DELAY_SECONDS
        for handle in (self._bar, self._stop):
            handle.visible = shown
        if shown:
            self._bar.content = render("camera_progress", running=running)
