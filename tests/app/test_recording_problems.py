"""Recording problems are shown on the open page, whichever it is, and in the terminal."""

from __future__ import annotations

from pathlib import Path

import pytest
import websockets.sync.client

from tests.drive.scripted import scripted
from tests.drive.session import wait_until
from tests.drive.tabs import camera_message, handshake, messages_in
from tests.drive.waiting import until
from workbench.app.pages import Which
from workbench.app.recording_problems import RecordingProblems
from workbench.app.server import App
from workbench.app.session import Session
from workbench.live.commands import Step
from workbench.live.events import EnvsReset
from workbench.page.door.gated_server import GatedServer
from workbench.record.commands import StopRecording
from workbench.record.saving_state import SaveWanted
from workbench.record.state import RecordingStatus, RecordingWanted
from workbench.task.description import TaskOptions


def bodies(frame: object) -> list[str]:
    """Texts of the notices in a frame of the server."""
    assert isinstance(frame, bytes)
    shown = [one for one in messages_in(frame) if one["type"] == "NotificationShowMessage"]
    return [message["props"]["body"] for message in shown]


@pytest.mark.usefixtures("child_process")
def test_a_page_shows_how_many_episodes_a_recording_saved_and_where(
    tmp_path: Path, gated_server: GatedServer
) -> None:
    session = Session(
        str(tmp_path / "push.py"), TaskOptions(num_envs=2), recordings=tmp_path, make_worker=scripted(2)
    )
    wait_until(session, lambda view: view.timeline.moments == 1, "the first moment")
    reports = RecordingProblems(gated_server.server, lambda: session, lambda problem: None)
    address, how = handshake(gated_server.url)
    with websockets.sync.client.connect(address, **how) as connection:
        connection.send(camera_message())
        until(lambda: gated_server.server.get_clients(), "the client")
        session.dispatch(RecordingWanted())
        session.do(Step())
        wait_until(session, lambda view: view.of(RecordingStatus).steps == 2, "a step of both envs")
        session.do(StopRecording())
        (told,) = until(lambda: bodies(connection.recv(timeout=30)), "the notice")
    assert "2 episodes" in told and str(tmp_path) in told
    reports.close()
    session.close()


@pytest.mark.usefixtures("child_process")
@pytest.mark.parametrize("page", ["live", "review"])
def test_each_page_shows_a_recording_problem(page: Which, tmp_path: Path, gated_server: GatedServer) -> None:
    folder = tmp_path / "no folder"
    folder.write_text("a file")
    notices: list[str] = []
    session = Session(
        str(tmp_path / "push.py"), TaskOptions(num_envs=2), recordings=folder, make_worker=scripted(2)
    )
    wait_until(session, lambda view: view.timeline.moments == 1, "the first moment")

    def no_other(*_: object) -> Session:
        raise AssertionError("no other task is opened")

    app = App(gated_server, folder, no_other, TaskOptions(), session, on_notice=notices.append)
    app.open_task.catalogue.registered.close()
    app.shared.pages.start(page)
    address, how = handshake(gated_server.url)
    with websockets.sync.client.connect(address, **how) as connection:
        connection.send(camera_message())
        until(lambda: gated_server.server.get_clients(), "the client")

        def tells(number: int) -> bool:
            texts = bodies(connection.recv(timeout=30))
            return any(str(folder) in text for text in texts) and len(notices) == number

        for number in (1, 2):
            session.dispatch(RecordingWanted())
            until(lambda number=number: tells(number), "the notice")
        # A momentary refusal is shown too, and not kept afterwards.
        begun = session.view().timeline.moments
        session.dispatch(EnvsReset())
        wait_until(session, lambda view: view.timeline.moments > begun, "the reset")
        session.dispatch(SaveWanted(before=True))
        assert session.view().of(RecordingStatus).saving.failed
        session.do(Step())
        wait_until(session, lambda view: not view.of(RecordingStatus).saving.message, "the message's end")
    assert len(notices) == 2
    app.close()
    session.close()
