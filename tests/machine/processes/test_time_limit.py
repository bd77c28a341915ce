"""Native code that does not return in time ends its process with a message."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import pytest

pytestmark = pytest.mark.usefixtures("child_process")

# PyDLL keeps the GIL, as SAPIEN does while it waits for a picture.
NATIVE = """
import ctypes
from workbench.machine.processes.time_limit import end_after, limited
sleep = ctypes.PyDLL(None).sleep
"""


def run(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", NATIVE + code],
        capture_output=True,
        text=True,
        timeout=90,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )


def test_native_code_that_hangs_ends_the_process_with_its_message() -> None:
    ended = run("end_after(0.5)\nwith limited('the picture of eye'): sleep(50)")
    assert ended.returncode == -signal.SIGKILL
    assert ended.stderr.strip() == "the picture of eye"


@pytest.mark.slow
def test_only_time_within_the_block_counts_whether_it_returns_or_raises() -> None:
    short = "try:\n    with limited('short'): sleep(1); raise OSError\nexcept OSError: sleep(2)\n"
    ended = run(f"with limited('no limit yet'): sleep(0)\nend_after(1.8)\n{short * 2}print('over')")
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "over\n", "")
