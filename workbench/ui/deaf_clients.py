"""A client that is connected and reads nothing is let go after a while.

A browser that was stopped, a laptop that fell asleep at the other end of an ``ssh -L``: its connection stays
open for hours and takes nothing. What waits for it is bounded, since viser makes the next batch of messages only
when the last one was taken, and keeps one value for each property. But for as long as it is there it counts as
a page that somebody looks at, for which pictures are rendered, and it keeps viser from forgetting what was
removed (a removal is kept until every client has heard of it). `websockets` would notice by its own ping, which
however waits behind what is unsent, for ever.

So the bytes on their way to each client are looked at, in the connection's own buffer and in the kernel's. If
there are some, and for `PATIENCE` seconds no look finds fewer than the one before, the connection is ended. That
new ones are written meanwhile does not count. A slow line is not a deaf client: it takes some now and then. A page
that wakes up finds its connection closed, opens another, and gets everything as it is by then.
"""

from __future__ import annotations

import asyncio
import fcntl
import logging
import struct
import termios

from websockets.asyncio.server import ServerConnection

PATIENCE = 30.0
"""Seconds. A page that is busy (a large scene that the processor draws) reads nothing for some of them."""
_LOOKS = 30
"""How often in that time the bytes are looked at."""

_log = logging.getLogger("workbench.door")


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
        await asyncio.sleep(PATIENCE / _LOOKS)
        left = unsent(connection)
        # Looks are counted, not seconds: after a machine's sleep no client has had its time.
        silent = 0 if left == 0 or left < before else silent + 1
        before = left
    _log.warning(
        "Closed a browser's connection: it has read nothing for %.0f s. It may come back at any time.",
        PATIENCE,
    )
    connection.transport.abort()
