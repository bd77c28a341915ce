"""Recording with a scripted worker: recovered episodes, refusals, and the effects of failures."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.drive.episodes import begin, made
from tests.drive.session import Told, moment, moment_at, told_session
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
    with told_session(tmp_path, on_notice=notices.append) as told:
        until(lambda: notices, "the notice")
        (rrd,) = tmp_path.glob("*.rrd")
        assert len(notices) == 1 and str(rrd) in notices[0]
        assert told.view.of(RecordingStatus).recovered == (str(rrd),)


def test_an_episode_cut_off_by_a_stop_or_a_death_is_written(child_process: None, tmp_path: Path) -> None:
    with told_session(tmp_path) as told:
        with pytest.raises(Refused):
            told.session.happen(RecordingWanted())
        assert told.asked(SetCapture) == [], "no task is loaded yet"
        told.play(0)
        with pytest.raises(Refused):
            told.session.do(StopRecording())
        for count, end in enumerate((lambda: told.session.do(StopRecording()), told.die), 1):
            told.asked(object)
            told.session.happen(RecordingWanted((0, 2)))
            assert [type(one) for one in told.asked((SetCapture, Reset))] == [SetCapture, Reset]  # type: ignore[arg-type]
            told.reset((2,))
            told.step()
            end()
            status = until(
                lambda count=count: (
                    s if (s := told.view.of(RecordingStatus)).episodes_written == count else None
                ),
                "the file",
            )
            assert (status.active, status.problem, status.being_written) == (False, None, 0)
            assert read_episode(Path(str(status.last_file))).info.env_index == 2
        assert len(list(tmp_path.glob("*.rrd"))) == 2


def test_an_invalid_step_ends_the_recording_with_a_message_and_keeps_the_thread(
    played: Told,
) -> None:
    notices: list[str] = []
    listen(notices.append)
    try:
        for _ in range(2):
            played.session.happen(RecordingWanted((0,)))
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


def test_a_refusal_to_save_the_past_is_shown_only_where_it_applies(tmp_path: Path) -> None:
    with told_session(tmp_path, history_bytes=20_000) as told:
        told.session.happen(SaveWanted((0,)))
        assert told.view.of(RecordingStatus).saving.failed, "no task"
        told.play(0)
        told.session.happen(SaveWanted((0,)))
        assert told.view.of(RecordingStatus).saving.failed, "no step"
        told.step(100)
        assert told.view.timeline.first > 0 and not told.view.of(RecordingStatus).saving.message
        told.session.happen(SaveWanted((0,)))
        refused = told.view.of(RecordingStatus).saving
        assert refused.failed and "no longer in memory" in refused.message and refused.progress is None
        told.session.change(selected_env=1)
        assert not told.view.of(RecordingStatus).saving.message, "the message is about env 0"
        told.session.change(selected_env=0)
        assert told.view.of(RecordingStatus).saving.failed
        told.step()
        assert not told.view.of(RecordingStatus).saving.message, "the message is about the previous moment"
        told.reset()
        told.step(2)
        told.reset()
        told.session.happen(SaveWanted((0,), before=True))
        assert told.view.of(RecordingStatus).saving.failed, (
            "the previous episode began before the kept history"
        )
        told.session.happen(RecordingWanted())
        assert not told.view.of(RecordingStatus).saving.message, "a new recording replaces the message"
        assert moment_at(told.session, 0) is None


def test_bytes_on_the_disk_no_longer_count_as_waiting(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A recording ends only if too much waits at once, whatever its total size; the next one starts from zero."""
    monkeypatch.setattr(recording, "MAX_PENDING_BYTES", 10_500)
    taker = BlockingRecorder()
    monkeypatch.setattr(live, "EpisodeGatherer", lambda *given, **named: taker)
    with told_session(tmp_path) as told:
        told.play(0)
        given = 0
        try:
            for _ in range(2):
                taker.disk.set()
                told.session.happen(RecordingWanted((0,)))
                told.step(snapshot=b"")
                given += 1
                size = told.view.step.nbytes  # pyright: ignore[reportOptionalMemberAccess]
                at_once = 10_500 // size
                assert at_once > 2
                for _ in range(3):
                    told.step(at_once - 1, snapshot=b"")
                    given += at_once - 1
                    until(
                        lambda given=given: told.view.of(RecordingStatus).steps == given,
                        "the steps to be taken",
                    )
                    assert (
                        told.view.of(RecordingStatus).problem is None and told.view.of(RecordingStatus).active
                    )
                taker.disk.clear()
                told.step(at_once, snapshot=b"")
                given += at_once
                assert told.view.of(RecordingStatus).active
                told.step(snapshot=b"")
                assert (
                    not told.view.of(RecordingStatus).active
                    and told.view.of(RecordingStatus).problem is not None
                )
                taker.disk.set()
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
