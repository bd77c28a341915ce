"""Every control of the live page and of the review, claimed to hold whatever a page can send."""

from __future__ import annotations

import functools
import threading
from collections.abc import Iterator

import msgspec
import pytest
import viser
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from websockets.exceptions import ConnectionClosed
from websockets.sync.connection import Connection

from tests.drive.episodes import made, write
from tests.drive.panels import inputs_of
from tests.drive.scripted import scripted
from tests.drive.session import wait_until
from tests.drive.waiting import until
from tests.ui.knocking import claim, client, say
from workbench.jobs.task import TaskOptions
from workbench.session.live.session import Session
from workbench.ui.app.workplace import Workplace
from workbench.ui.server import page_guard
from workbench.ui.server.gated_server import GatedServer, ServerOptions, open_server

NASTY = (
    *(None, False, 0, 0.5, -1, 1e30, -1e30, 2**63, 2**64 - 1, -(2**63), 1e308, float("nan"), float("inf")),
    *("", "x", "x" * 20_000, "a\nb", "\x1b[31m\0", "99999999999999999999999", b"x", b"x" * 10_000),
    *([], [1.0], [1e30] * 3, [float("nan")] * 2, [True, True], ["a", "b", "c"], [0] * 1000, [[[]]]),
    *({}, {"value": 1}, {"a": {"b": [1]}}),
)
NUMBERS = st.integers(-(2**63), 2**64 - 1) | st.floats()
ANYTHING = st.recursive(
    st.none() | st.booleans() | NUMBERS | st.text(max_size=30) | st.binary(max_size=30),
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=10,
)


class Served:
    """Both pages behind a real door, with a page that only listens."""

    def __init__(self, gated_server: GatedServer, place: Workplace) -> None:
        self.gated_server, self.place = gated_server, place

    def show(self, which: str) -> None:
        self.place.pages.show(which)  # type: ignore[arg-type]
        assert self.place.pages.wait_for(which, timeout=60)  # type: ignore[arg-type]

    def controls(self) -> list[viser.GuiInputHandle]:
        gui = self.gated_server.server.gui
        return inputs_of(gui)


@pytest.fixture(scope="module")
def served(child_process: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("recordings")
    write(folder, made(5))
    gated_server = open_server(ServerOptions(port=0))
    make_session = functools.partial(Session, recordings=folder, make_worker=scripted(2))
    session = make_session(str(folder / "push.py"), TaskOptions(num_envs=2))
    place = Workplace(gated_server, folder, make_session, TaskOptions(), session)
    # Else a process would list ManiSkill's tasks.
    place.open_task.catalogue.registered.close()
    place.pages.start("live")
    wait_until(session, lambda view: view.task is not None, "the task")
    yield Served(gated_server, place)
    place.close()
    session.close()
    gated_server.close()


@pytest.fixture
def listener(served: Served) -> Iterator[Connection]:
    """A page that was there before, and reads what it is sent; it must never be closed."""
    closed: list[BaseException] = []

    def listen(connection: Connection) -> None:
        try:
            while True:
                connection.recv()
        except ConnectionClosed as error:
            closed.append(error)

    with client(served.gated_server) as connection:
        thread = threading.Thread(target=listen, args=(connection,))
        thread.start()
        yield connection
        assert not closed
        connection.close()
        thread.join()


def claim_all(served: Served, values: tuple[object, ...]) -> None:
    with client(served.gated_server) as attacker:
        for control in served.controls():
            for value in values:
                # True is a press: that is what a button is for.
                if not (value is True and isinstance(control, viser.GuiButtonHandle)):
                    say(attacker, claim(control, value))
        box = served.gated_server.server.gui.add_checkbox("after", False)
        say(attacker, claim(box, True))
        until(lambda: box.value, "what was said last")
        box.remove()
    for control in served.controls():
        msgspec.msgpack.encode(control.value)


@pytest.mark.parametrize("which", ["start", "live", "review"])
def test_no_claim_disturbs_another_page(served, listener, monkeypatch, capfd, which):
    monkeypatch.setattr(page_guard, "HANDS_OFF", 0.05)
    monkeypatch.setattr(page_guard, "RATE", 1e6)  # not a test of the pace
    served.show(which)
    assert len(served.controls()) > {"start": 2, "live": 30, "review": 20}[which]
    claim_all(served, NASTY)
    with client(served.gated_server):  # and a page that comes later is let in and gets all
        pass
    printed = capfd.readouterr().err
    assert "Traceback" not in printed
    assert len(printed.splitlines()) <= 1, printed


@pytest.mark.slow
@pytest.mark.parametrize("which", ["start", "live", "review"])
def test_no_random_claim_disturbs_another_page(served, listener, monkeypatch, capfd, which):
    monkeypatch.setattr(page_guard, "RATE", 1e6)
    served.show(which)

    @settings(
        max_examples=200,
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
    )
    @given(st.lists(ANYTHING, min_size=5, max_size=5).map(tuple))
    def claim_them(values: tuple[object, ...]) -> None:
        claim_all(served, values)

    claim_them()
    assert "Traceback" not in capfd.readouterr().err
