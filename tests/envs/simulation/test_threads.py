"""The threads that step envs run each env once, pass errors to the caller and survive a fork."""

from __future__ import annotations

import os
import threading
from collections import Counter

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from workbench.envs.simulation.stepping import EnvThreads, env_threads

shared = EnvThreads()


@settings(max_examples=50)
@given(count=st.integers(0, 40), threads=st.integers(1, 6))
def test_every_env_is_run_once(count: int, threads: int) -> None:
    done: list[int] = []
    shared.run(done.append, count, threads)
    assert Counter(done) == Counter(range(count))


def test_work_is_spread_over_threads() -> None:
    meeting = threading.Barrier(3, timeout=60)
    names: set[str] = set()

    def job(_: int) -> None:
        names.add(threading.current_thread().name + str(threading.get_ident()))
        meeting.wait()  # passes only if three threads wait at once

    shared.run(job, 3, 3)
    assert len(names) == 3


def test_an_error_in_any_thread_reaches_the_caller_after_all_envs_ran() -> None:
    """Covers each helper thread and the caller's own thread, which waits for the helpers."""
    meeting = threading.Barrier(3)
    failing, done = [0], []

    def job(index: int) -> None:
        meeting.wait(timeout=60)  # waits for all three threads
        if threading.get_ident() == failing[0]:
            raise ValueError(f"env {index}")
        done.append(threading.get_ident())

    for turn in range(3):
        failing[0] = 0
        done.clear()
        shared.run(job, 3, 3)
        assert len(set(done)) == 3, "the threads must be usable after an error"
        failing[0] = sorted(done)[turn]
        done.clear()
        with pytest.raises(ValueError, match=r"env [0-2]"):
            shared.run(job, 3, 3)
        assert len(done) == 2


def test_concurrent_callers_wait_for_each_other() -> None:
    sums = [0, 0]

    def caller(which: int) -> None:
        for _ in range(200):
            done: list[int] = []
            shared.run(done.append, 5, 3)
            sums[which] += sum(done)

    callers = [threading.Thread(target=caller, args=(i,)) for i in range(2)]
    for thread in callers:
        thread.start()
    for thread in callers:
        thread.join(timeout=30)
    assert sums == [2000, 2000]


def test_a_forked_child_gets_its_own_threads(child_process: None) -> None:
    env_threads().run(lambda _: None, 4, 2)
    child = os.fork()
    if child == 0:
        done: list[int] = []
        env_threads().run(done.append, 4, 2)
        os._exit(0 if sorted(done) == [0, 1, 2, 3] else 1)
    _, status = os.waitpid(child, 0)
    assert os.waitstatus_to_exitcode(status) == 0
