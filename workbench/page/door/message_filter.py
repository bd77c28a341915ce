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

MESSAGES_PER_SECOND = 200.0
"""Maximum sustained rate of a page; a drag sends about twenty messages a second."""
BURST_MESSAGES = 400.0
"""Maximum number of messages at once before a page is slowed down."""
MESSAGE_BYTES = 2048
"""Block size: a message counts once, and once more for each full block."""
MAX_SLOWED_SECONDS = 5.0
"""Maximum total wait of a page that sends too fast without a break; then its connection is closed."""
MESSAGES_PER_TURN = 16
"""Number of messages after which the event loop serves the other pages."""


class PageGuard:
    """The message filter of one connection. Used on the connection's event loop.

    Commands use another channel (`widgets/visitors.py`): this one carries the view's camera, clicks in the
    view, gizmos and the palette. A message that no viser page sends closes the connection. A viser message
    that our pages do not use (values of inputs, uploads, messages of the server) is dropped, and so is a
    message with an impossible number. A page that sends faster than a user can is slowed down, so that the
    other pages keep their share of the event loop.
    """

    def __init__(self, is_of_viser: Callable[[str], bool], events_log: RateLimitedLog) -> None:
        """
        Args:
            is_of_viser: whether viser has a message of this kind.
        """
        self._is_of_viser, self._events_log = is_of_viser, events_log
        self._level, self._at = BURST_MESSAGES, time.monotonic()
        self._slowed, self._turns = 0.0, 0

    async def wait_turn(self, size: int) -> None:
        """Wait until the page may send again, after a message of `size` bytes.

        Raises:
            MalformedMessage: The page keeps sending too fast; close the connection.
        """
        now = time.monotonic()
        self._level = (
            min(BURST_MESSAGES, self._level + (now - self._at) * MESSAGES_PER_SECOND)
            - 1
            - size // MESSAGE_BYTES
        )
        self._at, self._turns = now, self._turns + 1
        if self._level >= BURST_MESSAGES / 2:
            self._slowed = 0.0
        if self._level < 0:
            self._slowed -= self._level / MESSAGES_PER_SECOND
            if self._slowed > MAX_SLOWED_SECONDS:
                raise MalformedMessage("too many messages")
            await asyncio.sleep(-self._level / MESSAGES_PER_SECOND)
        elif self._turns % MESSAGES_PER_TURN == 0:
            await asyncio.sleep(0)

    def admits(self, raw: object) -> bool:
        """Whether to pass a frame on to viser; False drops it.

        Raises:
            MalformedMessage: No viser page sends this frame; close the connection.
        """
        kind = kind_of(raw)
        if kind not in KINDS:
            if not self._is_of_viser(kind):
                raise MalformedMessage("a message of an unknown type")
            self._events_log.add(
                kind, f"Dropped a message from a page: the workbench takes no {kind} from pages."
            )
            return False
        assert isinstance(raw, bytes)
        try:
            read_message(raw, kind)
        except ImpossibleValue as error:
            self._events_log.add(kind, f"Dropped a message from a page: {error}, in {kind}.")
            return False
        return True
