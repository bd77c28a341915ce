"""rerun's command as a process of ours: a port for it, when it answers, and its end."""

from __future__ import annotations

import socket
import subprocess
import time

LOOPBACK = "127.0.0.1"
START_SECONDS = 20.0


def free_port() -> int:
    """A loopback port that was free a moment ago; rerun cannot be told to pick one and say which."""
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return probe.getsockname()[1]


def await_port(process: subprocess.Popen[bytes], port: int) -> None:
    """Return when `process` listens on `port`.

    Raises:
        RuntimeError: it ended before, or took too long (and was ended).
    """
    deadline = time.monotonic() + START_SECONDS
    while time.monotonic() < deadline:
        if process.poll() is not None:
            raise RuntimeError(f"rerun ended with {process.returncode} before it was ready.")
        try:
            socket.create_connection((LOOPBACK, port), timeout=1.0).close()
            return
        except OSError:
            time.sleep(0.05)
    end(process)
    raise RuntimeError(f"rerun was not ready within {START_SECONDS:.0f} s.")


def end(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(timeout=5.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
