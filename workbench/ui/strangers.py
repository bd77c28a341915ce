"""Connections that have not shown the token yet: how long, how many and how much is taken from them.

A connection costs a task and its buffers before anything is known of it. So it has some seconds to send a whole
request that shows the token, the head of that request has a bound, and there are only so many such connections at
a time. When there are too many the oldest goes, not the one that just came: a browser sends its request with the
first packet, and someone who holds idle sockets must not lock it out. (Chromium holds some itself; it opens others
when they are closed.)

A connection reads little at once for another reason: `websockets` takes all that was read apart before anything
else runs, and a quarter of a megabyte of frames of six bytes holds the event loop for a third of a second.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from typing import Any

from websockets.asyncio.server import Server, ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Response
from websockets.protocol import CONNECTING
from websockets.server import ServerProtocol

from workbench.ui.told_rarely import ToldRarely

PATIENCE = 10.0
"""Seconds until a connection must have shown the token."""
MOST = 64
"""Connections at a time that have not. A browser has about ten to one host."""
LONGEST_HEAD = 64 * 1024
"""Bytes of a request. Cookies of other programs on the same host name come with it, up to 4 kB each."""
READ_AT_ONCE = 16 * 1024

_TOO_LONG = Response(
    431,
    "Request Header Fields Too Large",
    Headers({"Content-Type": "text/plain; charset=utf-8", "Connection": "close"}),
    b"The browser sends more than 64 kB of headers. Delete its cookies for this host name, and open the address again.\n",
).serialize()


class Strangers:
    """All of them, on the event loop that serves them."""

    def __init__(self, told: ToldRarely) -> None:
        self._told = told
        self._waiting: dict[Connection, str] = {}

    def __len__(self) -> int:
        return len(self._waiting)

    def connection(self, protocol: ServerProtocol, server: Server, **options: Any) -> Connection:
        """Makes the connections of a server; for ``create_connection`` of `websockets`."""
        return Connection(self, protocol, server, **options)

    def arrived(self, connection: Connection, peer: str) -> None:
        if len(self._waiting) >= MOST:
            # Of the machine that has the most of them, the one that has waited longest.
            busiest = Counter(self._waiting.values()).most_common(1)[0][0]
            oldest = next(one for one, its_peer in self._waiting.items() if its_peer == busiest)
            self.left(oldest)
            oldest.transport.abort()
            self._told.happened(
                "crowd",
                f"{MOST} connections at a time do not show the token{of_peer(busiest)}; the oldest are closed.",
            )
        self._waiting[connection] = peer

    def left(self, connection: Connection) -> None:
        self._waiting.pop(connection, None)


class Connection(ServerConnection):
    """One connection. It is a stranger until `admit`."""

    def __init__(
        self, strangers: Strangers, protocol: ServerProtocol, server: Server, **options: Any
    ) -> None:
        super().__init__(protocol, server, **options)
        self.peer = ""
        self.admitted = False
        self._strangers = strangers
        self._head_bytes = 0
        self._deadline: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        # asyncio has no public way; 256 kB is what its transports read otherwise.
        transport.max_size = READ_AT_ONCE  # type: ignore[attr-defined]
        address = transport.get_extra_info("peername")
        self.peer = address[0] if isinstance(address, tuple) else ""
        self._deadline = self.loop.call_later(PATIENCE, self.transport.abort)
        self._strangers.arrived(self, self.peer)

    def admit(self) -> None:
        """It has shown the token."""
        self.admitted = True
        self._strangers.left(self)
        if self._deadline is not None:
            self._deadline.cancel()

    def data_received(self, data: bytes) -> None:
        if self.protocol.state is CONNECTING:
            self._head_bytes += len(data)
            if self._head_bytes > LONGEST_HEAD:
                if self.request is None:
                    self.transport.write(_TOO_LONG)
                    self.transport.close()
                else:
                    self.transport.abort()
                return
        super().data_received(data)

    def connection_lost(self, exc: Exception | None) -> None:
        self._strangers.left(self)
        if self._deadline is not None:
            self._deadline.cancel()
        super().connection_lost(exc)


def of_peer(peer: str) -> str:
    """`` (from 10.0.0.7)``, or nothing for a Unix socket, whose peers have no address."""
    return f" (from {peer})" if peer else ""
