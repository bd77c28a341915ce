"""The thread that redraws a page, and the order in which panels and the 3-D view are sent."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import viser

from workbench.machine.processes.watched_thread import watched_thread
from workbench.ui.server.strangers import RareLog
from workbench.ui.server.viser_private import wait_until_taken
from workbench.ui.widgets.notices import tell_all

FRAME = 1 / 30
"""Seconds of a frame. More pushes make a browser slower (measured: 350 a second leave it 13 to 30 frames a second)."""
SENT_WITHIN = 0.01
"""Seconds of a frame that the 3-D view may wait for the panels to be sent."""
AGAIN_AFTER = 1.0
"""Seconds until a page that could not be drawn is tried again."""


class RedrawLoop:
    """Redraws a page whenever there is something new to show.

    A page that cannot be drawn says so in every open browser and is tried again: a page that looks alive and stands
    still is worse.

    Args:
        server: Of viser.
        name: Of the thread.
        wait: Sleeps until there is something newer than a serial, at most some seconds; returns the newest serial.
        has_viewers: Whether any browser is open; else nothing is drawn.
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
        self._told = RareLog()
        self._thread = watched_thread(name, self._run)

    def start(self) -> None:
        """Draw the page, then keep drawing it in a thread."""
        if self._thread.ident is not None:
            raise RuntimeError("The page was started already.")
        if self._has_viewers():
            self._draw_or_say()
        self._thread.start()

    def stop(self) -> None:
        """Stop redrawing; returns when the loop has ended."""
        self._stopping.set()
        if self._thread.ident is not None:
            self._thread.join(timeout=5.0)

    def _run(self) -> None:
        seen, due = -1, time.monotonic()
        while not self._stopping.is_set():
            seen = self._wait(seen, 0.1)
            began = time.monotonic()
            if self._has_viewers() and not self._draw_or_say():
                self._stopping.wait(AGAIN_AFTER)
            due = next_frame(due, began)
            self._stopping.wait(max(0.0, due - time.monotonic()))

    def _draw_or_say(self) -> bool:
        try:
            self._draw()
        except Exception as error:
            # A second later the next one comes: not each has a traceback.
            self._told.happened(type(error), "The page could not be drawn; trying again.", error)
            tell_all(
                self._server,
                "This page could not be drawn",
                "The reason is in the terminal of the workbench. Trying again.",
                "red",
                5.0,
            )
            return False
        return True


def next_frame(due: float, began: float) -> float:
    """When to draw next: a frame that came late makes the next wait less, or its delay would be lost for good.

    Args:
        due: When the last frame was to be drawn, in seconds.
        began: When it was drawn.
    """
    return max(due + FRAME, began + FRAME / 2)


def draw_apart(
    server: viser.ViserServer, panels: Callable[[], None] | None, scene: Callable[[], None]
) -> None:
    """Send the panels first, unless they are None, then the 3-D view in a batch of its own.

    A browser takes a batch as a whole, and one with anything of the 3-D view waits for the next frame of that view,
    which may take long; numbers and buttons need not.
    """
    if panels is not None:
        with server.atomic():
            panels()
        server.flush()
        wait_until_taken(server, SENT_WITHIN)
    with server.atomic():
        scene()
    server.flush()
