"""A worker process and its queue."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

from workbench.live.messages import Event, Load, Loaded, SingleStep
from workbench.live.process.worker_process import WorkerProcess
from workbench.task.description import TaskOptions

TASK = Path(__file__).parents[3] / "tasks" / "minimal.py"


def test_a_held_key_while_the_worker_reads_nothing_loses_no_later_request(
    child_process: None,
) -> None:
    worker = WorkerProcess(lambda name, text: False)
    events: list[Event] = []
    try:
        os.kill(worker.pid, signal.SIGSTOP)
        for _ in range(20_000):  # far more than the socket takes
            worker.send(SingleStep())
        worker.send(Load(str(TASK), TaskOptions(1, "cpu", env_kwargs={"render_backend": "none"})))
        os.kill(worker.pid, signal.SIGCONT)
        deadline = time.monotonic() + 90
        while not any(isinstance(event, Loaded) for event in events):
            assert time.monotonic() < deadline, events[-5:]
            event = worker.receive(1.0)
            events += [event] if event is not None else []
    finally:
        worker.kill()
