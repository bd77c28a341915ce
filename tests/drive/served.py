"""The page of a single panel for a real browser: a server with the command channel, and a thread that draws."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from workbench.commands import COMMANDS
from workbench.page.door.gated_server import GatedServer, ServerOptions, open_server
from workbench.page.widgets.visitors import PATH, Visitors


@contextmanager
def served() -> Iterator[tuple[GatedServer, Visitors]]:
    """A gated server on a free port, and its visitors; their `do` carries out the commands of its pages."""
    gated_server = open_server(ServerOptions(port=0))
    try:
        visitors = Visitors(gated_server.server, COMMANDS)
        gated_server.add_channel(PATH, visitors.serve)
        yield gated_server, visitors
    finally:
        gated_server.close()


@contextmanager
def redrawn(draw: Callable[[], object], seconds: float) -> Iterator[None]:
    """Call `draw` every so many seconds on a thread."""
    ending = threading.Event()

    def run() -> None:
        while not ending.wait(seconds):
            draw()

    drawing = threading.Thread(target=run, daemon=True)
    drawing.start()
    try:
        yield
    finally:
        ending.set()
        drawing.join()
