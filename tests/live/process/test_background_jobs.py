"""Background jobs of a session: one at a time, stoppable at any time, each failing alone; and the loop that runs them."""

from __future__ import annotations

import asyncio
import subprocess
import sys
import threading
import time
from collections.abc import Awaitable, Callable, Iterator

import pytest

from tests.drive.waiting import until
from workbench.live.process.background_jobs import Job, JobFailed, JobProgress, Jobs
from workbench.machine import loop
from workbench.machine.processes.watched_thread import listen, stop_listening


class Seen:
    """Background jobs, and what a page sees of them."""

    def __init__(self) -> None:
        self.failed: list[str] = []
        self.said: list[str] = []
        self.jobs = Jobs(lambda: None, lambda failure: self.failed.append(str(failure)))

    def start(self, what: str, work: Callable[[Job], Awaitable[None]]) -> None:
        loop.do(lambda: self.jobs.start(what, work))

    def progress(self) -> JobProgress | None:
        return loop.do(lambda: self.jobs.progress)

    def runs(self) -> bool:
        """Whether a job that is started now finishes."""
        done = threading.Event()

        async def work(job: Job) -> None:
            done.set()

        self.start("the next", work)
        return done.wait(60)


@pytest.fixture
def seen() -> Iterator[Seen]:
    seen = Seen()
    listen(seen.said.append)
    yield seen
    loop.do(seen.jobs.close)
    stop_listening(seen.said.append)


def test_progress_counts_only_if_there_is_something_to_count() -> None:
    texts = [JobProgress("drawing", done, total).text for done, total in ((0, 0), (0, 1), (1, 2))]
    assert texts == ["drawing", "drawing", "drawing, 1 of 2"]


def test_a_failed_job_is_reported_and_the_next_one_runs(seen: Seen) -> None:
    async def broken(job: Job) -> None:
        raise AttributeError("no such thing")

    async def refuses(job: Job) -> None:
        raise JobFailed("not today")

    for work, words in ((broken, "no such thing"), (refuses, "not today")):
        seen.start("counting", work)
        until(lambda words=words: seen.failed and words in seen.failed[-1], "the failure")
        assert seen.progress() is None
        assert seen.runs()
    assert len(seen.said) == 1 and "AttributeError" in seen.said[0], "only a fault of the workbench is logged"


def test_a_stopped_job_changes_nothing_more_and_a_pending_one_never_starts(seen: Seen) -> None:
    done: list[str] = []

    async def works_on(job: Job) -> None:
        done.append("begins")
        job.report(1, 2, "half of it")
        try:
            await asyncio.sleep(600)
        finally:
            done.append("tidies up")
        done.append("goes on")

    async def never(job: Job) -> None:
        done.append("never")

    def begin_and_stop() -> None:
        seen.jobs.start("second", never)
        assert seen.jobs.progress == JobProgress("second", 0, 0)
        seen.jobs.stop()
        assert seen.jobs.progress is None

    seen.start("first", works_on)
    until(lambda: seen.progress() == JobProgress("half of it", 1, 2), "that it is under way")
    loop.do(begin_and_stop)
    assert seen.runs()
    assert done == ["begins", "tidies up"] and seen.failed == []


def test_no_job_starts_after_close(seen: Seen) -> None:
    ended = threading.Event()

    async def works_on(job: Job) -> None:
        try:
            await asyncio.sleep(600)
        finally:
            ended.set()

    seen.start("works on", works_on)
    until(lambda: seen.progress() is not None, "that it is under way")
    loop.do(lambda: None)
    loop.do(seen.jobs.close)
    assert ended.wait(60)
    seen.start("too late", works_on)
    assert seen.progress() is None


# --- the loop ------------------------------------------------------------------------------------------


def test_changes_from_any_thread_run_one_at_a_time() -> None:
    count = 0

    def change() -> None:
        nonlocal count
        before = count
        time.sleep(0.0001)  # lets another thread run here
        count = before + 1

    threads = [threading.Thread(target=lambda: [loop.do(change) for _ in range(100)]) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert count == 800


def test_an_exception_in_a_change_reaches_its_caller_and_the_loop_goes_on() -> None:
    def fails() -> None:
        raise LookupError("nothing there")

    said: list[str] = []
    listen(said.append)
    try:
        with pytest.raises(LookupError):
            loop.do(fails)
        loop.post(fails)
        until(lambda: said, "a word of it")
        assert loop.do(lambda: loop.do(lambda: 7)) == 7, "also from the loop itself"
    finally:
        stop_listening(said.append)


@pytest.mark.parametrize(
    ("does", "comes_to"),
    [
        (
            "on_signal(signal.SIGUSR1, got.set); os.kill(os.getpid(), signal.SIGUSR1); assert got.wait(60)",
            "done, on the loop: True, here: False",
        ),
        ("os.kill(os.getpid(), signal.SIGINT); got.wait()", "interrupted"),
        ("raise LookupError('nothing there')", "nothing there"),
    ],
)
def test_a_command_may_block_while_the_main_thread_runs_the_loop_and_its_signals(
    child_process: None, does: str, comes_to: str
) -> None:
    script = f"""
import os, signal, threading
from workbench.machine.loop import do, loop_in_main, on_signal

def is_main():
    return threading.current_thread() is threading.main_thread()

@loop_in_main
def command(word):
    got = threading.Event()
    {does}
    return f"{{word}}, on the loop: {{do(is_main)}}, here: {{is_main()}}"

try:
    print(command("done"))
except LookupError as error:
    print(*error.args)
except KeyboardInterrupt:
    print("interrupted")
"""
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60)
    assert (ended.stdout.strip(), ended.stderr) == (comes_to, "")


def test_a_wait_for_work_of_the_loop_can_be_given_up() -> None:
    ended = threading.Event()

    async def work() -> None:
        try:
            await asyncio.sleep(600)
        finally:
            ended.set()

    def check() -> None:
        raise TimeoutError("long enough")

    with pytest.raises(TimeoutError, match="long enough"):
        loop.result_of(work(), check)
    assert ended.wait(60)


def test_blocking_work_keeps_its_order_and_does_not_block_the_loop() -> None:
    aside, goes_on, done = loop.BlockingPool("test"), threading.Event(), list[int]()

    async def work(number: int) -> None:
        await aside.run(lambda: goes_on.wait(60))
        done.append(number)

    for number in range(3):
        loop.do(lambda number=number: loop.begin(work(number)))
    assert loop.do(lambda: 7) == 7
    goes_on.set()
    until(lambda: len(done) == 3, "all of it")
    assert done == [0, 1, 2]
    aside.close()
