"""Which page is on the server: the live env, or the review of recordings.

viser has one page a server, and two sets of panels in it would mean hiding half of everything. So a page is taken
away whole, handles, commands and all, and the other is built in its place; every browser that is open follows. What
a page shows lives elsewhere: the session plays and records on while its page is away, and the review keeps what is
open in it. The bodies in the 3-D view stay (`stage`), and nothing of it is sent before the new page has been drawn
once: controls that say nothing yet, or something else than is so, are never seen.

Swaps are asked for by buttons and keys of the very pages that they take away. So they are done by a thread of their
own, one after the other.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Literal

import viser

from workbench.machine.watched_thread import watched_thread
from workbench.ui.viewpoint import Stage

if TYPE_CHECKING:
    from workbench.ui.page import Page
    from workbench.ui.review_page import ReviewPage

log = logging.getLogger(__name__)

Which = Literal["live", "review"]


class Pages:
    """
    Args:
        server: Of viser, already behind its door.
        stage: The 3-D view that the pages share.
        make: Builds a page on the (empty) server, given which and whether it is to be dark.
    """

    def __init__(
        self, server: viser.ViserServer, stage: Stage, make: Callable[[Which, bool], Page | ReviewPage]
    ) -> None:
        self._server, self._stage, self._make = server, stage, make
        self._wake = threading.Condition()
        self._wish: Which | None = None
        self._shown: Which | None = None
        self._page: Page | ReviewPage | None = None
        self._ending = False
        self._thread = watched_thread("pages", self._serve)

    def start(self, which: Which) -> None:
        """Show the first page; returns when it is there."""
        self._show(which)
        self._thread.start()

    def show(self, which: Which) -> None:
        """Ask for a page. Returns at once, so that a button of the page that goes may ask."""
        with self._wake:
            self._wish = which
            self._wake.notify_all()

    def wait_for(self, which: Which, timeout: float) -> bool:
        """Sleep until that page is there."""
        with self._wake:
            return self._wake.wait_for(lambda: self._shown == which, timeout)

    def stop(self) -> None:
        """Stop the page that is there; it stays as it is until the server closes."""
        with self._wake:
            self._ending = True
            self._wake.notify_all()
        if self._thread.is_alive():
            self._thread.join(timeout=10.0)
        if self._page is not None:
            self._page.stop()

    def _serve(self) -> None:
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._wish is not None or self._ending)
                if self._ending:
                    return
                wish, self._wish = self._wish, None
            if wish is None or wish == self._shown:
                continue
            try:
                self._show(wish)
            except Exception:
                # Nothing would be left that one could press.
                log.exception("The page could not be built.")

    def _show(self, which: Which) -> None:
        dark = self._page.dark if self._page is not None else True
        if self._page is not None:
            self._page.stop()
        with self._server.atomic():
            if self._page is not None:
                # Nothing of the page that went is left: handles, commands, callbacks, nodes.
                self._stage.clear()
                self._server.gui.reset()
            self._page = self._make(which, dark)
            self._page.start()
        self._server.flush()
        with self._wake:
            self._shown = which
            self._wake.notify_all()
