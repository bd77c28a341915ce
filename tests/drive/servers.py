"""Fixtures: viser servers, a live page, and sessions on a scripted worker."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import viser

from tests.drive.live import Live
from tests.drive.panels import Clock, Panels
from tests.drive.scripted import Evaluate, no_success, scripted
from tests.drive.session import wait_until
from workbench.app.session import Session
from workbench.envs.camera_data import CameraInfo
from workbench.page.door.gated_server import GatedServer, ServerOptions, open_server
from workbench.task.description import TaskOptions


@pytest.fixture
def server() -> Iterator[viser.ViserServer]:
    """A real viser server on a free port, without a page."""
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    yield server
    server.stop()


@pytest.fixture
def live_page(server: viser.ViserServer, clock: Clock) -> Live:
    """The live page, operated by the test."""
    return Live(server, clock)


@pytest.fixture(scope="module")
def open_live() -> Iterator[Live]:
    """A live page shared by the tests of a file; they must not change its layout."""
    live = Live(viser.ViserServer(host="127.0.0.1", port=0, verbose=False))
    yield live
    live.server.stop()


@pytest.fixture
def gated_server() -> Iterator[GatedServer]:
    """A gated server on a free port, with a token."""
    gated_server = open_server(ServerOptions(port=0))
    yield gated_server
    gated_server.close()


@pytest.fixture
def panels(server: viser.ViserServer) -> Panels:
    """The controls that `server` shows."""
    return Panels(server)


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def scripted_session(tmp_path: Path) -> Iterator[Callable[..., Session]]:
    """Makes sessions on a `ScriptedWorker` that have loaded the table scene."""
    made: list[Session] = []

    def make(num_envs: int, evaluate: Evaluate = no_success, camera: CameraInfo | None = None) -> Session:
        options = TaskOptions(num_envs=num_envs)
        worker = scripted(num_envs, evaluate, camera)
        session = Session(
            str(tmp_path / "push.py"), options, recordings=tmp_path / "kept", make_worker=worker
        )
        made.append(session)
        wait_until(session, lambda view: view.timeline.moments == 1, "the first moment")
        return session

    yield make
    for session in made:
        session.close()
