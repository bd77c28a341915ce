"""Lets rerun verify an ``.rrd``."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

from workbench.episodes.rerun.viewer import quiet_environment, rerun_command


def verify_rrd(path: Path, timeout: float = 60.0) -> str | None:
    """Let rerun verify the file at `path`; returns None if it is valid, else rerun's error text.

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
