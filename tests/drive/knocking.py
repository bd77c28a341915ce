"""A client of the door that sends any request or message over a real socket."""

from __future__ import annotations

import contextlib
import http.client
from collections.abc import Iterator

import msgspec
import pytest
import viser
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.sync.connection import Connection

from tests.drive.tabs import handshake
from tests.drive.waiting import until
from workbench.page.door.access import cookie_name
from workbench.page.door.gated_server import GatedServer

PROTOCOL = f"viser-v{viser.__version__}"
CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (1.0, 2.0, 3.0),
    "fov": 1.0,
    "near": 0.01,
    "far": 100.0,
    "image_height": 100,
    "image_width": 100,
    "look_at": (0.0, 0.0, 0.0),
    "up_direction": (0.0, 0.0, 1.0),
}


def token_of(gated_server: GatedServer) -> str:
    return gated_server.url.partition("token=")[2]


def cookie_of(gated_server: GatedServer) -> str:
    return f"{cookie_name(gated_server.port)}={token_of(gated_server)}"


def ask(
    gated_server: GatedServer, path: str = "/", **headers: str | None
) -> tuple[int, http.client.HTTPMessage, bytes]:
    """Send one HTTP request. ``headers``: Host, Cookie and so on, with _ for -; None omits one. By default the right
    Host and cookie are sent."""
    fields: dict[str, str | None] = {
        "Host": f"127.0.0.1:{gated_server.port}",
        "Cookie": cookie_of(gated_server),
    }
    fields.update({name.replace("_", "-"): value for name, value in headers.items()})
    connection = http.client.HTTPConnection("127.0.0.1", gated_server.port, timeout=20)
    try:
        connection.putrequest("GET", path, skip_host=True, skip_accept_encoding=True)
        for name, value in fields.items():
            if value is not None:
                connection.putheader(name, value)
        connection.endheaders()
        response = connection.getresponse()
        # The body of a 101 is the open websocket.
        return response.status, response.headers, b"" if response.status == 101 else response.read()
    finally:
        connection.close()


def knock(gated_server: GatedServer, **headers: str | None) -> int:
    """Status of a websocket handshake: 101 is accepted."""
    handshake: dict[str, str | None] = {
        "Upgrade": "websocket",
        "Connection": "Upgrade",
        "Sec_WebSocket_Key": "dGhlIHNhbXBsZSBub25jZQ==",
        "Sec_WebSocket_Version": "13",
        "Sec_WebSocket_Protocol": PROTOCOL,
        "Origin": f"http://127.0.0.1:{gated_server.port}",
    }
    return ask(gated_server, "/", **{**handshake, **headers})[0]


def both(gated_server: GatedServer, **headers: str | None) -> tuple[int, int]:
    """Status of a page load and of a websocket handshake."""
    return ask(gated_server, "/", **headers)[0], knock(gated_server, **headers)


@contextlib.contextmanager
def client(gated_server: GatedServer) -> Iterator[Connection]:
    """An authenticated client that viser counts as connected; incoming messages are discarded."""
    known = set(gated_server.server.get_clients())
    address, options = handshake(gated_server.url)
    with connect(address, close_timeout=0.2, **options) as connection:
        say(connection, CAMERA)
        until(lambda: set(gated_server.server.get_clients()) - known, "the client")
        yield connection


def say(connection: Connection, message: object) -> None:
    connection.send(msgspec.msgpack.encode(message))


class Bell:
    """A palette command used as a barrier: when it runs, the server has handled all earlier messages of that page."""

    def __init__(self, gated_server: GatedServer) -> None:
        self.rung = 0
        self._handle = gated_server.server.gui.add_command("bell")

        async def ring(_: object) -> None:
            self.rung += 1

        self._handle.on_trigger(ring)

    @property
    def message(self) -> dict[str, str]:
        return {"type": "CommandTriggerMessage", "uuid": self._handle._impl.uuid}

    def rings(self, connection: Connection) -> None:
        before = self.rung
        say(connection, self.message)
        until(lambda: self.rung > before, "the bell")

    def remove(self) -> None:
        self._handle.remove()


def close_code(connection: Connection) -> int:
    """Read until the server hangs up."""
    with pytest.raises(ConnectionClosed) as closed:
        while True:
            connection.recv(timeout=30)
    assert closed.value.rcvd is not None
    return closed.value.rcvd.code
