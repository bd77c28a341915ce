"""What a page draws at a time, sent as two batches: its panels, and then its 3-D view.

A browser takes a batch as a whole, and one with anything of the 3-D view in it waits for the next frame of that view,
which may take long. Numbers and buttons need not. And poses that come with nothing else are applied at once.
"""

from __future__ import annotations

from collections.abc import Callable

import viser

from workbench.ui.viser_seam import wait_until_taken

SENT_WITHIN = 0.01
"""Seconds, of the time for a frame, that the view may wait for the panels to be on their way."""


def draw_apart(server: viser.ViserServer, panels: Callable[[], None], scene: Callable[[], None]) -> None:
    """Call both; what each writes goes to the pages together, and apart from the other's."""
    with server.atomic():
        panels()
    server.flush()
    wait_until_taken(server, SENT_WITHIN)
    with server.atomic():
        scene()
    server.flush()
