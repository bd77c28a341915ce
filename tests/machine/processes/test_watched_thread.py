"""A failure in a workbench thread is reported, and the thread continues."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.drive.waiting import until
from workbench.machine.processes.watched_thread import listen, report_failure, stop_listening, watched_thread
from workbench.task.watch import SourceWatcher


@pytest.fixture
def reports() -> Iterator[list[str]]:
    reports: list[str] = []
    listen(reports.append)
    yield reports
    stop_listening(reports.append)


def test_a_failing_thread_is_reported_with_its_place_and_restarts_until_done(reports: list[str]) -> None:
    runs: list[int] = []

    def work() -> None:
        runs.append(threading.get_ident())
        if len(runs) < 3:
            raise KeyError("a thing")

    thread = watched_thread("letters", work)
    thread.start()
    thread.join(timeout=60)
    assert len(runs) == 3 and len(set(runs)) == 1 and len(reports) == 2
    assert all(
        "'letters'" in text and "KeyError: 'a thing'" in text and "in work" in text for text in reports
    )


def test_a_failing_listener_does_not_stop_the_others(
    reports: list[str], caplog: pytest.LogCaptureFixture
) -> None:
    def closed_terminal(text: str) -> None:
        raise BrokenPipeError

    listen(closed_terminal)
    try:
        report_failure("Something failed", ValueError("so"))
    finally:
        stop_listening(closed_terminal)
    assert "ValueError: so" in reports[0] and "Something failed" in caplog.text


def test_the_watcher_continues_after_an_error_in_its_callback(tmp_path: Path, reports: list[str]) -> None:
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
        assert seen == [{file}] * 2 and len(reports) == 1
    finally:
        watcher.stop()
