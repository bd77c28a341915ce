"""Jobs in the background: one at a time, stopped at any time, and one that fails fails alone."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass

import pytest

from tests.drive.waiting import until
from workbench.machine.processes.watched_thread import listen, stop_listening
from workbench.session.process.held_view import HeldView
from workbench.session.process.job_lane import Job, JobFailed, JobLane


@dataclass(frozen=True)
class Seen:
    serial: int = 0
    done: int = 0


class Lane:
    """A lane, and what a page hears of it."""

    def __init__(self) -> None:
        self.failed: list[str] = []
        self.said: list[str] = []
        self.changes = 0
        self.fails_to_hear = False
        self.lane = JobLane("lane", self._changed, lambda job, failure: self.failed.append(str(failure)))
        self.held = HeldView(Seen(), self._changed)

    def _changed(self) -> None:
        self.changes += 1
        if self.fails_to_hear and threading.current_thread().name == "lane":
            self.fails_to_hear = False
            raise RuntimeError("the page is gone")

    def runs(self) -> bool:
        """Whether a job that is started now is done."""
        done = threading.Event()
        self.lane.start("the next", lambda job: done.set())
        return done.wait(60)


@pytest.fixture
def one() -> Iterator[Lane]:
    one = Lane()
    listen(one.said.append)
    yield one
    one.lane.close()
    stop_listening(one.said.append)


def test_a_job_that_fails_is_told_and_the_next_is_done(one: Lane) -> None:
    def broken(job: Job) -> None:
        raise AttributeError("no such thing")

    def refuses(job: Job) -> None:
        raise JobFailed("not today")

    for work, words in ((broken, "no such thing"), (refuses, "not today")):
        one.lane.start("counting", work)
        until(lambda words=words: one.failed and words in one.failed[-1], "the failure")
        until(lambda: one.lane.progress is None, "its end")
        assert one.runs()
    assert len(one.said) == 1 and "AttributeError" in one.said[0], "only a fault of the workbench"


def test_a_lane_whose_listener_fails_goes_on(one: Lane) -> None:
    one.fails_to_hear = True
    one.lane.start("one", lambda job: None)
    until(lambda: one.said, "a word of it")
    assert one.runs()


def test_a_job_that_is_stopped_while_it_runs_or_waits_changes_nothing_and_is_not_begun(one: Lane) -> None:
    begun: list[str] = []
    running, go_on = threading.Event(), threading.Event()

    def first(job: Job) -> None:
        begun.append("first")
        one.held.update(job, done=1)
        running.set()
        assert go_on.wait(60)
        one.held.update(job, done=2)
        job.report(1, 2)
        job.check()
        begun.append("went on")

    one.lane.start("first", first)
    assert running.wait(60)
    one.lane.start("second", lambda job: begun.append("second"))
    assert one.lane.progress is not None and one.lane.progress.what == "second"
    one.lane.stop()
    assert one.lane.progress is None, "neither what runs nor what waits is shown"
    go_on.set()
    assert one.runs()
    assert begun == ["first"] and one.held.now == Seen(1, 1) and one.failed == []


def test_the_end_stops_what_runs_and_begins_nothing_more(one: Lane) -> None:
    running, ended = threading.Event(), threading.Event()

    def works_on(job: Job) -> None:
        running.set()
        try:
            while True:
                job.check()
        finally:
            ended.set()

    one.lane.start("works on", works_on)
    assert running.wait(60)
    one.lane.start("waits", lambda job: ended.clear())
    one.lane.close()
    assert ended.is_set()
    one.lane.start("late", lambda job: ended.clear())
    assert ended.is_set() and one.lane.progress is None
