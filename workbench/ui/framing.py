"""Pointing the open pages at what is shown, and leaving them alone once a person has moved the view.

A page says how wide and high its view is only some moments after it has come. So it is first framed for the usual
shape, and again when its own is known, unless somebody moved it meanwhile.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import viser

from workbench.ui.viewpoint import USUAL_ASPECT, USUAL_HEIGHT, Viewpoint

SETTLES = 4.0
"""Seconds after a page has come in which its panels may still take their places."""

Frame = Callable[[float, float], Viewpoint]
"""Gives the viewpoint for a view of this aspect (width over height) and height in pixels."""


class Framing:
    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._arrivals: dict[int, float] = {}
        self._pointed: dict[int, tuple[np.ndarray, float]] = {}
        self._framed: object = None

    def is_new(self, what: object) -> bool:
        """Whether this is something else than was asked about last: then it is to be framed anew."""
        new, self._framed = what != self._framed, what
        return new

    def follow(self) -> int:
        """Note which pages are open, and return how many."""
        clients = self._server.get_clients()
        if clients.keys() != self._arrivals.keys():
            now = time.monotonic()
            self._arrivals = {number: self._arrivals.get(number, now) for number in clients}
            self._pointed = {number: at for number, at in self._pointed.items() if number in clients}
        return len(clients)

    @property
    def pointed(self) -> frozenset[int]:
        """The open pages that were pointed at something."""
        return frozenset(self._pointed)

    @property
    def followed(self) -> frozenset[int]:
        """The open pages, as they were at the last look."""
        return frozenset(self._arrivals)

    def frame(self, frame: Frame, untouched_only: bool = False) -> None:
        """Point every open page (or those whose view nobody has moved), and those to come."""
        usual = frame(USUAL_ASPECT, USUAL_HEIGHT)
        self._server.initial_camera.position = usual.position
        self._server.initial_camera.look_at = usual.look_at
        for client in self._server.get_clients().values():
            if not untouched_only or self._is_untouched(client):
                self._point(client, frame)

    def frame_arrivals(self, frame: Frame) -> None:
        """Frame anew what has just come and turns out to have another shape than it was framed for."""
        for number, client in self._server.get_clients().items():
            if time.monotonic() - self._arrivals.get(number, 0.0) > SETTLES:
                continue
            _, aspect = self._pointed.get(number, (None, USUAL_ASPECT))
            # If it looks from somewhere else, it lost its connection and came back, or the person was quicker.
            if self._is_untouched(client) and abs(aspect_of(client) / aspect - 1) > 0.05:
                self._point(client, frame)

    def _is_untouched(self, client: viser.ClientHandle) -> bool:
        """True while the page looks from where it was last pointed."""
        pointed = self._pointed.get(client.client_id)
        usual = self._server.initial_camera.position if pointed is None else pointed[0]
        return np.allclose(client.camera.position, usual, atol=0.02)

    def _point(self, client: viser.ClientHandle, frame: Frame) -> None:
        viewpoint = frame(aspect_of(client), client.camera.image_height or USUAL_HEIGHT)
        client.camera.position = viewpoint.position
        client.camera.look_at = viewpoint.look_at
        # After it is: who waits for it may close the page, and viser warns of what is written to a page that has gone.
        self._pointed[client.client_id] = (viewpoint.position, aspect_of(client))


def aspect_of(client: viser.ClientHandle) -> float:
    """Width over height of the view in this page."""
    camera = client.camera
    if not camera.image_height or not camera.image_width:
        return USUAL_ASPECT
    return camera.image_width / camera.image_height
