"""Threads that leave the cores to others."""

from __future__ import annotations

import os
import threading

from tests.drive.waiting import until
from workbench.machine.processes.watched_thread import on_free_cores


def policies() -> set[int]:
    return {os.sched_getscheduler(int(thread)) for thread in os.listdir("/proc/self/task")}


def test_all_threads_are_low_within_and_as_before_afterwards_or_as_soon_as_somebody_waits() -> None:
    began: list[int] = []
    waits = threading.Event()
    with on_free_cores(waits.is_set):
        thread = threading.Thread(target=lambda: began.append(os.sched_getscheduler(0)))
        thread.start()
        thread.join()
        assert began == [os.sched_getscheduler(0)] == [os.SCHED_IDLE], "one that is started within is low too"
        waits.set()
        until(lambda: policies() == {os.SCHED_OTHER}, "the end of it")
    with on_free_cores(lambda: False):
        assert os.sched_getscheduler(0) == os.SCHED_IDLE
    assert policies() == {os.SCHED_OTHER}
