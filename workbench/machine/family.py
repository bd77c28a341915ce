"""Whatever a worker starts ends with it: a process above it adopts what detaches itself, and ends it all.

A task may start processes that leave the worker's group (``setsid``) or its family (two forks, as a daemon does). Nothing
finds those once the worker is gone: their parent is the system's first process, and what they say of themselves can
be changed. So each worker is the child of a keeper, which is the *subreaper*: what loses its parent below it becomes its
child. When the worker ends, or the server asks (SIGTERM) or is gone, the keeper kills its children until it has none, and
ends as the worker did. It kills nothing else, since a child's number is free for another only when its parent took note of the end.

The keeper is a fork from the moment before anything is imported: one system call, and 6 MB of its own. Against a
cgroup it needs no rights, which a container or a login by ssh does not give, and the server's own children stay out of it.
"""

from __future__ import annotations

import ctypes
import importlib
import os
import signal
import subprocess
import sys
import time
from typing import NoReturn

from workbench.machine.process_tree import children

_PR_SET_PDEATHSIG, _PR_SET_DUMPABLE, _PR_SET_CHILD_SUBREAPER = 1, 4, 36
_LONGEST_END = 5.0
"""Seconds in which what was killed must be gone; a process that waits for a disk may not be."""
_SIGNALS = {signal.SIGCHLD, signal.SIGTERM}


def main() -> None:
    """``python -m workbench.machine.family SERVER MODULE ARGUMENT...``: the family of a process that is ``MODULE.main()``."""
    begin_family(int(sys.argv.pop(1)))
    importlib.import_module(sys.argv[1]).main(*sys.argv[2:])


def begin_family(server: int) -> None:
    """Go on in a child of this process; the process itself never returns from here, and is its keeper.

    To be called before any thread is started.

    Args:
        server: process id of the parent. The keeper ends its family when that is gone, however it went.
    """
    libc = ctypes.CDLL(None)
    # Until we wait for them they would be lost, and SIGTERM would end us before there is anything to end.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
    signal.signal(
        signal.SIGCHLD, signal.SIG_DFL
    )  # whoever started us may have it ignored: then nobody is reaped
    libc.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != server:
        sys.exit("the server is gone")
    libc.prctl(_PR_SET_CHILD_SUBREAPER, 1)
    keeper = os.getpid()
    worker = os.fork()
    if worker != 0:
        _keep(worker)
    # A group of its own: what the author's code sends to its group is not for the keeper.
    os.setsid()
    end_with_parent(keeper)
    signal.pthread_sigmask(signal.SIG_SETMASK, before)


def end_with_parent(parent: int) -> None:
    """Ask the kernel to end this process with `parent`, which must be the process that made it and have one thread."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)


def end_family(keeper: subprocess.Popen[bytes]) -> None:
    """End a process that called `begin_family`, with all that it started; returns when all is gone."""
    keeper.terminate()
    try:
        keeper.wait(timeout=2 * _LONGEST_END)
    except subprocess.TimeoutExpired:
        # Somebody stopped it. The worker ends with it; what was detached does not.
        keeper.kill()
        keeper.wait()


def describe_exit(code: int | None) -> str:
    """In words: ``was killed by SIGSEGV``, ``ended with exit code 3``."""
    if code is None:
        return "stopped answering"
    if code < 0:
        # Not every signal has a name: of the real-time ones only the first and the last.
        named = -code in set(signal.Signals)
        return f"was killed by {signal.Signals(-code).name if named else f'signal {-code}'}"
    return f"ended with exit code {code}"


def _keep(worker: int) -> NoReturn:
    # The server sees the worker's end by the end of what they share.
    for fd in sorted(map(int, os.listdir("/proc/self/fd"))):
        if fd > 2:
            try:
                os.close(fd)
            except OSError:
                pass  # the one that the folder was read with
    os.dup2(0, 1)
    os.dup2(0, 2)
    status = None
    while status is None:
        if signal.sigwait(_SIGNALS) == signal.SIGTERM:
            break
        status = _reap().get(worker)
    ended = _end_all()
    _leave_with(ended.get(worker, status))


def _end_all() -> dict[int, int]:
    """Kill all children, and those that become ours by that; their exit statuses."""
    ended: dict[int, int] = {}
    deadline = time.monotonic() + _LONGEST_END
    while (ours := children(os.getpid())) and time.monotonic() < deadline:
        for pid in ours:
            os.kill(pid, signal.SIGKILL)  # a zombie at least: only we reap it
        ended |= _reap()
        signal.sigtimedwait(_SIGNALS, 0.005)
    return ended | _reap()


def _reap() -> dict[int, int]:
    ended: dict[int, int] = {}
    try:
        while True:
            pid, status = os.waitpid(-1, os.WNOHANG)
            if pid == 0:
                return ended
            ended[pid] = status
    except ChildProcessError:
        return ended


def _leave_with(status: int | None) -> NoReturn:
    if status is not None and os.WIFEXITED(status):
        os._exit(os.WEXITSTATUS(status))
    number = signal.SIGKILL if status is None else os.WTERMSIG(status)
    if number != signal.SIGKILL:
        signal.signal(number, signal.SIG_DFL)
        ctypes.CDLL(None).prctl(_PR_SET_DUMPABLE, 0)  # the worker has left its core
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [number])
    os.kill(os.getpid(), number)
    time.sleep(1.0)
    os._exit(1)


if __name__ == "__main__":
    main()
