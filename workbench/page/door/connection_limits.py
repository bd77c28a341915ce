"""Limits for connections without a token, detection of stalled clients, and rate-limited log lines about both."""

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

TOKEN_TIMEOUT_SECONDS = 10.0
"""Timeout for a connection to present the token."""
MAX_WITHOUT_TOKEN = 64
"""Maximum number of simultaneous connections without a token. A browser opens about ten connections to one
host."""
MAX_HEAD_BYTES = 64 * 1024
"""Maximum size of a request's head. The head carries cookies of other programs on the same host name, up to 4 kB each."""
READ_BYTES = 16 * 1024
"""Maximum size of one read. `websockets` parses all bytes of a read before anything else runs: 256 kB of
six-byte frames block the event loop for a third of a second."""

_TOO_LONG = Response(
    431,
    "Request Header Fields Too Large",
    Headers({"Content-Type": "text/plain; charset=utf-8", "Connection": "close"}),
    b"The browser sends more than 64 kB of headers. Delete its cookies for this host name, and open the address again.\n",
).serialize()


class ConnectionLimits:
    """All connections that have not presented the token yet. Used on their event loop.

    A connection uses a task and buffers before its client has presented the token. Until then, its duration, the
    size of its headers and the number of such connections are limited. If there are too many, the peer with the
    most connections loses its oldest one. The newest stays: a browser sends its request with the first packet, and idle sockets of an attacker must not lock the browser out. (Chromium itself
    holds some idle sockets, and opens new ones when these are closed.)
    """

    def __init__(self, events_log: RateLimitedLog) -> None:
        self._events_log = events_log
        self._waiting: dict[Connection, str] = {}

    def __len__(self) -> int:
        return len(self._waiting)

    def connection(self, protocol: ServerProtocol, server: Server, **options: Any) -> Connection:
        """Make a connection of a server; for ``create_connection`` of `websockets`."""
        return Connection(self, protocol, server, **options)

    def arrived(self, connection: Connection, peer: str) -> None:
        if len(self._waiting) >= MAX_WITHOUT_TOKEN:
            # Close the oldest connection of the peer that has the most.
            busiest = Counter(self._waiting.values()).most_common(1)[0][0]
            oldest = next(one for one, its_peer in self._waiting.items() if its_peer == busiest)
            self.left(oldest)
            oldest.transport.abort()
            self._events_log.add(
                "crowd",
                f"{MAX_WITHOUT_TOKEN} connections are open without the token{of_peer(busiest)}; the oldest are closed.",
            )
        self._waiting[connection] = peer

    def left(self, connection: Connection) -> None:
        self._waiting.pop(connection, None)


class Connection(ServerConnection):
    """One connection. Its limits apply until `admit`."""

    def __init__(
        self, strangers: ConnectionLimits, protocol: ServerProtocol, server: Server, **options: Any
    ) -> None:
        super().__init__(protocol, server, **options)
        self.peer = ""
        self.admitted = False
        self._strangers = strangers
        self._head_bytes = 0
        self._deadline: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        # asyncio has no public way to set this; its default is 256 kB.
        transport.max_size = READ_BYTES  # type: ignore[attr-defined]
        address = transport.get_extra_info("peername")
        self.peer = address[0] if isinstance(address, tuple) else ""
        self._deadline = self.loop.call_later(TOKEN_TIMEOUT_SECONDS, self.transport.abort)
        self._strangers.arrived(self, self.peer)

    def admit(self) -> None:
        """Lift the limits, because the connection has presented the token."""
        self.admitted = True
        self._strangers.left(self)
        if self._deadline is not None:
            self._deadline.cancel()

    def data_received(self, data: bytes) -> None:
        if self.protocol.state is CONNECTING:
            self._head_bytes += len(data)
            if self._head_bytes > MAX_HEAD_BYTES:
                # After an invalid head `websockets` has closed its side, and nothing can be written.
                if self.request is None and self.protocol.handshake_exc is None:
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
    """The client's address for a message, `` (from 10.0.0.7)``; empty for a Unix socket, whose peers have no
    address."""
    return f" (from {peer})" if peer else ""


# --- stalled clients ---------------------------------------------------------------------------------

READ_TIMEOUT_SECONDS = 30.0
"""Timeout for a client to read something. A busy page (a large scene rendered in software) reads nothing for some
seconds."""
_CHECKS = 30
"""Number of checks of the unsent bytes in `READ_TIMEOUT_SECONDS`."""


