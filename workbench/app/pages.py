"""The thread that builds the pages of a server and draws them, one page at a time."""

from __future__ import annotations

import logging
import queue
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Literal, Protocol

import viser

from workbench.machine.loop import do
from workbench.machine.processes.watched_thread import watched_thread
from workbench.page.command import Command, Refused
from workbench.page.door.connection_limits import RateLimitedLog
from workbench.page.door.viser_private import wait_until_taken
from workbench.page.scene.viewpoint import View3D
from workbench.page.widgets.notices import tell_all
from workbench.page.widgets.visitors import Done, Visitor

log = logging.getLogger(__name__)

FRAME = 1 / 30
"""Seconds of a frame. More pushes make a browser slower (measured: 350 a second leave it 13 to 30 frames a second)."""
SENT_WITHIN = 0.01
"""Seconds of a frame that the 3-D view may wait for the panels to be sent."""
AGAIN_AFTER = 1.0
"""Seconds until a page that could not be drawn is tried again."""
_REST = 0.1
"""Seconds after which a page is drawn again although nothing has changed."""
_LOOK = 0.02
"""Seconds between two checks whether another page is wanted."""
_BUILT_WITHIN = 10.0
"""Seconds that the end of the program waits for a page that is being drawn."""

Which = Literal["start", "live", "review"]


class ShownPage(Protocol):
    """A page, built on a server that has no other."""

    @property
    def dark(self) -> bool:
        """Its theme."""
        ...

    def wait(self, seen: int, timeout: float) -> int:
        """Sleep until there is something newer than this serial, at most so many seconds; returns the newest serial."""
        ...

    def counted(self, visitors: int) -> None:
        """So many browsers show it."""
        ...

    def redraw(self) -> None:
        """Draw it."""
        ...

    def close(self) -> None:
        """It is shown no more."""
        ...

    def do(self, command: Command, visitor: Visitor) -> Done:
        """Carry out a command. Raises `Refused`."""
        ...


@dataclass(frozen=True)
class _Wish:
    which: Which
    anew: bool
    shown: Future[None] = field(default_factory=Future)


class Pages:
    """Shows one page of several on the same server, and draws it again whenever there is something new to show.

    viser has one page a server, so a page is removed whole and the other is built in its place; every open browser
    follows. The session and the review live on meanwhile, the bodies in the 3-D view stay (`View3D`), and nothing is
    sent before the new page was drawn once, so that no empty control is ever seen.

    A page that cannot be drawn says so in every open browser and is tried again: a page that looks alive and stands
    still is worse.

    Args:
        server: Of viser.
        stage: The 3-D view that the pages share.
        make: Builds a page on the empty server, given which one and whether it is dark.
    """

    def __init__(
        self, server: viser.ViserServer, stage: View3D, make: Callable[[Which, bool], ShownPage]
    ) -> None:
        self._server, self._stage, self._make = server, stage, make
        self._wishes: queue.SimpleQueue[_Wish] = queue.SimpleQueue()
        self._ending = False
        self.shown: Which | None = None
        """The page that is shown."""
        self._page: ShownPage | None = None
        self._dark = True
        self._told = RateLimitedLog()
        self._thread = watched_thread("pages", self._run)

    def start(self, which: Which) -> None:
        """Show the first page; returns when it is shown, and raises what was raised as it was built."""
        shown = self.show(which)
        self._thread.start()
        shown.result()

    def show(self, which: Which, anew: bool = False) -> Future[None]:
        """Request a page; it is done when this one, or one that was requested after it, is shown.

        Args:
            anew: build it also if it is shown: it has another session.
        """
        wish = _Wish(which, anew)
        self._wishes.put(wish)
        return wish.shown

    def do(self, command: Command, visitor: Visitor) -> Done:
        """Let the page that is shown carry out a command."""
        page = self._page
        if page is None:
            raise Refused("Another page is being built; try it again.")
        return page.do(command, visitor)

    def stop(self) -> None:
        """Stop drawing the present page; it stays as it is until the server closes."""
        self._ending = True
        if self._thread.ident is not None:
            self._thread.join(_BUILT_WITHIN)
        if self._page is not None:
            self._page.close()

    # --- on its thread -------------------------------------------------------------------------------

    def _run(self) -> None:
        seen, due = -1, time.monotonic()
        while not self._ending:
            if not self._wishes.empty():
                self._show_newest()
                seen = -1
            if self._page is None:
                time.sleep(_LOOK)
                continue
            seen = self._newer(self._page, seen)
            began = time.monotonic()
            pause = 0.0 if self._draw_or_say(self._page) else AGAIN_AFTER
            due = next_frame(due, began)
            self._sleep(max(pause, due - time.monotonic()))

    def _newer(self, page: ShownPage, seen: int) -> int:
        """The newest serial of the page, as soon as there is something to draw or another page is wanted."""
        until = time.monotonic() + _REST
        while (newest := page.wait(seen, _LOOK)) == seen and time.monotonic() < until:
            if not self._wishes.empty() or self._ending:
                break
        return newest

    def _sleep(self, seconds: float) -> None:
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0 and self._wishes.empty() and not self._ending:
            time.sleep(min(left, _LOOK))

    def _show_newest(self) -> None:
        wishes = [self._wishes.get()]
        while not self._wishes.empty():
            wishes.append(self._wishes.get())
        which = wishes[-1].which
        try:
            if which != self.shown or any(wish.anew for wish in wishes if wish.which == which):
                self._build(which)
        except Exception as error:
            # The thread must survive, or no button could show a page again.
            log.exception("The page could not be built.")
            for wish in wishes:
                wish.shown.set_exception(error)
            return
        for wish in wishes:
            wish.shown.set_result(None)

    def _build(self, which: Which) -> None:
        before, self.shown = self._page, None
        with self._server.atomic():
            if before is not None:
                self._dark = before.dark
                # On the loop: a command must not meet a page of which half is gone.
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
