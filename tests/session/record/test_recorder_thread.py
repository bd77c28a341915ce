"""The recorder's own threads: what it recovers at the start, and what it does when something of it fails."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from tests.drive.episodes import begin, made
from tests.drive.waiting import until
from tests.session.moments import stepped
from tests.ui.scenes import description, table_scene
from workbench.jobs.task import Stepped
from workbench.machine.processes.watched_thread import listen, stop_listening
from workbench.recording.reader.read_episode import read_episode
from workbench.session.record import live
from workbench.session.record.live import LiveRecorder
from workbench.ui.live.episodes_panel import recording_html


def test_an_episode_that_was_mended_is_named_on_the_page_and_in_the_terminal(
    child_process: None, tmp_path: Path
) -> None:
    begin(tmp_path, made(5, seed=8))
    said: list[str] = []
    recorder = LiveRecorder(tmp_path, lambda: None, lambda envs: None, said.append)
    try:
        until(lambda: said, "a word of it")
        (rrd,) = tmp_path.glob("*.rrd")
        assert said == [f"1 episode that an earlier session left half written was recovered: {rrd}"]
        assert recorder.status().recovered == (str(rrd),)
        assert rrd.name in recording_html(recorder.status())
    finally:
        recorder.close()


def test_what_is_stopped_in_the_middle_of_an_episode_is_written(child_process: None, tmp_path: Path) -> None:
    recorder = LiveRecorder(tmp_path, lambda: None, lambda envs: None)
    try:
        assert (recorder.recording, recorder.one_each) == ((), False)
        recorder.start(description(table_scene(3)[0]), (0, 2))
        assert recorder.recording == (0, 2)
        recorder.take(stepped(0, jumped=(2,)))
        recorder.take(stepped(1))
        recorder.stop()
        status = until(lambda: s if (s := recorder.status()).episodes_written else None, "the files")
        assert (status.episodes_written, status.active, status.problem) == (1, False, None)
        (rrd,) = tmp_path.glob("*.rrd")
        episode = read_episode(rrd)
        assert (episode.info.env_index, episode.length) == (2, 1)
    finally:
        recorder.close()


def test_a_step_that_cannot_be_recorded_ends_the_recording_with_a_sentence_and_not_the_thread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    listen(said.append)
    recorder = LiveRecorder(tmp_path, lambda: None, lambda envs: None)
    try:
        task: Any = SimpleNamespace()  # no task at all: the gatherer takes it and fails at the first reset
        for _ in range(2):
            recorder.start(task, (0,))
            until(lambda: recorder._gatherer is not None, "the gatherer")
            recorder.take(stepped(0, jumped=(0, 1, 2)))
            until(lambda: recorder.status().problem is not None, "the problem")
            assert not recorder.status().active
            assert str(recorder.status().problem).startswith("the recording ended: ")
        assert said[0].startswith("A step could not be recorded: AttributeError")
    finally:
        recorder.close()
        stop_listening(said.append)


def step_of(size: int) -> Stepped:
    """A step that begins no episode, of so many bytes, 396 of them arrays."""
    return replace(stepped(1), snapshot=bytes(size - 396))


def until_taken(recorder: LiveRecorder) -> None:
    until(recorder._queue.empty, "the steps to be taken")


def test_what_the_disk_has_taken_does_not_wait_any_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However much a recording holds in all: it ends only where too much waits at once, and the next begins anew."""
    monkeypatch.setattr(live, "_MOST_WAITING", 10_500)
    go = threading.Event()
    go.set()
    recorder = LiveRecorder(tmp_path, lambda: None if go.wait(20) else None, lambda envs: None)
    try:
        for _ in range(2):
            recorder.start(cast(Any, SimpleNamespace()), (0,))
            for _ in range(30):
                until_taken(recorder)
                recorder.take(step_of(1000))
                assert recorder.status().problem is None
            until_taken(recorder)
            go.clear()
            recorder.start(cast(Any, SimpleNamespace()), (0,))  # whose thread now waits in `on_change`
            taken = 0
            while recorder.status().active and taken < 100:
                recorder.take(step_of(1000))
                taken += 1
            assert 9 <= taken <= 11
            assert "the disk is slower than the simulation" in str(recorder.status().problem)
            go.set()
            until_taken(recorder)
    finally:
        go.set()
        recorder.close()