def unsent(connection: ServerConnection) -> int:
    """Bytes that were written for this client and that the client's machine has not acknowledged."""
    waiting = connection.transport.get_write_buffer_size()
    sock = connection.transport.get_extra_info("socket")
    if sock is None or sock.fileno() < 0:
        return waiting
    # For a socket, TIOCOUTQ is SIOCOUTQ (tcp(7)). Without these bytes a slow connection would look stalled:
    # the kernel accepts some megabytes at once, and then nothing until a third of them has been sent.
    (in_kernel,) = struct.unpack("i", fcntl.ioctl(sock.fileno(), termios.TIOCOUTQ, bytes(4)))
    return waiting + in_kernel


async def close_when_stalled(
    connection: ServerConnection, events_log: RateLimitedLog, unanswered: Callable[[], int] = lambda: 0
) -> None:
    """Close the connection when its client has read nothing for `READ_TIMEOUT_SECONDS`. Run it as a task of the connection.

    A suspended browser or a sleeping laptop behind ``ssh -L`` keeps its connection open for hours. The data
    queued for it is bounded, but pictures are rendered for it as for any open page, and viser stores every
    removal until each client has read it. The ping of `websockets` would wait behind the unsent bytes.

    The client counts as stalled if bytes are queued and, for `READ_TIMEOUT_SECONDS`, no check finds fewer
    bytes than the check before it. Bytes that are written meanwhile do not restart this time. A client that
    is merely slow reads some bytes from time to time, so it does not count as stalled. A page that wakes up
    reconnects and gets the present state.

    Args:
        unanswered: Returns the bytes that the page has not acknowledged, see `PageConnection.unanswered`.
    """
    before = silent = 0
    while silent < _CHECKS:
        await asyncio.sleep(READ_TIMEOUT_SECONDS / _CHECKS)
        left = unsent(connection) + unanswered()
        # Count checks, not seconds: while this machine sleeps no client can read.
        silent = 0 if left == 0 or left < before else silent + 1
        before = left
    events_log.add(
        "stalled",
        f"Closed the connection of a browser that has read nothing for {READ_TIMEOUT_SECONDS:.0f} s. "
        "The browser may reconnect.",
    )
    connection.transport.abort()


# --- log lines about events that clients cause -------------------------------------------------------

PAUSE_SECONDS = 60.0
"""Initial pause between two lines of the same kind."""
MAX_PAUSE_SECONDS = 3600.0
"""Maximum pause between two lines of the same kind. A tab that was left open reconnects once a second."""
MAX_KINDS = 256
MAX_LINE_CHARACTERS = 300


class RateLimitedLog:
    """Logs the first event of each kind at once. The next line of that kind is logged only after `pause`
    seconds, and the pause doubles with each line. Thread-safe.

    Args:
        print_line: prints one line.
        pause: Seconds of the first pause.
    """

    def __init__(self, print_line: Callable[[str], None] = log.warning, pause: float = PAUSE_SECONDS) -> None:
        self._print_line, self._pause = print_line, pause
        self._silent_until: dict[Hashable, float] = {}
        self._pauses: dict[Hashable, float] = {}
        self._held_back: dict[Hashable, tuple[int, str]] = {}
        """Number of lines held back, and the last of these lines, by kind."""
        self._lock = threading.Lock()

    def add(self, kind: Hashable, sentence: str, error: BaseException | None = None) -> None:
        """Log an event, or count it if its kind was logged recently.

        Args:
            kind: Events with equal kinds share one pause.
            sentence: The line, with a full stop; control characters are shown escaped.
            error: Logged with its traceback if the line is logged.
        """
        now = time.monotonic()
        with self._lock:
            if now < self._silent_until.get(kind, 0.0):
                self._held_back[kind] = self._held_back.get(kind, (0, ""))[0] + 1, sentence
                return
            if len(self._pauses) >= MAX_KINDS:
                rest = self._forget()
            else:
                rest = ()
            pause = self._pauses.get(kind, self._pause)
            self._silent_until[kind] = now + pause
            self._pauses[kind] = min(2 * pause, MAX_PAUSE_SECONDS)
            before, _ = self._held_back.pop(kind, (0, ""))
        for line in rest:
            self._print_line(line)
        if error is None:
            self._print_line(_line(sentence, before))
        else:
            log.error("%s", _line(sentence, before), exc_info=error)

    def flush(self) -> None:
        """Log all lines that were held back; for the end of the program."""
        with self._lock:
            rest = self._forget()
        for line in rest:
            self._print_line(line)

    def _forget(self) -> tuple[str, ...]:
        """Reset all kinds; returns the lines that were held back."""
        rest = tuple(_line(sentence, times) for times, sentence in self._held_back.values())
        self._silent_until.clear()
        self._pauses.clear()
        self._held_back.clear()
        return rest


def _line(sentence: str, times: int) -> str:
    more = "once more" if times == 1 else f"{times} more times"
    return short_line(sentence, MAX_LINE_CHARACTERS) + (f" ({more} since the last message.)" if times else "")
