"""The thread that redraws a page, the live one or the review, for as long as it is shown.

What is shown lives by its own clock and the browsers by theirs. Between them is this loop: it waits until there is
something new, or a moment has passed, and lets the page draw itself. A page that cannot be drawn says so in every
browser that is open and is tried again: one that stands still and looks alive is worse.

A browser takes a batch of messages as a whole, and a batch with anything of the 3-D view in it waits for the next
frame of that view, which may take long. Numbers and buttons need not. So they are sent first, in a batch of their own.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable

import viser

from workbench.machine.processes.watched_thread import watched_thread
from workbench.ui.server.viser_private import wait_until_taken
from workbench.ui.widgets.inputs import tell_all

log = logging.getLogger(__name__)

FRAME = 1 / 30
"""Seconds. Faster pushes make a browser slower (measured: 350 a second leave it 13 to 30)."""
SENT_WITHIN = 0.01
"""Seconds, of the time for a frame, that the view may wait for the panels to be on their way."""
AGAIN_AFTER = 1.0
"""Seconds until a page that could not be drawn is tried again."""


class RedrawLoop:
    """
    Args:
        server: Of viser.
        name: Of the thread.
        wait: Sleeps until there is something newer than a serial, at most some seconds; returns the newest serial.
        has_viewers: Whether any browser is open; nothing is drawn for nobody.
        draw: Draws the page.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        name: str,
        wait: Callable[[int, float], int],
        has_viewers: Callable[[], bool],
        draw: Callable[[], None],
    ) -> None:
        self._server, self._wait, self._has_viewers, self._draw = server, wait, has_viewers, draw
        self._stopping = threading.Event()
        self._thread = watched_thread(name, self._run)

    def start(self) -> None:
        """Draw the page, and go on with that in a thread."""
        if self._thread.ident is not None:
            raise RuntimeError("The page was started already.")
        if self._has_viewers():
            self._draw_or_say()
        self._thread.start()

    def stop(self) -> None:
        """Stop to redraw; returns when the loop has ended."""
        self._stopping.set()
        if self._thread.ident is not None:
            self._thread.join(timeout=5.0)

    def _run(self) -> None:
        seen = -1
        while not self._stopping.is_set():
            began = time.monotonic()
            seen = self._wait(seen, 0.1)
            if self._has_viewers() and not self._draw_or_say():
                self._stopping.wait(AGAIN_AFTER)
            self._stopping.wait(max(0.0, FRAME - (time.monotonic() - began)))

    def _draw_or_say(self) -> bool:
        try:
            self._draw()
        except Exception:
            log.exception("The page could not be drawn; trying again.")
            tell_all(
                self._server,
                "This page could not be drawn",
                "The reason is in the terminal of the workbench. It is tried again.",
                "red",
                5.0,
            )
            return False
        return True


def draw_apart(server: viser.ViserServer, panels: Callable[[], None], scene: Callable[[], None]) -> None:
    """Draw the panels, see them on their way, and then the 3-D view."""
    with server.atomic():
        panels()
    server.flush()
    wait_until_taken(server, SENT_WITHIN)
    with server.atomic():
        scene()
    server.flush()
