"""Starts Python child processes, and speeds up slow imports."""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager


def python_command(*arguments: str) -> list[str]:
    """The command line of a child of this interpreter, such as ``python_command("-m", "workbench.session.worker.start")``.

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


@contextmanager
def quick_imports() -> Iterator[None]:
    """Look for no garbage meanwhile, and never again among what was imported: torch, ManiSkill and rerun take a quarter less.

    Of a million objects that are made then ten thousand are garbage. Afterwards BaseEnv would look through the rest at
    every build and every close: 0.25 s each, most of a reload of 16 envs.
    """
    before, enabled = len(sys.modules), gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if len(sys.modules) > before:  # else what others have left by now would be kept with it
            gc.freeze()
        if enabled:
            gc.enable()
