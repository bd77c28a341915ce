"""Rerun's own command, which the wheel brings along, as a process of ours: found, run quietly, a port for it, its end."""

from __future__ import annotations

import os
import socket
import subprocess
import time
from pathlib import Path

import rerun_cli

from workbench.machine.child_python import child_environment, python_command

LOOPBACK = "127.0.0.1"
START_SECONDS = 20.0


def rerun_command() -> list[str]:
    """The command of the rerun that this interpreter imports.

    A ``rerun`` on PATH may belong to another environment and another version, and file and viewer go
    together by version. The program itself and not ``python -m rerun_cli``: that one forgets the exit
    status (rerun 0.41), and ending it would leave the program that it started behind.
    """
    for folder in rerun_cli.__path__:
        if (program := Path(folder, "rerun")).is_file():
            return [os.fspath(program)]
    return python_command("-m", "rerun")


def quiet_environment() -> dict[str, str]:
    """The environment in which rerun's command sends no usage statistics.

    Rerun has no variable for just that; but where ``CI`` is set it neither sends nor asks, and leaves
    the person's own settings for rerun as they are (rerun 0.41, crate re_analytics).
    """
    environment = child_environment(CI="true")
    environment.pop("FORCE_RERUN_ANALYTICS", None)
    return environment


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
