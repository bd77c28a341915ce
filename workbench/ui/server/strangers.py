"""Connections that have not shown the token yet: how long, how many and how much is taken from them.

A connection costs a task and its buffers before anything is known of it. So it has some seconds to send a whole
request that shows the token, the head of that request has a bound, and there are only so many such connections at
a time. When there are too many the oldest goes, not the one that just came: a browser sends its request with the
first packet, and someone who holds idle sockets must not lock it out. (Chromium holds some itself; it opens others
when they are closed.)

A connection reads little at once for another reason: `websockets` takes all that was read apart before anything
else runs, and a quarter of a megabyte of frames of six bytes holds the event loop for a third of a second.

A client that is connected and reads nothing is let go after a while. A browser that was stopped, a laptop that fell
asleep at the other end of an ``ssh -L``: its connection stays open for hours and takes nothing. What waits for it is bounded, since viser makes the next batch of messages only
when the last one was taken, and keeps one value for each property. But for as long as it is there it counts as
a page that somebody looks at, for which pictures are rendered, and it keeps viser from forgetting what was
removed (a removal is kept until every client has heard of it). `websockets` would notice by its own ping, which
however waits behind what is unsent, for ever.

So the bytes on their way to each client are looked at, in the connection's own buffer and in the kernel's. If
there are some, and for `READ_WITHIN` seconds no look finds fewer than the one before, the connection is ended. That
new ones are written meanwhile does not count. A slow line is not a deaf client: it takes some now and then. A page
that wakes up finds its connection closed, opens another, and gets everything as it is by then.

What they cause in the log is said at once, then rarely, with how often it happened meanwhile.
"""

from __future__ import annotations

import asyncio
import fcntl
import logging
import struct
import termios
import threading
import time
from collections import Counter
from collections.abc import Callable, Hashable
from typing import Any

from websockets.asyncio.server import Server, ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Response
from websockets.protocol import CONNECTING
from websockets.server import ServerProtocol

from workbench.machine.text import short_line

log = logging.getLogger("workbench.door")

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


# --- clients that read nothing -----------------------------------------------------------------------

READ_WITHIN = 30.0
"""Seconds. A page that is busy (a large scene that the processor draws) reads nothing for some of them."""
_LOOKS = 30
"""How often in that time the bytes are looked at."""


def unsent(connection: ServerConnection) -> int:
    """Bytes that were written for this client, and that its machine has not acknowledged."""
    waiting = connection.transport.get_write_buffer_size()
    sock = connection.transport.get_extra_info("socket")
    if sock is None or sock.fileno() < 0:
        return waiting
    # For a socket this is SIOCOUTQ (tcp(7)). Without it a slow line would look deaf: the kernel takes some
    # megabytes at once, and then nothing from us until a third of them has gone.
    (in_kernel,) = struct.unpack("i", fcntl.ioctl(sock.fileno(), termios.TIOCOUTQ, bytes(4)))
    return waiting + in_kernel


async def let_go_when_deaf(connection: ServerConnection) -> None:
    """Runs beside a connection's handler, on its loop; ends the connection, or is cancelled with it."""
    before = silent = 0
    while silent < _LOOKS:
        await asyncio.sleep(READ_WITHIN / _LOOKS)
        left = unsent(connection)
        # Looks are counted, not seconds: after a machine's sleep no client has had its time.
        silent = 0 if left == 0 or left < before else silent + 1
        before = left
    log.warning(
        "Closed a browser's connection: it has read nothing for %.0f s. It may come back at any time.",
        READ_WITHIN,
    )
    connection.transport.abort()


# --- what is said of them ----------------------------------------------------------------------------

PAUSE = 60.0
"""Seconds in which the same thing is said once, at first."""
LONGEST_PAUSE = 3600.0
"""A tab that was left open knocks once a second for as long as it is there."""
MOST_KINDS = 256
LONGEST_LINE = 300
"""Characters of a line."""


class ToldRarely:
    """Says each kind of thing at once, and again after `pause` seconds, twice that, and so on. From any thread.

    Args:
        say: Prints one line.
    """

    def __init__(self, say: Callable[[str], None] = log.warning, pause: float = PAUSE) -> None:
        self._say, self._pause = say, pause
        self._silent_until: dict[Hashable, float] = {}
        self._pauses: dict[Hashable, float] = {}
        self._untold: dict[Hashable, tuple[int, str]] = {}
        """How often, and what was to be said the last time."""
        self._lock = threading.Lock()

    def happened(self, kind: Hashable, sentence: str) -> None:
        """
        Args:
            kind: What counts as the same thing.
            sentence: What is said, with a full stop; controls are shown escaped.
        """
        now = time.monotonic()
        with self._lock:
            if now < self._silent_until.get(kind, 0.0):
                self._untold[kind] = self._untold.get(kind, (0, ""))[0] + 1, sentence
                return
            if len(self._pauses) >= MOST_KINDS:
                rest = self._forget()
            else:
                rest = ()
            pause = self._pauses.get(kind, self._pause)
            self._silent_until[kind] = now + pause
            self._pauses[kind] = min(2 * pause, LONGEST_PAUSE)
            before, _ = self._untold.pop(kind, (0, ""))
        for line in (*rest, _line(sentence, before)):
            self._say(line)

    def say_the_rest(self) -> None:
        """What happened since each was last said: at the end, when nothing further comes that would say it."""
        with self._lock:
            rest = self._forget()
        for line in rest:
            self._say(line)

    def _forget(self) -> tuple[str, ...]:
        rest = tuple(_line(sentence, times) for times, sentence in self._untold.values())
        self._silent_until.clear()
        self._pauses.clear()
        self._untold.clear()
        return rest


def _line(sentence: str, times: int) -> str:
    more = "once more" if times == 1 else f"{times} more times"
    return short_line(sentence, LONGEST_LINE) + (f" ({more} since this was last said.)" if times else "")
