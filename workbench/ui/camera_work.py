"""How far work in the background is, and the way into sight for what came of it.

Each folder has a bar under its own button, and the one that was pressed last shows what runs: one bar above all would
push the pressed button away, one at the end is not seen. A result is brought into sight for a moment only (HTML carries
``into_sight.html`` while it is new): a tab that is opened again draws its HTML anew, and nobody wants to be taken there.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import ClassVar

import viser

from workbench.session.lane import Progress
from workbench.session.session import Session
from workbench.ui.fragments import render

JUST = 1.0
"""Seconds."""


class Arrival:
    def __init__(self) -> None:
        self._before: object = None
        self._waiting = False
        self._came = -1e9

    def asked(self, now: object) -> None:
        """Something was asked for, which is to come in place of what there is now."""
        self._before, self._waiting = now, True

    def just_came(self, now: object) -> bool:
        """Whether it came a moment ago. To be asked at every draw, with what there is."""
        if self._waiting and now is not self._before and now:
            self._waiting, self._came = False, time.monotonic()
        return time.monotonic() - self._came < JUST


SHORT = 0.5
"""Seconds that something may take without a bar."""


class Answer:
    """What is asked for with the button above, in the present container: a bar while it runs, and then what came of it."""

    _asked_last: ClassVar[Answer | None] = None

    def __init__(self, server: viser.ViserServer, session: Session) -> None:
        gui = server.gui
        self._bar = gui.add_html("", visible=False)
        self._stop = gui.add_button("Stop", icon=viser.Icon.PLAYER_STOP, color="gray", visible=False)
        self._stop.on_click(lambda _: session.studio.judging.stop())
        self._html = gui.add_html("", visible=False)
        self._began: float | None = None
        self._arrival = Arrival()
        self._drawn: object = None

    def asked(self, now: object) -> None:
        """What runs from now on was asked for here, and is to come in place of what there is now."""
        Answer._asked_last = self
        self._arrival.asked(now)

    def draw(self, running: Progress | None, came: object, told: object, html: Callable[[bool], str]) -> None:
        """Draw what is new.

        Args:
            came: what is to be shown, if anything.
            told: what else is to be seen in its HTML; compared.
            html: makes that of it, given whether it came a moment ago.
        """
        self._draw_bar(running)
        new = self._arrival.just_came(came)
        if (wanted := (id(came), told, new)) != self._drawn:
            self._drawn = wanted
            self._html.visible = bool(came)
            if came:
                self._html.content = html(new)

    def _draw_bar(self, running: Progress | None) -> None:
        if running is None or Answer._asked_last is not self:
            self._began = None
        elif self._began is None:
            self._began = time.monotonic()
        shown = self._began is not None and time.monotonic() - self._began >= SHORT
        for handle in (self._bar, self._stop):
            handle.visible = shown
        if shown:
            self._bar.content = render("camera_progress", running=running)
