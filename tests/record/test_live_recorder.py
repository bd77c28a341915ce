"""Recording with a scripted worker: recovered episodes, refusals, and the effects of failures."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.drive.episodes import begin, made
from tests.drive.session import FakeWorkerSession, fake_worker_session, moment, moment_at
from tests.drive.waiting import until
from workbench.episodes.reader.read_episode import read_episode
from workbench.live.messages import Reset, SetCapture
from workbench.machine.processes.watched_thread import listen, stop_listening
from workbench.page.command import Refused
from workbench.record import live_recorder as live
from workbench.record import state as recording
from workbench.record.commands import StopRecording
from workbench.record.saving_state import SaveWanted
from workbench.record.state import RecordingStatus, RecordingWanted


def test_a_recovered_episode_is_named_on_the_page_and_in_the_terminal(
    child_process: None, tmp_path: Path
) -> None:
    begin(tmp_path, made(5, seed=8))
    notices: list[str] = []
    with fake_worker_session(tmp_path, on_notice=notices.append) as fake:
        until(lambda: notices, "the notice")
        (rrd,) = tmp_path.glob("*.rrd")
        assert len(notices) == 1 and str(rrd) in notices[0]
        assert fake.view.of(RecordingStatus).recovered == (str(rrd),)


def test_an_episode_cut_off_by_a_stop_or_a_death_is_written(child_process: None, tmp_path: Path) -> None:
    with fake_worker_session(tmp_path) as fake:
        with pytest.raises(Refused):
            fake.session.dispatch(RecordingWanted())
        assert fake.asked(SetCapture) == [], "no task is loaded yet"
        fake.play(0)
        with pytest.raises(Refused):
            fake.session.do(StopRecording())
        for count, end in enumerate((lambda: fake.session.do(StopRecording()), fake.die), 1):
            fake.asked(object)
            fake.session.dispatch(RecordingWanted((0, 2)))
            assert [type(one) for one in fake.asked((SetCapture, Reset))] == [SetCapture, Reset]  # type: ignore[arg-type]
            fake.reset((2,))
            fake.step()
            end()
            status = until(
                lambda count=count: (
                    s if (s := fake.view.of(RecordingStatus)).episodes_written == count else None
                ),
                "the file",
            )
            assert (status.active, status.problem, status.being_written) == (False, None, 0)
            until(lambda: fake.view.of(RecordingStatus).saved == 1, "the number of saved episodes")
            assert read_episode(Path(str(status.last_file))).info.env_index == 2
        assert len(list(tmp_path.glob("*.rrd"))) == 2


def test_an_invalid_step_ends_the_recording_with_a_message_and_keeps_the_thread(
    played: FakeWorkerSession,
) -> None:
    notices: list[str] = []
    listen(notices.append)
    try:
        for _ in range(2):
            played.session.dispatch(RecordingWanted((0,)))
            assert played.view.of(RecordingStatus).problem is None, (
                "the problem of the previous recording is cleared"
            )
            played.reset((0,))
            now: Any = played.view.step
            bad: Any = {"state": SimpleNamespace(nbytes=0)}  # not an array
            played.tell(replace(moment(now.elapsed_steps + 1), columns=bad))
            until(lambda: played.view.of(RecordingStatus).problem is not None, "the problem")
            assert not played.view.of(RecordingStatus).active
        assert notices
    finally:
        stop_listening(notices.append)


@pytest.mark.usefixtures("child_process")
def test_the_previous_episode_is_the_last_one_with_a_step_however_often_the_env_was_reset(
    tmp_path: Path,
) -> None:
    with fake_worker_session(tmp_path) as fake:
        fake.play(0)
        fake.step(3)
        for _ in range(3):
            fake.reset()
        fake.step(2)
        fake.session.dispatch(SaveWanted((0,), before=True))
        assert not fake.view.of(RecordingStatus).saving.failed


def test_a_refusal_to_save_the_past_is_shown_only_where_it_applies(tmp_path: Path) -> None:
    with fake_worker_session(tmp_path, history_bytes=20_000) as fake:
        fake.session.dispatch(SaveWanted((0,)))
        assert fake.view.of(RecordingStatus).saving.failed, "no task"
        fake.play(0)
        fake.session.dispatch(SaveWanted((0,)))
        assert fake.view.of(RecordingStatus).saving.failed, "no step"
        fake.step(100)
        assert fake.view.timeline.first > 0 and not fake.view.of(RecordingStatus).saving.message
        fake.session.dispatch(SaveWanted((0,)))
        refused = fake.view.of(RecordingStatus).saving
        assert refused.failed and "no longer in memory" in refused.message and refused.progress is None
        fake.session.change(selected_env=1)
        assert not fake.view.of(RecordingStatus).saving.message, "the message is about env 0"
        fake.session.change(selected_env=0)
        assert fake.view.of(RecordingStatus).saving.failed
        fake.step()
        assert not fake.view.of(RecordingStatus).saving.message, "the message is about the previous moment"
        fake.reset()
        fake.step(2)
        fake.reset()
        fake.session.dispatch(SaveWanted((0,), before=True))
        assert fake.view.of(RecordingStatus).saving.failed, (
            "the previous episode began before the kept history"
        )
        fake.session.dispatch(RecordingWanted())
        assert not fake.view.of(RecordingStatus).saving.message, "a new recording replaces the message"
        assert moment_at(fake.session, 0) is None


def test_bytes_on_the_disk_no_longer_count_as_waiting(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A recording ends only if too much waits at once, whatever its total size; the next one starts from zero."""
    monkeypatch.setattr(recording, "MAX_PENDING_BYTES", 10_500)
    taker = BlockingRecorder()
    monkeypatch.setattr(live, "EpisodeGatherer", lambda *given, **named: taker)
    with fake_worker_session(tmp_path) as fake:
        fake.play(0)

        def until_taken(count: int) -> None:
            until(lambda: fake.view.of(RecordingStatus).steps == count, "the steps to be taken")

        given = 0
        try:
            for _ in range(2):
                taker.disk.set()
                fake.session.dispatch(RecordingWanted((0,)))
                fake.step(snapshot=b"")
                given += 1
                until_taken(given)  # steps of the previous recording count until they are taken
                size = fake.view.step.nbytes  # pyright: ignore[reportOptionalMemberAccess]
                at_once = 10_500 // size
                assert at_once > 2
                for _ in range(3):
                    fake.step(at_once - 1, snapshot=b"")
                    given += at_once - 1
                    until_taken(given)
                    assert (
                        fake.view.of(RecordingStatus).problem is None and fake.view.of(RecordingStatus).active
                    )
                taker.disk.clear()
                fake.step(at_once, snapshot=b"")
                given += at_once
                assert fake.view.of(RecordingStatus).active
                fake.step(snapshot=b"")
                assert (
                    not fake.view.of(RecordingStatus).active
                    and fake.view.of(RecordingStatus).problem is not None
                )
                taker.disk.set()
                until(lambda given=given: taker.taken == given, "the steps to be taken")
        finally:
            taker.disk.set()


class BlockingRecorder:
    """Stands in for a recorder; takes a step once the `disk` event is set."""

    env_idx = (0,)

    @property
    def under_way(self) -> tuple[Any, ...]:
        return (SimpleNamespace(steps=self.taken, writer=SimpleNamespace(bytes_written=0)),)

    def __init__(self) -> None:
        self.disk = threading.Event()
        self.taken = 0

    def take(self, stepped: object) -> None:
        assert self.disk.wait(60)
        self.taken += 1

    def finish(self) -> None:
        """Do nothing; there are no files."""
