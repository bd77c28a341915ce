"""Tabs that come, go and fall asleep, on the real page, door, session and worker; the browsers are `tests.ui.tabs`."""

from __future__ import annotations

import gc
import logging
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import psutil
import pytest
import viser

from tests.session.conftest import TASKS, wait_until
from tests.ui.tabs import Tabs, open_deaf_tab, tabs_of
from workbench.session.messages import TaskOptions
from workbench.session.session import Session
from workbench.ui import deaf_clients
from workbench.ui.door import Door, DoorOptions, open_door
from workbench.ui.page import Page


@dataclass
class House:
    door: Door
    session: Session
    page: Page
    tabs: Tabs

    def clients(self) -> int:
        return len(self.door.server.get_clients())


@pytest.fixture(scope="module")
def house(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    file = Path(shutil.copy(TASKS / "push_cube.py", tmp_path_factory.mktemp("author") / "push_cube.py"))
    door = open_door(DoorOptions(port=0))
    # Nothing here looks at pictures, and the first one takes a software renderer some 15 s.
    options = TaskOptions(num_envs=2, env_kwargs={"render_backend": "none"})
    session = Session(str(file), options, recordings=file.parent / "recordings")
    page = Page(door.server, session)
    page.start()
    try:
        with tabs_of(door.url) as tabs:
            wait_until(session, lambda view: view.task is not None, "the first load")
            yield House(door, session, page, tabs)
    finally:
        page.stop()
        session.close()
        door.close()


def until(reached: Callable[[], object], what: str) -> None:
    deadline = time.monotonic() + 60
    while not reached():
        assert time.monotonic() < deadline, f"{what} did not come"
        time.sleep(0.02)


def test_the_session_knows_whether_any_tab_is_open(house: House) -> None:
    """Without one it renders nothing: `tests/session/test_live_session.py`."""
    first, second = house.tabs.open(), house.tabs.open()
    until(lambda: house.session._state.clients == 2, "both tabs")
    house.tabs.close(first)
    until(lambda: house.session._state.clients == 1, "the end of one")
    house.tabs.close(second)
    until(lambda: house.session._state.clients == 0, "the end of the other")


def test_a_tab_that_reads_nothing_is_let_go_and_nobody_waits_for_it(
    house: House, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(deaf_clients, "PATIENCE", 3.0)
    reads = house.tabs.open()
    until(lambda: reads.open, "the tab that reads")
    deaf = open_deaf_tab(house.door.url)
    until(lambda: house.clients() == 2, "the one that does not")
    house.session.play()
    with caplog.at_level(logging.WARNING, "workbench.door"):
        frames = reads.frames
        until(lambda: reads.frames > frames + 10, "updates for the one that reads")
        until(lambda: house.clients() == 1, "the end of the other")
    assert "has read nothing for 3 s" in caplog.text
    frames = reads.frames
    until(lambda: reads.frames > frames + 10, "further updates for the one that reads")
    assert reads.open
    house.session.pause()
    deaf.close()
    house.tabs.close(reads)


def test_a_tab_that_comes_and_goes_leaves_nothing_behind(house: House) -> None:
    server = house.door.server

    def come_and_go() -> None:
        tab = house.tabs.open(server.initial_camera.position.tolist())
        until(
            lambda: house.clients() and server.get_clients().keys() <= house.page._framing.pointed,
            "the view",
        )
        house.tabs.close(tab)
        until(lambda: house.clients() == 0, "its end")

    def held() -> dict[str, int]:
        until(lambda: not house.page._framing.followed, "the page to notice")
        gc.collect()
        handles = sum(isinstance(thing, viser.ClientHandle) for thing in gc.get_objects())
        this = psutil.Process()
        return {
            "handles": handles,
            "threads": threading.active_count(),
            "files": this.num_fds(),
            "of viser's": len(server._websock_server._client_state_from_id),
            "pointed": len(house.page._framing.pointed),
        }

    for _ in range(3):
        come_and_go()
    before = held()
    for _ in range(30):
        come_and_go()
    # Something may begin meanwhile that has nothing to do with tabs, and the kernel may take a socket's end later than
    # viser does. What each of thirty tabs left would be thirty.
    grown = {name: (before[name], now) for name, now in held().items() if now > before[name] + 2}
    assert not grown
