"""The thread that builds the pages of a server and draws them, one page at a time."""

from __future__ import annotations

import logging
import queue
import time
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Literal, Protocol

import viser

from workbench.machine.loop import do
from workbench.machine.processes.watched_thread import watched_thread
from workbench.page.command import Command, Refused
from workbench.page.door.connection_limits import RateLimitedLog
from workbench.page.door.viser_private import wait_until_taken
from workbench.page.scene.viewpoint import View3D
from workbench.page.widgets.notices import notify_all
from workbench.page.widgets.visitors import Done, Visitor

log = logging.getLogger(__name__)

FRAME_SECONDS = 1 / 30
"""Time from one frame to the next. More frequent updates slow a browser down (measured: at 350 updates
a second it draws 13 to 30 frames a second)."""
PANELS_TIMEOUT_SECONDS = 0.01
"""Maximum time per frame for which the 3-D view waits until the panels are sent."""
RETRY_SECONDS = 1.0
"""Time after which a page that could not be drawn is drawn again."""
_IDLE_SECONDS = 0.1
"""Time after which a page is drawn again although nothing has changed."""
_POLL_SECONDS = 0.02
"""Interval at which the thread checks whether another page is requested."""
_BUILD_TIMEOUT_SECONDS = 10.0
"""Maximum time that `stop` waits for a page that is being drawn."""

Which = Literal["start", "live", "review"]


class ShownPage(Protocol):
    """A page, built on a server that has no other page."""

    @property
    def dark(self) -> bool:
        """Whether the theme is dark."""
        ...

    def wait(self, seen: int, timeout: float) -> int:
        """Block until the page has a newer serial than `seen`, at most `timeout` seconds; returns the newest
        serial."""
        ...

    def counted(self, visitors: int) -> None:
        """Set the number of browsers that show the page."""
        ...

    def redraw(self) -> None:
        """Draw the present state."""
        ...

    def close(self) -> None:
        """Release the page: it will not be shown again."""
        ...

    def do(self, command: Command, visitor: Visitor) -> Done:
        """Carry out a command. Raises `Refused`."""
        ...


@dataclass(frozen=True)
class _PageRequest:
    which: Which
    rebuild: bool
    shown: Future[None] = field(default_factory=Future)


