"""The recorder's own threads: what it mends at the start, and what it does when something of it fails."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.session.recordings import begin, made
from workbench.machine.watched_thread import listen, stop_listening
from workbench.session.messages import Stepped
from workbench.session.record_live import LiveRecorder
from workbench.ui.record_panel import recording_html


def until(reached: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 20
    while not reached():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_an_episode_that_was_mended_is_named_on_the_page_and_in_the_terminal(tmp_path: Path) -> None:
    begin(tmp_path, made(5, seed=8))
    said: list[str] = []
    recorder = LiveRecorder(tmp_path, lambda: None, lambda envs: None, said.append)
    try:
        until(lambda: bool(said))
        (rrd,) = tmp_path.glob("*.rrd")
        assert said == [f"1 episode that an earlier session left half written was mended: {rrd}"]
        assert recorder.status().recovered == (str(rrd),)
        assert rrd.name in recording_html(recorder.status())
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
        empty = np.zeros((1, 1, 7), np.float32)
        step: Any = SimpleNamespace(poses=empty, reward=np.zeros(1), evaluate={}, action=None)
        step.elapsed_steps = np.zeros(1, np.int64)
        stepped = Stepped(step, np.ones(1, bool))
        for _ in range(2):
            recorder.start(task, (0,))
            until(lambda: recorder._gatherer is not None)
            recorder.take(stepped)
            until(lambda: recorder.status().problem is not None)
            assert not recorder.status().active
            assert str(recorder.status().problem).startswith("the recording ended: ")
        assert said[0].startswith("A step could not be recorded: AttributeError")
    finally:
        recorder.close()
        stop_listening(said.append)
