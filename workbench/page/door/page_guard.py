"""Filters the messages of a page before viser sees them, and limits their rate."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable

from workbench.page.door.client_messages import (
    KINDS,
    ImpossibleValue,
    MalformedMessage,
    kind_of,
    read_message,
)
from workbench.page.door.connection_limits import RateLimitedLog

RATE = 200.0
"""Maximum sustained rate of a page in messages a second; a drag sends about twenty."""
BURST = 400.0
BYTES_EACH = 2048
"""A message counts once for each block of this many bytes."""
PATIENCE = 5.0
"""Maximum time in seconds that a page is slowed down without a pause; then its connection is closed."""
TURN = 16
"""Number of messages after which the event loop serves the other pages."""


class PageGuard:
    """The filter of one connection, on its event loop.

    What a person asks for goes another way (`widgets/visitors.py`): here come the camera of the view, clicks in it, gizmos and
    the palette. A message that no page of viser's sends closes the connection. One that is viser's and not for a page of ours
    (values of inputs, uploads, what only the server sends) is dropped, and so is one with an impossible number. A page that
    sends faster than a page can is slowed down, so that the others keep their share of the event loop.
    """

    def __init__(self, is_of_viser: Callable[[str], bool], told: RateLimitedLog) -> None:
        """
        Args:
            is_of_viser: whether viser has a message of this kind.
        """
        self._is_of_viser, self._told = is_of_viser, told
        self._level, self._at = BURST, time.monotonic()
        self._slowed, self._turns = 0.0, 0

    async def wait_turn(self, size: int) -> None:
        """Wait until the page may speak again, after a message of `size` bytes.

        Raises:
            MalformedMessage: It keeps sending too fast; close the connection.
        """
        now = time.monotonic()
        self._level = min(BURST, self._level + (now - self._at) * RATE) - 1 - size // BYTES_EACH
        self._at, self._turns = now, self._turns + 1
        if self._level >= BURST / 2:
            self._slowed = 0.0
        if self._level < 0:
            self._slowed -= self._level / RATE
            if self._slowed > PATIENCE:
                raise MalformedMessage("too many messages")
            await asyncio.sleep(-self._level / RATE)
        elif self._turns % TURN == 0:
            await asyncio.sleep(0)

    def admits(self, raw: object) -> bool:
        """Whether a frame is passed on to viser; False drops it.

        Raises:
            MalformedMessage: Close the connection.
        """
        kind = kind_of(raw)
        if kind not in KINDS:
            if not self._is_of_viser(kind):
                raise MalformedMessage("an unknown type")
            self._told.happened(kind, f"Dropped a message from a page: {kind} is not for pages to send.")
            return False
        assert isinstance(raw, bytes)
        try:
            read_message(raw, kind)
        except ImpossibleValue as error:
            self._told.happened(kind, f"Dropped a message from a page: {error}, in {kind}.")
            return False
        return True
