"""A slow client is not a deaf one: real sockets with small kernel buffers."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Awaitable, Callable
from types import SimpleNamespace
from typing import cast

import pytest
from websockets.asyncio.client import ClientConnection, connect
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed

from workbench.page.door import connection_limits as strangers

pytestmark = pytest.mark.thorough

MESSAGE = b"x" * 2**20


def unsent_bytes(client: Callable[[ClientConnection], Awaitable[None]]) -> int | None:
    """Serve one message to this client; return its unsent bytes when the server is done."""

    async def both() -> int | None:
        ended: asyncio.Future[int | None] = asyncio.get_running_loop().create_future()

        async def handler(connection: ServerConnection) -> None:
            watch = asyncio.create_task(strangers.close_when_stalled(connection, strangers.RateLimitedLog()))
            try:
                await connection.send(MESSAGE)
                await connection.recv()
                ended.set_result(strangers.unsent(connection))
            except ConnectionClosed:
                ended.set_result(None)
            finally:
                watch.cancel()

        listening = socket.create_server(("127.0.0.1", 0))
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
        async with serve(handler, sock=listening, compression=None):
            small = socket.socket()
            small.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            small.connect(listening.getsockname())
            address = f"ws://127.0.0.1:{listening.getsockname()[1]}"
            async with connect(address, sock=small, compression=None, close_timeout=0.1) as connection:
                await client(connection)
                return await ended

    return asyncio.run(asyncio.wait_for(both(), 60))


@pytest.fixture(autouse=True)
def short_timeout(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(strangers, "READ_TIMEOUT_SECONDS", 1.0)


@pytest.mark.slow
def test_a_slow_reader_gets_the_whole_message() -> None:
    async def read_a_little_now_and_then(connection: ClientConnection) -> None:
        took = asyncio.create_task(connection.recv())
        for _ in range(15):  # three times the timeout of a client that reads nothing
            connection.transport.pause_reading()
            await asyncio.sleep(0.2)
            assert not took.done(), "the client is not slow enough"
            connection.transport.resume_reading()
            await asyncio.sleep(0)
            await asyncio.sleep(0)
        assert await took == MESSAGE
        await connection.send("thanks")

    assert unsent_bytes(read_a_little_now_and_then) == 0


def test_a_client_with_nothing_to_read_is_not_deaf() -> None:
    async def wait(connection: ClientConnection) -> None:
        assert await connection.recv() == MESSAGE
        await asyncio.sleep(2.0)
        await connection.send("thanks")

    assert unsent_bytes(wait) == 0


class Checked(Exception):
    """Every scripted check was made."""


def checks_until_closed(sizes: list[int]) -> int | None:
    """After how many checks a client with these unsent bytes is closed; None if it stays open."""
    left, aborted = iter(sizes), []

    def unsent() -> int:
        for size in left:
            return size
        raise Checked

    transport = SimpleNamespace(
        get_write_buffer_size=unsent, get_extra_info=lambda name: None, abort=lambda: aborted.append(1)
    )
    connection = cast(ServerConnection, SimpleNamespace(transport=transport))
    try:
        asyncio.run(strangers.close_when_stalled(connection, strangers.RateLimitedLog(lambda line: None)))
    except Checked:
        return None
    assert aborted == [1]
    return len(sizes) - len([*left])


@pytest.mark.parametrize(
    ("sizes", "closed"),
    [
        ([0] * 100, None),
        ([9] * 100, 30),
        ([*range(1, 101)], 30),
        ([9 - n // 20 for n in range(100)], None),
        ([9] * 25 + [0] + [9] * 25, None),
        ([9] * 25 + [8] + [8] * 40, 55),
    ],
)
def test_only_a_client_that_reads_nothing_for_the_whole_time_is_closed(
    monkeypatch: pytest.MonkeyPatch, sizes: list[int], closed: int | None
) -> None:
    monkeypatch.setattr(strangers, "READ_TIMEOUT_SECONDS", 0.0)
    found = checks_until_closed(sizes)
    assert found is None if closed is None else found is not None and abs(found - closed) <= 1
