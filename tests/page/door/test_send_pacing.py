"""The connection to a page: real sockets, through a relay with limited rate and delay."""

from __future__ import annotations

import asyncio
import os
import threading
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass

import numpy as np
import pytest
from websockets.asyncio.client import connect
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed

from tests.drive.far_line import FarLine, line_to
from tests.drive.tabs import camera_message, handshake, messages_in
from tests.drive.waiting import until
from workbench.page.door.gated_server import GatedServer
from workbench.page.door.send_pacing import CompressWhenFar, PageConnection, WhenFar

pytestmark = pytest.mark.thorough

BITS_PER_SECOND, DELAY_SECONDS = 2e6, 0.04
"""A slow line: 250 kB/s, 80 ms round trip."""


@dataclass
class Seen:
    most_waiting: int = 0
    received: int = 0
    messages: int = 0


def transfer(
    server_side: Callable[[ServerConnection], Awaitable[None]], bits: float = float("inf"), delay: float = 0.0
) -> tuple[FarLine, Seen]:
    """Run `server_side` and receive what it sends with a client behind this relay."""
    seen = Seen()

    async def both() -> FarLine:
        spoken: asyncio.Future[None] = asyncio.get_running_loop().create_future()

        async def handler(connection: ServerConnection) -> None:
            try:
                await server_side(connection)
                spoken.set_result(None)
            except Exception as error:
                spoken.set_exception(error)

        async with serve(handler, "127.0.0.1", 0, compression=None, extensions=[CompressWhenFar()]) as server:
            port = server.sockets[0].getsockname()[1]
            with line_to(f"ws://127.0.0.1:{port}", bits, delay) as line:

                async def watch() -> None:
                    while True:
                        seen.most_waiting = max(seen.most_waiting, line.waiting)
                        await asyncio.sleep(0.005)

                watching = asyncio.create_task(watch())
                async with connect(line.address(f"ws://127.0.0.1:{port}")) as client:
                    async for message in client:
                        seen.received += len(message)
                        seen.messages += 1
                watching.cancel()
                await spoken
        return line

    return asyncio.run(asyncio.wait_for(both(), 60)), seen


Send = Callable[[bytes], Awaitable[None]]


async def send_all(send: Send, size: int, count: int) -> None:
    for _ in range(count):
        await send(os.urandom(size))


def test_repeated_messages_to_a_distant_page_are_compressed() -> None:
    same = os.urandom(8000)

    async def repeat(connection: ServerConnection) -> None:
        line = PageConnection(connection)
        for _ in range(10):
            await line.send(same)
        async with asyncio.timeout(20):
            while line.unanswered:
                await asyncio.sleep(0.01)

    far, seen = transfer(repeat, delay=0.02)
    assert seen.received == 80_000 and far.down < 20_000


def test_compression_may_start_and_stop_at_any_message() -> None:
    same = os.urandom(8000)

    async def repeat(connection: ServerConnection) -> None:
        deflate = next(e for e in connection.protocol.extensions if isinstance(e, WhenFar))
        for number in range(12):
            deflate.on = number % 4 > 1
            await connection.send(same)

    far, seen = transfer(repeat)
    assert seen.received == 12 * 8000 and 7 * 8000 < far.down < 9 * 8000


def test_a_message_to_a_page_that_disconnects_is_not_awaited() -> None:
    async def talk_to_one_that_leaves() -> None:
        ended: asyncio.Future[None] = asyncio.get_running_loop().create_future()

        async def handler(connection: ServerConnection) -> None:
            line = PageConnection(connection)
            try:
                with pytest.raises(ConnectionClosed):
                    await send_all(line.send, 50_000, 1000)
                ended.set_result(None)
            except BaseException as error:
                ended.set_exception(error)

        async with serve(handler, "127.0.0.1", 0, compression=None) as server:
            port = server.sockets[0].getsockname()[1]
            with line_to(f"ws://127.0.0.1:{port}", BITS_PER_SECOND, DELAY_SECONDS) as line:
                client = await connect(line.address(f"ws://127.0.0.1:{port}"))
                await client.recv()
                client.transport.abort()
                await ended

    asyncio.run(asyncio.wait_for(talk_to_one_that_leaves(), 60))


@pytest.mark.slow
def test_a_page_on_a_slow_line_gets_the_newest_state_without_a_queue(gated_server: GatedServer) -> None:
    """The real server: 60 changes a second are four times the capacity of the line."""
    server = gated_server.server
    rng = np.random.default_rng(0)
    colours = np.zeros((1500, 3), np.uint8)
    points = server.scene.add_point_cloud("/points", rng.normal(size=(1500, 3)), colours)
    text = server.gui.add_text("newest", "0")
    newest, most = "0", 0

    async def read(line: FarLine) -> None:
        nonlocal newest
        address, options = handshake(line.address(gated_server.url))
        async with connect(address, **options) as client:
            await client.send(camera_message())
            async for frame in client:
                assert isinstance(frame, bytes)
                for message in messages_in(frame):
                    if message["type"] == "GuiUpdateMessage" and "value" in message["updates"]:
                        newest = message["updates"]["value"]
                if newest == "120":
                    return

    with line_to(gated_server.url, BITS_PER_SECOND, DELAY_SECONDS) as line:
        reading = threading.Thread(target=lambda: asyncio.run(asyncio.wait_for(read(line), 60)))
        reading.start()
        until(lambda: line.down > 0 and len(server.get_clients()) == 1, "the page")
        for number in range(1, 121):
            points.points = rng.normal(size=(1500, 3)).astype(np.float32)
            text.value = str(number)
            time.sleep(1 / 60)
            most = max(most, line.waiting)
        reading.join()
    assert newest == "120"
    assert most < 250_000, "one second of the line's capacity"


def test_a_message_that_decompresses_to_megabytes_ends_the_connection(gated_server: GatedServer) -> None:
    async def send() -> int | None:
        address, options = handshake(gated_server.url)
        async with connect(address, **{**options, "compression": "deflate"}) as client:
            await client.send(camera_message())
            await client.send(bytes(50 << 20))
            await client.wait_closed()
            return client.close_code

    assert asyncio.run(asyncio.wait_for(send(), 60)) == 1009
