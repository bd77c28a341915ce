"""Starts Python child processes; speeds up slow imports and undoes their changes of the environment."""

from __future__ import annotations

import gc
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

LOWEST_NICENESS = 19
"""Niceness of a process that gets only the CPU time that all others leave."""


def python_command(*arguments: str) -> list[str]:
    """Command line of a child of this interpreter: ``python_command("-m", "workbench.app.worker.start")``.

    Plain ``-m`` and ``-c`` put the current folder first on ``sys.path``: a ``numpy.py`` in a downloaded folder of
    recordings would run as soon as ``workbench review .`` starts a process there. ``-P`` leaves that folder out.
    """
    return [sys.executable, "-P", *arguments]


def script_command(script: str, *arguments: str) -> list[str]:
    """Command line of a child that runs a file with only the standard library. Such a child starts in some
    milliseconds."""
    return [sys.executable, "-I", "-S", script, *arguments]


def child_environment(**further: str) -> dict[str, str]:
    """Environment of a Python child process, with ``further`` variables.

    Drops empty entries of ``PYTHONPATH``, which mean the current folder (``PYTHONPATH=:/opt/lib`` has one).
    """
    environment = {**os.environ, **further}
    entries = [entry for entry in environment.pop("PYTHONPATH", "").split(os.pathsep) if entry]
    return environment if not entries else {**environment, "PYTHONPATH": os.pathsep.join(entries)}


def start_with_socket(
    module: str, environment: dict[str, str], new_session: bool = False
) -> tuple[subprocess.Popen[bytes], socket.socket]:
    """Start ``python -m MODULE SOCKET`` without output; returns the process and the end of the socket that
    stays here. The socket keeps message boundaries.

    Ctrl-C in the terminal does not reach the child, because this process still needs the child. Raises
    OSError.

    Args:
        new_session: start the child in its own session, not only in its own process group.
    """
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with theirs:
        try:
            process = subprocess.Popen(
                python_command("-m", module, str(theirs.fileno())),
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
                process_group=None if new_session else 0,
                start_new_session=new_session,
            )
        except OSError:
            ours.close()
            raise
    return process, ours


@contextmanager
def unchanged_environment() -> Iterator[None]:
    """Context that undoes the changes that imports make to environment variables: children would inherit
    these changes, and a worker is forked only if its environment equals the first worker's."""
    before = dict(os.environ)
    try:
        yield
    finally:
        for name in {*before, *os.environ}:
            if name not in before:
                del os.environ[name]
            elif os.environ.get(name) != before[name]:
                os.environ[name] = before[name]


@contextmanager
def quick_imports() -> Iterator[None]:
    """Context for imports without garbage collection. Later collections skip the objects that the imports
    made.

    Importing torch, ManiSkill and rerun then takes a quarter less time: of the million objects that these
    imports make, only ten thousand are garbage. BaseEnv starts a collection at every build and close. If a
    collection did not skip these objects, it would take 0.25 s, most of the time of a reload of 16 envs.
    """
    before, enabled = len(sys.modules), gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if len(sys.modules) > before:  # without imports, only unrelated garbage would be frozen
            gc.freeze()
        if enabled:
            gc.enable()
