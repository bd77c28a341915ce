"""The worker's activity in shared memory, read while the worker writes it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import pytest

from workbench.live.process.heartbeat import (
    INTERRUPT_SIGNAL,
    Beat,
    HeartbeatReader,
    HeartbeatWriter,
    Interrupts,
    make_heartbeat,
)
from workbench.task.problem import Interrupted

WRITER = """
import sys, time
from workbench.live.process.heartbeat import HeartbeatWriter
writer, end = HeartbeatWriter(int(sys.argv[1])), time.monotonic() + 1
while time.monotonic() < end:
    writer.begin("stepping")
"""


def test_work_never_seems_to_have_begun_before_the_worker(child_process: None) -> None:
    """Else the page says that the worker is busy since the machine was started."""
    heartbeat, started = make_heartbeat(), time.monotonic()
    reader = HeartbeatReader(heartbeat)
    writer = subprocess.Popen([sys.executable, "-c", WRITER, str(heartbeat)], pass_fds=[heartbeat])
    early, numbers = 0, set[int]()
    while writer.poll() is None:
        beat = reader.read()
        early += beat.since < started - 1
        numbers.add(beat.number)
    assert early == 0 and len(numbers) > 1


def test_a_beat_that_is_read_while_the_worker_writes_is_the_one_before_or_after() -> None:
    heartbeat = make_heartbeat()
    reader, writer = HeartbeatReader(heartbeat), HeartbeatWriter(heartbeat)
    memory: list[bytes] = []
    beats: list[Beat] = []
    for doing in ("stepping", "resetting"):
        writer.begin(doing)
        memory.append(os.pread(heartbeat, 4096, 0))
        beats.append(reader.read())
    assert beats[0] != beats[1]
    size = max(at for at, (old, new) in enumerate(zip(*memory)) if old != new) + 1
    for done in range(size + 1):
        os.pwrite(heartbeat, memory[0], 0)
        assert reader.read() == beats[0]
        os.pwrite(heartbeat, memory[1][:done], 0)
        assert reader.read() == beats[done == size]


def test_a_beat_names_the_work_and_who_holds_it() -> None:
    heartbeat = make_heartbeat()
    reader = HeartbeatReader(heartbeat)
    first = reader.read()
    assert (reader.pid, first.number, first.doing, first.held, first.seconds) == (
        0,
        0,
        "starting",
        False,
        0.0,
    )
    writer = HeartbeatWriter(heartbeat)
    assert reader.pid == os.getpid()
    writer.begin("stepping")
    writer.begin("resetting")
    beat = reader.read()
    assert (beat.number, beat.doing) == (2, "resetting") and 0 < beat.seconds < 60
    writer.hold(True)
    assert reader.read().held
    writer.begin("idle")
    writer.hold(False)
    beat = reader.read()
    assert (beat.number, beat.doing, beat.seconds, beat.held) == (3, "idle", 0.0, False)


def test_an_interrupt_stops_only_code_that_may_be_stopped() -> None:
    interrupts = Interrupts()
    before = signal.getsignal(INTERRUPT_SIGNAL)
    interrupts.install()

    def stop() -> None:
        signal.raise_signal(INTERRUPT_SIGNAL)

    try:
        stop()  # between two pieces of work
        interrupts.begin()
        interrupts.allowed = True
        with interrupts.shielded():
            assert not interrupts.allowed
        assert interrupts.allowed, "the one of before is forgotten"
        with pytest.raises(Interrupted):
            stop()
        done = []
        with pytest.raises(Interrupted), interrupts.shielded():
            stop()
            done.append("to its end")
        assert done and interrupts.allowed
        with interrupts.shielded():
            done.append("once")
        interrupts.allowed = False
        stop()
        with interrupts.shielded():
            done.append("ours")
        assert done == ["to its end", "once", "ours"]
    finally:
        signal.signal(INTERRUPT_SIGNAL, before)
