"""`on_free_cores` runs threads with idle priority."""

from __future__ import annotations

import os
import threading

from tests.drive.waiting import until
from workbench.machine.processes.watched_thread import on_free_cores


def policies() -> set[int]:
    return {os.sched_getscheduler(int(thread)) for thread in os.listdir("/proc/self/task")}


def test_threads_have_idle_priority_until_the_block_ends_or_another_thread_waits() -> None:
    began: list[int] = []
    waits = threading.Event()
    with on_free_cores(waits.is_set):
        thread = threading.Thread(target=lambda: began.append(os.sched_getscheduler(0)))
        thread.start()
        thread.join()
        assert began == [os.sched_getscheduler(0)] == [os.SCHED_IDLE], (
            "threads started within the block have idle priority, too"
        )
        waits.set()
        until(lambda: policies() == {os.SCHED_OTHER}, "normal priority")
    with on_free_cores(lambda: False):
        assert os.sched_getscheduler(0) == os.SCHED_IDLE
    assert policies() == {os.SCHED_OTHER}
