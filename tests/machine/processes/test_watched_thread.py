from __future__ import annotations

import threading
from pathlib import Path

import pytest

from tests.drive.waiting import until
from workbench.authoring.loading.watch import SourceWatcher
from workbench.machine.processes.watched_thread import listen, report_failure, stop_listening, watched_thread
from workbench.session.process.job_lane import Job, JobLane


@pytest.fixture
def said() -> list[str]:
    return []


@pytest.fixture(autouse=True)
def listening(said: list[str]):
    listen(said.append)
    yield
    stop_listening(said.append)


def test_a_thread_that_fails_is_said_and_goes_on_until_it_is_done(said: list[str]) -> None:
    runs: list[int] = []

    def work() -> None:
        runs.append(threading.get_ident())
        if len(runs) < 3:
            raise KeyError("a thing")

    thread = watched_thread("letters", work)
    thread.start()
    thread.join(timeout=20)
    assert len(runs) == 3 and len(set(runs)) == 1
    assert [text.splitlines()[0] for text in said] == [
        "The thread 'letters' failed and is started again: KeyError: 'a thing'. This is a fault of the workbench."
    ] * 2
    assert "in work" in said[0]


def test_a_listener_that_fails_stops_nobody(said: list[str], caplog: pytest.LogCaptureFixture) -> None:
    def closed_terminal(text: str) -> None:
        raise BrokenPipeError

    listen(closed_terminal)
    try:
        report_failure("Something failed", ValueError("so"))
    finally:
        stop_listening(closed_terminal)
    assert said and said[0].startswith("Something failed: ValueError: so.")
    assert "Something failed" in caplog.text


def test_a_job_that_fails_unforeseen_is_told_and_the_next_is_done(said: list[str]) -> None:
    failed: list[str] = []
    done = threading.Event()

    def broken(job: Job) -> None:
        raise AttributeError("no such thing")

    lane = JobLane("lane", lambda: None, lambda job, failure: failed.append(str(failure)))
    lane.start("counting", broken)
    until(lambda: failed, "the failure")
    lane.start("counting", lambda job: done.set())
    assert done.wait(20)
    lane.close()
    assert failed == ["it failed within the workbench (AttributeError: no such thing)"]
    assert said[0].startswith("The job 'counting' failed: AttributeError")


def test_a_lane_whose_listener_fails_goes_on(said: list[str]) -> None:
    done = threading.Event()
    calls: list[int] = []

    def on_change() -> None:
        calls.append(1)
        if threading.current_thread().name == "lane" and len(said) == 0:
            raise RuntimeError("the page is gone")

    lane = JobLane("lane", on_change, lambda job, failure: None)
    lane.start("one", lambda job: None)
    until(lambda: said, "a word of it")
    lane.start("two", lambda job: done.set())
    assert done.wait(20)
    lane.close()


def test_the_watcher_goes_on_after_whatever_fails_in_it(
    tmp_path: Path, said: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "task.py"
    file.write_text("x = 1\n")
    seen: list[set[Path]] = []
    watcher = SourceWatcher(seen.append)
    watcher.follow([file])
    with monkeypatch.context() as patched:
        patched.setattr("workbench.authoring.loading.watch._read", lambda path: 1 / 0)
        until(lambda: any("'source-watcher' failed" in text for text in said), "the end of the watcher")
    file.write_text("x = 2\n")
    until(lambda: seen == [{file}], "the change", seen=lambda: seen)
    watcher.stop()
