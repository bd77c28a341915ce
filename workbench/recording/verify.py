"""Rerun's own command, which the wheel brings along: found, run quietly, and asked for a verdict."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import rerun_cli

_BINARIES = ("rerun", "rerun.exe", "Rerun.app/Contents/MacOS/Rerun")


def rerun_command() -> list[str]:
    """The command of the rerun that this interpreter imports.

    A ``rerun`` on PATH may belong to another environment and another version, and file and viewer go
    together by version. The program itself and not ``python -m rerun_cli``: that one forgets the exit
    status (rerun 0.41), and ending it would leave the program that it started behind.
    """
    for folder in rerun_cli.__path__:
        for name in _BINARIES:
            if (program := Path(folder, name)).is_file():
                return [os.fspath(program)]
    return [sys.executable, "-m", "rerun"]


def quiet_environment() -> dict[str, str]:
    """The environment in which rerun's command sends no usage statistics.

    Rerun has no variable for just that; but where ``CI`` is set it neither sends nor asks, and leaves
    the person's own settings for rerun as they are (rerun 0.41, crate re_analytics).
    """
    environment = dict(os.environ)
    environment.pop("FORCE_RERUN_ANALYTICS", None)
    environment["CI"] = "true"
    return environment


def verify_rrd(path: Path, timeout: float = 60.0) -> str | None:
    """Let rerun judge the file at `path`: None where it is well, else what rerun said against it.

    Raises:
        FileNotFoundError: there is no such file.
        subprocess.TimeoutExpired: no verdict within `timeout` seconds.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"{path} is not a file.")
    verdict = subprocess.run(
        [*rerun_command(), "rrd", "verify", os.fspath(path)],
        env=quiet_environment(),
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=timeout,
        check=False,
    )
    if verdict.returncode == 0:
        return None
    return (verdict.stderr + verdict.stdout).strip() or f"rerun rrd verify ended with {verdict.returncode}"
