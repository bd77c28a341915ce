"""Emulates a slow connection to a distant page: a loopback relay with a rate limit, a delay and ssh's buffer."""

from __future__ import annotations

import asyncio
import contextlib
import random
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from urllib.parse import urlsplit, urlunsplit

PORTS = range(20_000, 32_000)
"""Below the kernel's ephemeral ports: a page that keeps reconnecting to a port without a listener could be given that very
port as its own, connect to itself, and keep the relay from coming back."""
PIECE_BYTES = 4096
"""Bytes relayed at once; small, so that connections share the line."""


@dataclass
class FarLine:
    """A relay to one port. All connections share the rate limit of each direction; the directions are independent.

    Like ``ssh -L`` it accepts up to `room` bytes a connection at once: a sender sees no delay until some megabytes
    are in flight.
    """

    bits_per_second: float = float("inf")
    """Rate limit of each direction."""
    delay: float = 0.0
    """One-way delay in seconds."""
    room: int = 2 << 20
    """Buffer per connection in bytes: the window of an ssh channel."""
    port: int = 0
    """Port that the browser connects to; 0 takes any free one of `PORTS`."""
    down: int = 0
    """Bytes delivered to the browsers so far."""
    up: int = 0
    """Bytes delivered from the browsers to the server so far."""
    waiting: int = 0
    """Bytes in flight to the browsers."""
    loop: asyncio.AbstractEventLoop = field(init=False)
    ended: asyncio.Event = field(default_factory=asyncio.Event)

    def address(self, url: str) -> str:
        """The URL of the same page through this relay."""
        return urlunsplit(urlsplit(url)._replace(netloc=f"127.0.0.1:{self.port}"))

    async def serve(self, port: int, ready: threading.Event) -> None:
        free_at = {"down": 0.0, "up": 0.0}

        async def carry(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, direction: str) -> None:
            loop = asyncio.get_running_loop()
            pieces: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue()
            queued, drained = 0, asyncio.Event()

            async def deliver() -> None:
                nonlocal queued
                while True:
                    due, piece = await pieces.get()
                    if (left := due - loop.time()) > 0:
                        await asyncio.sleep(left)
                    queued -= len(piece)
                    drained.set()
                    if not piece:
                        writer.close()
                        return
                    if direction == "down":
                        self.down += len(piece)
                        self.waiting -= len(piece)
                    else:
                        self.up += len(piece)
                    writer.write(piece)
                    await writer.drain()

            delivering = asyncio.create_task(deliver())
            try:
                while not delivering.done():
                    piece = await reader.read(PIECE_BYTES)
                    begins = max(loop.time(), free_at[direction])
                    free_at[direction] = begins + 8 * len(piece) / self.bits_per_second
                    queued += len(piece)
                    if direction == "down":
                        self.waiting += len(piece)
                    pieces.put_nowait((free_at[direction] + self.delay, piece))
                    if not piece:
                        break
                    while queued > self.room:
                        drained.clear()
                        await drained.wait()
                await delivering
            except ConnectionError:
                writer.close()
            finally:
                delivering.cancel()
                writer.close()

        async def accept(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            back, out = await asyncio.open_connection("127.0.0.1", port)
            # At the end, asyncio's own callback would print that the task was cancelled.
            with contextlib.suppress(asyncio.CancelledError):
                await asyncio.gather(carry(reader, out, "up"), carry(back, writer, "down"))

        for near in [self.port] if self.port else random.sample(PORTS, 20):
            with contextlib.suppress(OSError):
                server = await asyncio.start_server(accept, "127.0.0.1", near)
                break
        else:
            raise OSError(f"port {near} is taken")
        # Without this the port stays taken until the server is garbage-collected: the end of the loop does not close it.
        with contextlib.closing(server):
            self.port = server.sockets[0].getsockname()[1]
            self.loop = asyncio.get_running_loop()
            ready.set()
            await self.ended.wait()


@contextmanager
def line_to(
    url: str, bits_per_second: float = float("inf"), delay: float = 0.0, port: int = 0
) -> Iterator[FarLine]:
    """A relay to the server at `url`. Leaving the context closes all its connections."""
    line, ready = FarLine(bits_per_second, delay, port=port), threading.Event()
    far_port = urlsplit(url).port
    assert far_port is not None
    thread = threading.Thread(target=lambda: asyncio.run(line.serve(far_port, ready)), daemon=True)
    thread.start()
    assert ready.wait(10.0)
    try:
        yield line
    finally:
        line.loop.call_soon_threadsafe(line.ended.set)
        thread.join(10.0)
