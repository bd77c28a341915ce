"""Tabs that open, close and stop reading, on the real page, door and session; the browsers are `tests.drive.tabs`."""

from __future__ import annotations

import gc
import logging
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import psutil
import pytest
import viser

from tests.drive.panels import held_by
from tests.drive.scripted import scripted
from tests.drive.session import wait_until
from tests.drive.tabs import Tabs, open_deaf_tab, tabs_of
from tests.drive.waiting import until
from workbench.app.live_page import Page
from workbench.app.pages import Pages
from workbench.app.session import Session
from workbench.commands import COMMANDS
from workbench.live.commands import PauseRun, PlayRun
from workbench.live.events import PagesCounted, RunEvent
from workbench.page.door import connection_limits as strangers
from workbench.page.door.gated_server import GatedServer, ServerOptions, open_server
from workbench.page.scene.viewpoint import View3D
from workbench.page.widgets.visitors import Visitors
from workbench.task.description import TaskOptions

pytestmark = pytest.mark.thorough


@dataclass
class House:
    gated_server: GatedServer
    session: Session
    stage: View3D
    tabs: Tabs
    counts: list[int]
    """Each number of open pages that the session received."""

    def clients(self) -> int:
        return len(self.gated_server.server.get_clients())


class CountingSession(Session):
    """Records the page counts that it receives."""

    def __init__(self, counts: list[int], folder: Path) -> None:
        self._counts = counts
        options = TaskOptions(num_envs=2)
        super().__init__(
            str(folder / "push.py"), options, recordings=folder / "recordings", make_worker=scripted(2)
        )

    def dispatch(self, event: RunEvent) -> None:
        if isinstance(event, PagesCounted):
            self._counts.append(event.count)
        super().dispatch(event)


@pytest.fixture(scope="module")
def house(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    gated_server, counts = open_server(ServerOptions(port=0)), [0]
    session, stage = CountingSession(counts, tmp_path_factory.mktemp("author")), View3D(gated_server.server)
    page = Page(gated_server.server, Visitors(gated_server.server, COMMANDS), session, stage=stage)
    pages = Pages(gated_server.server, stage, lambda which, dark: page)
    pages.start("live")
    try:
        with tabs_of(gated_server.url) as tabs:
            wait_until(session, lambda view: view.task is not None, "the first load")
            yield House(gated_server, session, stage, tabs, counts)
    finally:
        pages.stop()
        session.close()
        gated_server.close()


def test_the_session_knows_whether_any_tab_is_open(house: House) -> None:
    """Without a tab it renders nothing: `tests/live/test_session.py`."""
    first, second = house.tabs.open(), house.tabs.open()
    until(lambda: house.counts[-1] == 2, "both tabs")
    house.tabs.close(first)
    until(lambda: house.counts[-1] == 1, "the end of one")
    house.tabs.close(second)
    until(lambda: house.counts[-1] == 0, "the end of the other")


@pytest.mark.slow
def test_a_tab_that_reads_nothing_is_disconnected_and_blocks_no_one(
    house: House, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(strangers, "READ_TIMEOUT_SECONDS", 3.0)
    reads = house.tabs.open()
    until(lambda: reads.open, "the tab that reads")
    deaf = open_deaf_tab(house.gated_server.url)
    until(lambda: house.clients() == 2, "the one that does not")
    house.session.do(PlayRun())
    with caplog.at_level(logging.WARNING, "workbench.door"):
        frames = reads.frames
        until(lambda: reads.frames > frames + 10, "updates for the one that reads")
        until(lambda: house.clients() == 1, "the end of the other")
    assert "has read nothing for 3 s" in caplog.text
    frames = reads.frames
    until(lambda: reads.frames > frames + 10, "further updates for the one that reads")
    assert reads.open
    house.session.do(PauseRun())
    deaf.close()
    house.tabs.close(reads)


@pytest.mark.slow
def test_a_tab_that_opens_and_closes_leaves_nothing_behind(house: House) -> None:
    server = house.gated_server.server

    def come_and_go() -> None:
        tab = house.tabs.open(server.initial_camera.position.tolist())
        until(
            lambda: house.clients() and server.get_clients().keys() <= house.stage.framing.pointed,
            "the view",
        )
        house.tabs.close(tab)
        until(lambda: house.clients() == 0, "its end")

    def held() -> dict[str, int]:
        until(lambda: not house.stage.framing.pointed, "the page to notice")
        gc.collect()
        handles = sum(isinstance(thing, viser.ClientHandle) for thing in gc.get_objects())
        this = psutil.Process()
        return {
            "handles": handles,
            "threads": threading.active_count(),
            "files": this.num_fds(),
            "of viser's": held_by(server)["pages"],
            "pointed": len(house.stage.framing.pointed),
        }

    for _ in range(3):
        come_and_go()
    before = held()
    for _ in range(30):
        come_and_go()

    def grown() -> dict[str, tuple[int, int]]:
        return {name: (before[name], now) for name, now in held().items() if now > before[name]}

    # The kernel and a viser thread may notice a closed socket later than the page.
    until(lambda: not grown(), "as few as before", 20, seen=grown)
