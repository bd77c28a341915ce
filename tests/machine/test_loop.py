"""Changes on the loop: one after the other, with their results and failures."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator
from concurrent.futures import Future
from typing import Any

import pytest

from tests.drive.waiting import TIMEOUT_SECONDS, until
from workbench.machine.loop import (
    BlockingPool,
    ChangeCounter,
    begin,
    do,
    is_here,
    later,
    on_loop,
    post,
    result_of,
    submit,
    wait_for_disk,
)
from workbench.machine.processes.watched_thread import listen, stop_listening


@pytest.fixture
def reports() -> Iterator[list[str]]:
    reports: list[str] = []
    listen(reports.append)
    yield reports
    stop_listening(reports.append)


class Counted:
    """A number that changes only on the loop."""

    def __init__(self) -> None:
        self.count, self.elsewhere = 0, 0

    @on_loop
    def add(self, number: int) -> int:
        self.elsewhere += not is_here()
        before = self.count
        self.count = before + number
        return self.count


def test_changes_of_several_threads_run_on_the_loop_and_none_is_lost() -> None:
    counted = Counted()
    threads = [threading.Thread(target=lambda: [counted.add(1) for _ in range(200)]) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(TIMEOUT_SECONDS)
    assert (counted.count, counted.elsewhere) == (800, 0) and not is_here()
    # A change may make another one at once.
    assert do(lambda: counted.add(1) + counted.add(1)) == 801 + 802


def test_an_error_of_a_change_is_raised_or_reported(reports: list[str]) -> None:
    def fail() -> None:
        raise KeyError("no such thing")

    with pytest.raises(KeyError):
        do(fail)
    assert not reports
    post(fail)
    until(lambda: reports, "the report")
    assert "no such thing" in reports[0]

    async def failing() -> None:
        fail()

    with pytest.raises(KeyError):
        result_of(failing())

    async def forgotten() -> None:
        begin(failing())

    result_of(forgotten())
    until(lambda: len(reports) > 1, "the report of a task that nobody awaits")
    assert "no such thing" in reports[1]


def test_posted_changes_run_in_order_and_a_timer_can_be_cancelled() -> None:
    order: list[Any] = []

    def begin() -> None:
        later(0.01, lambda: order.append("kept"))
        later(0.01, lambda: order.append("cancelled")).cancel()

    do(begin)
    for number in range(50):
        post(lambda number=number: order.append(number))
    do(lambda: None)
    until(lambda: "kept" in order, "the timer", seen=lambda: order)
    assert [one for one in order if one != "kept"] == list(range(50))


def test_a_failed_check_cancels_the_work_that_is_waited_for() -> None:
    ended: list[str] = []

    async def endless() -> None:
        try:
            await asyncio.Event().wait()
        except asyncio.CancelledError:
            ended.append("cancelled")
            raise

    def check() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        result_of(endless(), check)
    until(lambda: ended, "the cancellation")
    assert ended == ["cancelled"]


def test_blocking_calls_run_one_after_the_other_and_end_with_their_results() -> None:
    pool, order, go_on = BlockingPool("test"), list[int](), threading.Event()

    def call(number: int) -> int:
        if number == 0:
            go_on.wait(TIMEOUT_SECONDS)
        if number == 2:
            raise OSError("the disk is full")
        order.append(number)
        return number

    calls = do(lambda: [pool.begin(lambda k=k: call(k)) for k in range(5)])
    assert calls[3].cancel() and not order
    wait_for_disk(None)
    do(lambda: wait_for_disk(calls[0]))  # the loop must not wait
    go_on.set()
    pool.close()
    wait_for_disk(calls[4])
    assert order == [0, 1, 4] and calls[4].result(0) == 4
    assert isinstance(calls[2].exception(0), OSError)
    assert do(lambda: pool.begin(lambda: call(6))).cancelled() and 6 not in order


def test_a_pool_that_is_closed_while_its_first_call_begins_runs_or_cancels_that_call() -> None:
    """As when the session ends just after a save began."""

    async def begin(pool: BlockingPool) -> Future[int]:
        return pool.begin(lambda: 1)

    for _ in range(300):
        pool = BlockingPool("test")
        began = submit(begin(pool))
        pool.close()
        call = began.result(TIMEOUT_SECONDS)
        assert call.cancelled() or call.result(TIMEOUT_SECONDS) == 1


def test_a_page_waits_until_the_count_differs_or_all_ends() -> None:
    changes = ChangeCounter()
    assert changes.wait(0, timeout=0) == 0
    changes.notify()
    assert changes.wait(0, timeout=TIMEOUT_SECONDS) == 1
    seen: list[int] = []
    waiting = threading.Thread(target=lambda: seen.append(changes.wait(1, TIMEOUT_SECONDS)))
    waiting.start()
    changes.notify()
    waiting.join(TIMEOUT_SECONDS)
    assert seen == [2]
    waiting = threading.Thread(target=lambda: seen.append(changes.wait(2, TIMEOUT_SECONDS)))
    waiting.start()
    changes.close()
    waiting.join(TIMEOUT_SECONDS / 2)
    assert seen == [2, 2] and changes.wait(2, TIMEOUT_SECONDS) == 2
