"""Tabs without a browser: they connect as viser's page does, read every byte and discard it.

Two cores cannot run twenty Chromium pages. To the server these look the same: the handshake with cookie and
subprotocol, and the first camera message (before it viser does not count a client as connected).
"""

from __future__ import annotations

import asyncio
import json
import re
import socket
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import parse_qs, urlsplit

import msgspec
import viser
import viser._messages
import websockets.asyncio.client
import websockets.exceptions
import websockets.sync.client
import zstandard
from websockets.sync.connection import Connection
from websockets.typing import Subprotocol

from workbench.page.command import Command
from workbench.page.door.access import cookie_name
from workbench.page.widgets.visitors import PATH


def handshake(url: str) -> tuple[str, dict[str, Any]]:
    """Address and arguments for a `websockets` client of the page at the printed `url`."""
    split = urlsplit(url)
    token = parse_qs(split.query).get("token", [""])[0]
    return f"ws://{split.netloc}/", {
        "origin": f"http://{split.netloc}",
        "additional_headers": {"Cookie": f"{cookie_name(split.port or 80)}={token}"},
        "subprotocols": [Subprotocol(f"viser-v{viser.__version__}")],
        "compression": None,
        "max_size": None,
    }


def open_channel(url: str, page: str, more: str = "") -> Connection:
    """The command channel of the page with this name; `more` is added to its address."""
    address, options = handshake(url)
    del options["subprotocols"]
    path = f"{address.rstrip('/')}{PATH}?page={page}{more}"
    return websockets.sync.client.connect(path, proxy=None, **options)


def camera_message(position: Sequence[float] = (3.0, 3.0, 3.0), width: int = 800, fov: float = 0.8) -> bytes:
    """The message that a page sends after its first frame: its viewpoint and the size of its view."""
    message = viser._messages.ViewerCameraMessage(
        wxyz=(1.0, 0.0, 0.0, 0.0),
        position=(position[0], position[1], position[2]),
        fov=fov,
        near=0.05,
        far=300.0,
        image_height=720,
        image_width=width,
        look_at=(0.0, 0.0, 0.0),
        up_direction=(0.0, 0.0, 1.0),
    )
    return msgspec.msgpack.encode(message.as_serializable_dict())


def messages_in(frame: bytes) -> list[dict[str, Any]]:
    """The messages of one batch from the server, arrays left out."""
    size = int.from_bytes(frame[8:16], "little")
    return msgspec.msgpack.decode(zstandard.decompress(frame[16 : 16 + size]))["messages"]


@dataclass
class Tab:
    """What one tab has received so far."""

    frames: int = 0
    megabytes: float = 0.0
    open: bool = False
    """Whether the tab is connected and has received the full page state."""
    commands: dict[str, str] = field(default_factory=dict)
    """Id of each palette command, by label."""
    name: str = ""
    """Name of the page, which it sends with commands."""


class Tabs:
    """Any number of tabs on one thread."""

    def __init__(self, url: str) -> None:
        self._url = url
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="tabs", daemon=True)
        self._thread.start()
        self._tasks: dict[int, asyncio.Task[None]] = {}
        self._connections: dict[int, websockets.asyncio.client.ClientConnection] = {}

    def open(self, position: Sequence[float] = (3.0, 3.0, 3.0)) -> Tab:
        """Open a tab that looks from `position`; its messages are read until `close`."""
        tab = Tab()

        async def begin() -> None:
            self._tasks[id(tab)] = asyncio.create_task(self._read(tab, camera_message(position)))

        asyncio.run_coroutine_threadsafe(begin(), self._loop).result()
        return tab

    def close(self, tab: Tab) -> None:
        """Close the tab as a browser does; return when it is closed."""
        task = self._tasks.pop(id(tab))

        async def end() -> None:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)

        asyncio.run_coroutine_threadsafe(end(), self._loop).result(timeout=30)

    def trigger(self, tab: Tab, label: str) -> None:
        """Trigger this command of the page, as its key or the palette does."""
        message = viser._messages.CommandTriggerMessage(tab.commands[label])
        sending = self._connections[id(tab)].send(msgspec.msgpack.encode(message.as_serializable_dict()))
        asyncio.run_coroutine_threadsafe(sending, self._loop).result(timeout=30)

    def do(self, tab: Tab, command: Command) -> dict[str, Any]:
        """Send this command; return the reply."""
        with open_channel(self._url, tab.name) as channel:
            channel.send(json.dumps({"n": 1, "do": command.encode()}))
            return json.loads(channel.recv(60))

    def stop(self) -> None:
        """Close all open tabs."""

        async def end() -> None:
            for task in self._tasks.values():
                task.cancel()
            await asyncio.gather(*self._tasks.values(), return_exceptions=True)

        asyncio.run_coroutine_threadsafe(end(), self._loop).result(timeout=30)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    async def _read(self, tab: Tab, greeting: bytes) -> None:
        address, options = handshake(self._url)
        try:
            async with websockets.asyncio.client.connect(address, **options) as connection:
                await connection.send(greeting)
                self._connections[id(tab)] = connection
                async for frame in connection:
                    assert isinstance(frame, bytes)
                    tab.frames += 1
                    tab.megabytes += len(frame) / 2**20
                    for message in [] if tab.open and tab.name else messages_in(frame):
                        if message["type"] == "GuiHtmlMessage" and not tab.name:
                            found = re.search('data-page="([^"]+)"', message["props"]["content"])
                            tab.name = found[1] if found else ""
                        if message["type"] == "RegisterCommandMessage":
                            tab.commands[message["props"]["label"]] = message["uuid"]
                        tab.open = tab.open or message["type"] == "ReplayDoneMessage"
        except websockets.exceptions.ConnectionClosed:
            pass
        finally:
            tab.open = False
            self._connections.pop(id(tab), None)


@contextmanager
def tabs_of(url: str) -> Iterator[Tabs]:
    tabs = Tabs(url)
    try:
        yield tabs
    finally:
        tabs.stop()


def open_deaf_tab(url: str) -> Connection:
    """A tab that connects, sends its camera message, and then reads nothing."""
    address, options = handshake(url)
    split = urlsplit(address)
    assert split.hostname is not None and split.port is not None
    small = socket.socket()
    small.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    small.connect((split.hostname, split.port))
    # One frame fills the queue; then the library stops reading the socket, including pings.
    connection = websockets.sync.client.connect(
        address, sock=small, max_queue=1, ping_interval=None, close_timeout=0.1, **options
    )
    connection.send(camera_message())
    return connection
