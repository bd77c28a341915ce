"""However ``workbench open`` ends, it leaves no process behind, whatever its worker is doing."""

from __future__ import annotations

import signal
import time
from pathlib import Path

import psutil
import pytest

from tests.browser.opened import open_workbench
from tests.session.hazards import provoke, provoked, write_task

PATIENCE = 15.0


def gone(processes: list[psutil.Process]) -> bool:
    _, alive = psutil.wait_procs(processes, timeout=PATIENCE)
    return not alive


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL], ids=["ctrl-c", "kill -9"])
def test_a_worker_that_hangs_ends_with_its_server(tmp_path: Path, number: signal.Signals) -> None:
    file = write_task(tmp_path)
    provoke(file, "build", "catch")
    with open_workbench(str(file), "--num-envs", "1", "--no-spare", cwd=tmp_path) as opened:
        server = psutil.Process(opened.process.pid)
        deadline = time.monotonic() + 60
        while not provoked(file):
            assert time.monotonic() < deadline, "the task was not built"
            time.sleep(0.1)
        (worker,) = server.children(recursive=True)
        began = time.monotonic()
        server.send_signal(number)
        assert gone([server, worker])
        print(f"{number.name}: all gone after {time.monotonic() - began:.2f} s")