class Pages:
    """Shows one of several pages on the same server, and redraws it whenever there is something new to show.

    viser has one page per server. So the whole page is removed and the next one is built in its place, and
    every open browser shows the next one. Meanwhile the session and the review continue, and the bodies in
    the 3-D view stay (`View3D`). Nothing is sent before the new page has been drawn once, so that no empty
    control is ever visible.

    If a page cannot be drawn, every open browser shows a notice, and drawing is retried: without the notice,
    a frozen page would look alive.

    Args:
        server: The viser server.
        stage: The 3-D view that the pages share.
        make: Builds a page on the empty server, given its name and whether it is dark.
    """

    def __init__(
        self, server: viser.ViserServer, stage: View3D, make: Callable[[Which, bool], ShownPage]
    ) -> None:
        self._server, self._stage, self._make = server, stage, make
        self._requests: queue.SimpleQueue[_PageRequest] = queue.SimpleQueue()
        self._ending = self._stopped = False
        self.shown: Which | None = None
        """Name of the page that is shown; None while a page is being built."""
        self._page: ShownPage | None = None
        self._dark = True
        self._events_log = RateLimitedLog()
        self._thread = watched_thread("pages", self._run)

    def start(self, which: Which) -> None:
        """Show the first page; returns when it is shown, and raises any exception of its construction."""
        shown = self.show(which)
        self._thread.start()
        shown.result()

    def show(self, which: Which, rebuild: bool = False) -> Future[None]:
        """Request a page. The future is done when this page, or one that was requested later, is shown; it is
        cancelled if drawing stops first.

        Args:
            rebuild: build the page again even if it is shown, because its session was replaced.
        """
        request = _PageRequest(which, rebuild)
        self._requests.put(request)
        if self._stopped:
            self._cancel_requests()
        return request.shown

    def _cancel_requests(self) -> None:
        """Cancel requests that no thread will answer: the end of the program would wait for them."""
        with suppress(queue.Empty):
            while True:
                self._requests.get_nowait().shown.cancel()

    def do(self, command: Command, visitor: Visitor) -> Done:
        """Let the page that is shown carry out a command."""
        page = self._page
        if page is None:
            raise Refused("Another page is being built; try again.")
        return page.do(command, visitor)

    def stop(self) -> None:
        """Stop drawing the present page; it stays as it is until the server closes."""
        self._ending = True
        if self._thread.ident is not None:
            self._thread.join(_BUILD_TIMEOUT_SECONDS)
        self._stopped = True
        self._cancel_requests()
        if self._page is not None:
            self._page.close()

    # --- on its thread -------------------------------------------------------------------------------

    def _run(self) -> None:
        seen, due = -1, time.monotonic()
        while not self._ending:
            if not self._requests.empty():
                self._show_newest()
                seen = -1
            if self._page is None:
                time.sleep(_POLL_SECONDS)
                continue
            seen = self._newer(self._page, seen)
            began = time.monotonic()
            pause = 0.0 if self._draw_or_say(self._page) else RETRY_SECONDS
            due = next_frame(due, began)
            self._sleep(max(pause, due - time.monotonic()))

    def _newer(self, page: ShownPage, seen: int) -> int:
        """Wait for something to draw, a request for another page, or `_IDLE_SECONDS`; returns the page's
        newest serial."""
        until = time.monotonic() + _IDLE_SECONDS
        while (newest := page.wait(seen, _POLL_SECONDS)) == seen and time.monotonic() < until:
            if not self._requests.empty() or self._ending:
                break
        return newest

    def _sleep(self, seconds: float) -> None:
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0 and self._requests.empty() and not self._ending:
            time.sleep(min(left, _POLL_SECONDS))

    def _show_newest(self) -> None:
        requests = [self._requests.get()]
        while not self._requests.empty():
            requests.append(self._requests.get())
        which = requests[-1].which
        try:
            if which != self.shown or any(request.rebuild for request in requests if request.which == which):
                self._build(which)
        except Exception as error:
            # The thread must survive, or no button could show a page again.
            log.exception("The page could not be built.")
            for request in requests:
                request.shown.set_exception(error)
            return
        for request in requests:
            request.shown.set_result(None)

    def _build(self, which: Which) -> None:
        before, self.shown = self._page, None
        with self._server.atomic():
            if before is not None:
                self._dark = before.dark
                # On the loop: a command must not reach a page that is half removed.
                do(lambda: self._take_down(before))
            page = self._make(which, self._dark)
            self._draw_or_say(page)
        self._server.flush()
        self._page = page
        self.shown = which

    def _take_down(self, page: ShownPage) -> None:
        """Remove all of a page: handles, commands, callbacks, nodes."""
        self._page = None
        page.close()
        self._stage.clear()
        self._server.gui.reset()

    def _draw_or_say(self, page: ShownPage) -> bool:
        try:
            visitors = self._stage.framing.follow()
            page.counted(visitors)
            if visitors:
                page.redraw()
        except Exception as error:
            # Drawing is retried every second, so the log limits the number of tracebacks.
            self._events_log.add(type(error), "The page could not be drawn; trying again.", error)
            notify_all(
                self._server,
                "This page could not be drawn",
                "The reason is in the terminal of the workbench. Trying again.",
                "red",
                5.0,
            )
            return False
        return True


def next_frame(due: float, began: float) -> float:
    """Time of the next frame: after a late frame the next wait is shorter, so that delays do not add up.

    Args:
        due: Scheduled time of the last frame, in seconds.
        began: Time at which drawing it began, in seconds.
    """
    return max(due + FRAME_SECONDS, began + FRAME_SECONDS / 2)


def draw_apart(
    server: viser.ViserServer, panels: Callable[[], None] | None, scene: Callable[[], None]
) -> None:
    """Send the panels first, unless they are None, then the 3-D view in a batch of its own.

    A browser handles a batch as a whole. A batch that changes the 3-D view waits for the view's next frame,
    which may take long; numbers and buttons must not wait for it.
    """
    if panels is not None:
        with server.atomic():
            panels()
        server.flush()
        wait_until_taken(server, PANELS_TIMEOUT_SECONDS)
    with server.atomic():
        scene()
    server.flush()
