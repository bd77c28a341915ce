"""The worker's activity in shared memory, read while the worker writes it."""

from __future__ import annotations

import subprocess
import sys
import time

from workbench.live.process.heartbeat import HeartbeatReader, make_heartbeat

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
    assert early == 0 and len(numbers) > 100
