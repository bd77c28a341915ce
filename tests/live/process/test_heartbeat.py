"""The worker's activity in shared memory, read while the worker writes it."""

from __future__ import annotations

import os
import subprocess
import sys
import time

from workbench.live.process.heartbeat import Beat, HeartbeatReader, HeartbeatWriter, make_heartbeat

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
