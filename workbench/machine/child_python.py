"""Starts every Python process of the workbench, so that none of them imports from the current folder."""

from __future__ import annotations

import os
import sys


def python_command(*arguments: str) -> list[str]:
    """The command line of a child of this interpreter, such as ``python_command("-m", "workbench.session.worker_start")``.

    Plain ``-m`` and ``-c`` put the current folder first on ``sys.path``: a ``numpy.py`` in a downloaded folder of
    recordings would run as soon as ``workbench review .`` starts a process there. ``-P`` leaves that folder out.
    """
    return [sys.executable, "-P", *arguments]


def child_environment(**further: str) -> dict[str, str]:
    """The environment of such a child, with ``further`` variables.

    An empty entry of ``PYTHONPATH`` means the current folder, and ``PYTHONPATH=:/opt/lib`` has one by accident.
    """
    environment = {**os.environ, **further}
    entries = [entry for entry in environment.pop("PYTHONPATH", "").split(os.pathsep) if entry]
    return environment if not entries else {**environment, "PYTHONPATH": os.pathsep.join(entries)}
