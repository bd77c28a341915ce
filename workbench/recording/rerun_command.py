"""Rerun's own command, which the wheel brings along: found, and run quietly."""

from __future__ import annotations

import os
from pathlib import Path

import rerun_cli

from workbench.machine.child_python import child_environment, python_command

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
    return python_command("-m", "rerun")


def quiet_environment() -> dict[str, str]:
    """The environment in which rerun's command sends no usage statistics.

    Rerun has no variable for just that; but where ``CI`` is set it neither sends nor asks, and leaves
    the person's own settings for rerun as they are (rerun 0.41, crate re_analytics).
    """
    environment = child_environment(CI="true")
    environment.pop("FORCE_RERUN_ANALYTICS", None)
    return environment
