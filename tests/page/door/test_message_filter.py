"""Messages of a page to viser: invalid numbers and floods reach neither viser nor other pages."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from types import SimpleNamespace

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.connection import Connection

from tests.drive.knocking import CAMERA, Bell, client, close_code, say
from tests.drive.tabs import messages_in
from tests.drive.waiting import until
from workbench.page.door import message_filter
from workbench.page.door.client_messages import MalformedMessage
from workbench.page.door.connection_limits import RateLimitedLog
from workbench.page.door.gated_server import GatedServer, ServerOptions, open_server

pytestmark = pytest.mark.thorough


@pytest.fixture(scope="module")
def gated_server() -> Iterator[GatedServer]:
    """One server for all tests of this file."""
    with closing(open_server(ServerOptions(port=0))) as gated_server:
        yield gated_server


@pytest.fixture
def bystander(gated_server: GatedServer) -> Iterator[Callable[[], None]]:
    """A page that connected earlier; call it to check that it still works and still receives broadcasts."""
    bell, shown = Bell(gated_server), gated_server.server.gui.add_html("0")
    received: list[str] = []

    def listen(connection: Connection) -> None:
        for frame in connection:
            assert isinstance(frame, bytes)
            for message in messages_in(frame):
                if message["type"] == "GuiUpdateMessage" and "content" in message["updates"]:
                    received.append(message["updates"]["content"])

    with client(gated_server) as reader, client(gated_server) as other:
        thread = threading.Thread(target=listen, args=(reader,))
        thread.start()

        def works() -> None:
            bell.rings(other)
            shown.content = str(bell.rung)
            until(lambda: str(bell.rung) in received, "the broadcast")

        works()
        yield works
        reader.close()
        thread.join()
    bell.remove()
    shown.remove()


NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(
    "change",
    [
        {"position": (NAN, 0.0, 0.0)},
        {"look_at": (0.0, INF, 0.0)},
        {"up_direction": (0.0, 0.0, 1e200)},
        {"wxyz": (0.0, 0.0, 0.0, 0.0)},
        {"fov": 0.0},
        {"fov": NAN},
        {"image_width": -1},
        {"image_height": 10**9},
        {"near": -INF},
    ],
    ids=str,
)
def test_an_invalid_camera_is_dropped_and_the_page_stays(gated_server, bystander, change):
    with client(gated_server) as connection:
        known = {
            number: one.camera.position.copy() for number, one in gated_server.server.get_clients().items()
        }
        say(connection, {**CAMERA, "position": (7.0, 7.0, 7.0), **change})
        Bell(gated_server).rings(connection)
        for number, one in gated_server.server.get_clients().items():
            assert (one.camera.position == known[number]).all()
    bystander()


def test_a_gizmo_does_not_move_to_an_invalid_pose(gated_server, bystander):
    gizmo = gated_server.server.scene.add_transform_controls("/gizmo")
    update = {"type": "TransformControlsUpdateMessage", "name": "/gizmo", "owner": gizmo._impl.api._owner_id}
    with client(gated_server) as connection:
        for wxyz, position in (
            ((1.0, 0.0, 0.0, 0.0), (NAN, 0.0, 0.0)),
            ((NAN, 0.0, 0.0, 0.0), (1.0, 0.0, 0.0)),
            ((0.0, 0.0, 0.0, 0.0), (1.0, 0.0, 0.0)),
        ):
            say(connection, {**update, "wxyz": wxyz, "position": position})
        Bell(gated_server).rings(connection)
        assert tuple(gizmo.position) == (0.0, 0.0, 0.0)
        say(connection, {**update, "wxyz": (1.0, 0.0, 0.0, 0.0), "position": (1.0, 2.0, 3.0)})
        until(lambda: tuple(gizmo.position) == (1.0, 2.0, 3.0), "the gizmo's place")
    gizmo.remove()
    bystander()


@pytest.mark.parametrize("item", [b"\xc0", b"\x90", b"\x80", b"\xa0", b"\x01"], ids=repr)
def test_a_large_message_of_tiny_objects_is_not_decoded(gated_server, bystander, item):
    with client(gated_server) as connection:
        connection.send(b"\xdd" + (20_000_000).to_bytes(4, "big") + item * 20_000_000)
        assert close_code(connection) == 1009
    bystander()


def test_a_flooding_page_is_throttled_then_disconnected_and_the_others_go_on(
    gated_server, bystander, monkeypatch
):
    monkeypatch.setattr(message_filter, "MAX_SLOWED_SECONDS", 0.5)
    flooded = Bell(gated_server)
    gone = threading.Event()

    def flood() -> None:
        with client(gated_server) as connection, contextlib.suppress(ConnectionClosed):
            while True:
                say(connection, flooded.message)
        gone.set()

    thread = threading.Thread(target=flood)
    thread.start()
    until(lambda: flooded.rung > 0, "the flood")
    while not gone.is_set():
        bystander()
    thread.join()
    bystander()
    flooded.remove()


class Paced:
    """A page's messages under a clock that only waiting moves."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = self.waited = 0.0
        clock, sleeping = SimpleNamespace(monotonic=lambda: self.now), SimpleNamespace(sleep=self._sleep)
        monkeypatch.setattr(message_filter, "time", clock)
        monkeypatch.setattr(message_filter, "asyncio", sleeping)
        self.guard = message_filter.PageGuard(lambda kind: True, RateLimitedLog(lambda line: None))

    async def _sleep(self, seconds: float) -> None:
        self.now += seconds
        self.waited += seconds

    def sends(self, count: int, size: int = 10) -> float:
        """Send messages at once; the seconds that they had to wait."""
        before = self.waited

        async def send() -> None:
            for _ in range(count):
                await self.guard.wait_turn(size)

        asyncio.run(send())
        return self.waited - before


def test_a_page_is_slowed_only_beyond_a_burst_and_regains_it_in_a_pause(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    page = Paced(monkeypatch)
    burst, rate = int(message_filter.BURST_MESSAGES), message_filter.MESSAGES_PER_SECOND
    assert page.sends(burst) == 0
    assert page.sends(20) == pytest.approx(20 / rate)
    page.now += 10.0
    assert page.sends(burst) == 0
    assert page.sends(20) == pytest.approx(20 / rate), "a longer pause gives no larger burst"
    page.now += 10.0
    assert page.sends(100, 3 * message_filter.MESSAGE_BYTES) == 0
    assert page.sends(1, 3 * message_filter.MESSAGE_BYTES) == pytest.approx(4 / rate), (
        "a long one counts for more"
    )


def test_a_page_that_never_rests_is_closed_and_one_that_rests_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    page, rate = Paced(monkeypatch), message_filter.MESSAGES_PER_SECOND
    burst, most = int(message_filter.BURST_MESSAGES), int(message_filter.MAX_SLOWED_SECONDS * rate)
    for _ in range(5):
        page.sends(burst + most // 2)
        page.now += 10.0
    page.sends(burst + most - 1)
    with pytest.raises(MalformedMessage):
        page.sends(3)
