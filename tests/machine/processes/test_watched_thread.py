"""A thread of the workbench that fails is told of, and goes on."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.drive.waiting import until
from workbench.machine.processes.watched_thread import listen, report_failure, stop_listening, watched_thread
from workbench.task.watch import SourceWatcher


@pytest.fixture
def said() -> Iterator[list[str]]:
    said: list[str] = []
    listen(said.append)
    yield said
    stop_listening(said.append)


def test_a_thread_that_fails_is_said_with_its_place_and_goes_on_until_it_is_done(said: list[str]) -> None:
    runs: list[int] = []

    def work() -> None:
        runs.append(threading.get_ident())
        if len(runs) < 3:
            raise KeyError("a thing")

    thread = watched_thread("letters", work)
    thread.start()
    thread.join(timeout=60)
    assert len(runs) == 3 and len(set(runs)) == 1 and len(said) == 2
    assert all("'letters'" in text and "KeyError: 'a thing'" in text and "in work" in text for text in said)


def test_a_listener_that_fails_stops_nobody(said: list[str], caplog: pytest.LogCaptureFixture) -> None:
    def closed_terminal(text: str) -> None:
        raise BrokenPipeError

    listen(closed_terminal)
    try:
        report_failure("Something failed", ValueError("so"))
    finally:
        stop_listening(closed_terminal)
    assert "ValueError: so" in said[0] and "Something failed" in caplog.text


def test_the_watcher_goes_on_after_whatever_fails_in_it(tmp_path: Path, said: list[str]) -> None:
    file = tmp_path / "task.py"
    file.write_text("x = 1\n")
    seen: list[set[Path]] = []

    def changed(paths: set[Path]) -> None:
        seen.append(paths)
        if len(seen) == 1:
            raise RuntimeError("the page is gone")

    watcher = SourceWatcher(changed)
    try:
        watcher.follow([file])
        for times in (1, 2):
            file.write_text(f"x = {times + 1}\n")
            until(lambda times=times: len(seen) == times, "the change", seen=lambda: seen)
        assert seen == [{file}] * 2 and len(said) == 1
    finally:
        watcher.stop()
