"""Progress bar of a background job, and its result scrolled into view."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import ClassVar

import viser

from workbench.cameras.commands import StopMeasuring
from workbench.live.process.background_jobs import JobProgress
from workbench.page.widgets.templates import render
from workbench.page.widgets.tools import tool, tools_html

JUST = 1.0
"""Seconds for which a result counts as new."""


class NewResult:
    """Notices that a result has just replaced an older one, so that it is scrolled into view once.

    Only for a moment (``into_sight.html``): a tab that is opened again redraws its HTML, and must not scroll then.
    """

    def __init__(self) -> None:
        self._before: object = None
        self._waiting = False
        self._came = -1e9

    def asked(self, now: object) -> None:
        """A new result was asked for; `now` is the one that it will replace."""
        self._before, self._waiting = now, True

    def just_came(self, now: object) -> bool:
        """Whether the result came less than `JUST` ago. Call it at every draw, with the present result."""
        if self._waiting and now is not self._before and now:
            self._waiting, self._came = False, time.monotonic()
        return time.monotonic() - self._came < JUST


SHORT = 0.5
"""Seconds that a job may take without a bar."""


class JobResult:
    """A progress bar with a Stop button, and then the result, in the present container.

    Each folder has one under its own button, and only the one that was asked last shows what runs: one bar above all
    would push the pressed button away, one at the end is not seen.
    """

    _asked_last: ClassVar[JobResult | None] = None

    def __init__(self, server: viser.ViserServer) -> None:
        gui = server.gui
        self._bar = gui.add_html("", visible=False)
        self._stop = gui.add_html(tools_html([tool("Stop", StopMeasuring())]), visible=False)
        self._html = gui.add_html("", visible=False)
        self._began: float | None = None
        self._new = NewResult()
        self._drawn: object = None

    def asked(self, now: object) -> None:
        """A job was asked for here; its result replaces `now`."""
        JobResult._asked_last = self
        self._new.asked(now)

    def draw(
        self, running: JobProgress | None, came: object, told: object, html: Callable[[bool], str]
    ) -> None:
        """Draw the bar and the result, where they changed.

        Args:
            came: the result, if there is one.
            told: what else its HTML shows; compared.
            html: renders the result, given whether it came a moment ago.
        """
        self._draw_bar(running)
        new = self._new.just_came(came)
        if (wanted := (id(came), told, new)) != self._drawn:
            self._drawn = wanted
            self._html.visible = bool(came)
            if came:
                self._html.content = html(new)

    def _draw_bar(self, running: JobProgress | None) -> None:
        if running is None or JobResult._asked_last is not self:
            self._began = None
        elif self._began is None:
            self._began = time.monotonic()
        shown = self._began is not None and time.monotonic() - self._began >= SHORT
        for handle in (self._bar, self._stop):
            handle.visible = shown
        if shown:
            self._bar.content = render("camera_progress", running=running)
