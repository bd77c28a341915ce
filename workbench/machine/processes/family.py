"""Reads process trees from ``/proc``, and ends them as a whole."""

from __future__ import annotations

import ctypes
import importlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import IO, NoReturn, Protocol

_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")


def children(pid: int) -> list[int]:
    """Process ids of a process's children, including zombies; empty if the process is gone."""
    found: list[int] = []
    try:
        for thread in os.listdir(f"/proc/{pid}/task"):
            found += map(int, _read(f"/proc/{pid}/task/{thread}/children").split())
    except FileNotFoundError:
        # The kernel lacks that file, or a thread or the process has ended.
        return _children_by_parent(pid)
    except OSError:
        return found
    return found


def family(pid: int) -> list[int]:
    """Process ids of a process and all its descendants."""
    members = {pid: None}
    waiting = [pid]
    while waiting:
        new = [child for child in children(waiting.pop()) if child not in members]
        members |= dict.fromkeys(new)
        waiting += new
    return list(members)


def resident_memory(pid: int) -> int:
    """Resident bytes of the process, including shared ones; 0 if the process is gone."""
    try:
        return int(_read(f"/proc/{pid}/statm").split()[1]) * _PAGE_BYTES
    except (OSError, IndexError):
        return 0


def allocated_memory(pid: int) -> int:
    """Resident bytes without mapped files; 0 if the process is gone. Mapped libraries are not counted: the
    kernel may drop hundreds of megabytes of them while the process allocates other memory."""
    try:
        _, resident, shared, *_ = _read(f"/proc/{pid}/statm").split()
        return (int(resident) - int(shared)) * _PAGE_BYTES
    except (OSError, ValueError):
        return 0


def proportional_memory(pids: Iterable[int]) -> int:
    """Total memory of these processes in bytes (PSS); shared pages count once.

    Takes milliseconds for a process of 1 GB.
    """
    return sum(map(_proportional, pids))


def main_thread_ended(pid: int) -> bool:
    """Whether the main thread of the process has ended while other threads still run; also True for a moment
    during any exit."""
    try:
        return _state_and_parent(pid)[0] == "Z" and len(os.listdir(f"/proc/{pid}/task")) > 1
    except OSError:
        return False


def _proportional(pid: int) -> int:
    try:
        for line in _read(f"/proc/{pid}/smaps_rollup").splitlines():
            if line.startswith(b"Pss:"):
                return int(line.split()[1]) * 1024
    except (OSError, ValueError):
        # The process belongs to another user, or is ending.
        return resident_memory(pid)
    return 0


def _children_by_parent(pid: int) -> list[int]:
    if not Path(f"/proc/{pid}").exists():
        return []
    return [int(name) for name in os.listdir("/proc") if name.isdigit() and _state_and_parent(name)[1] == pid]


def _state_and_parent(pid: int | str) -> tuple[str, int]:
    try:
        # The process name in brackets may contain anything.
        state, parent = _read(f"/proc/{pid}/stat").rpartition(b")")[2].split()[:2]
    except (OSError, ValueError):
        return "", 0
    return state.decode(), int(parent)


def _read(path: str) -> bytes:
    with open(path, "rb", buffering=0) as file:
        return file.read()


# --- a keeper above the worker adopts processes that detach themselves, and ends them all -------------


_PR_SET_PDEATHSIG, _PR_SET_DUMPABLE, _PR_SET_CHILD_SUBREAPER = 1, 4, 36
_END_TIMEOUT_SECONDS = 5.0
"""Timeout for killed processes to end; a process that waits for a disk may take longer."""
_SIGNALS = {signal.SIGCHLD, signal.SIGTERM}


def main() -> None:
    """``python -m workbench.machine.processes.family SERVER MODULE ARGUMENT...``: run ``MODULE.main()`` under a keeper."""
    begin_family(int(sys.argv.pop(1)))
    importlib.import_module(sys.argv[1]).main(*sys.argv[2:])


def begin_family(server: int) -> None:
    """Fork: the child returns and becomes the worker; this process never returns, and becomes the child's keeper.

    A task may start processes that leave the worker's group (``setsid``) or its process tree (double fork).
    They cannot be found once the worker is gone. The keeper is their *subreaper*: a process below the keeper
    that loses its parent becomes a child of the keeper. When the worker has ended, the server is gone, or the
    server sends SIGTERM, the keeper kills its children until it has none, and exits with the worker's status.
    It kills nothing else, since a child's process id is not reused before its parent has waited for it. A
    cgroup would need rights that a container or an ssh login does not have.

    Call it before any import (the keeper then takes 6 MB) and before any thread is started.

    Args:
        server: process id of the parent. The keeper ends its family when the parent is gone.
    """
    libc = ctypes.CDLL(None)
    # Block these signals until `_keep` waits for them. Without this, a SIGCHLD before that would be lost, and
    # a SIGTERM would end the keeper before the worker.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
    signal.signal(
        signal.SIGCHLD, signal.SIG_DFL
    )  # the parent may have set SIGCHLD to be ignored: then no child can be waited for
    libc.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != server:
        sys.exit("the server is gone")
    libc.prctl(_PR_SET_CHILD_SUBREAPER, 1)
    keeper = os.getpid()
    worker = os.fork()
    if worker != 0:
        _keep(worker)
    # A new group: signals of the author's code to its group must not reach the keeper. But no new session:
    # Linux shares the cores among sessions first (autogroups), so background work in its own session could
    # not leave the cores to another worker.
    os.setpgid(0, 0)
    for number in (signal.SIGTTIN, signal.SIGTTOU):
        # Without this, code that uses the terminal, which belongs to the server's group, would be stopped for
        # ever.
        signal.signal(number, signal.SIG_IGN)
    end_with_parent(keeper)
    signal.pthread_sigmask(signal.SIG_SETMASK, before)


def end_with_parent(parent: int) -> None:
    """Let the kernel kill this process when `parent`, its parent process, ends; `parent` must have only one thread."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)


class Keeper(Protocol):
    """A process that called `begin_family`, as the server sees it: a ``subprocess.Popen``, or an object with these
    methods."""

    stdout: IO[bytes] | None
    stderr: IO[bytes] | None

    @property
    def pid(self) -> int: ...

    def poll(self) -> int | None: ...

    def wait(self, timeout: float | None = None) -> int: ...

    def terminate(self) -> None: ...

    def kill(self) -> None: ...


def end_family(keeper: Keeper) -> None:
    """End a process that called `begin_family` and all that it started; returns when the process has ended. A
    process that does not react is killed; then, processes that detached themselves may keep running."""
    keeper.terminate()
    try:
        keeper.wait(timeout=2 * _END_TIMEOUT_SECONDS)
    except subprocess.TimeoutExpired:
        # The keeper does not react: it may be suspended. Killing it ends the worker, but not detached
        # processes.
        keeper.kill()
        keeper.wait()


def describe_exit(code: int | None) -> str:
    """An exit code as text: ``was killed by SIGSEGV``, ``ended with exit code 3``."""
    if code is None:
        return "stopped answering"
    if code < 0:
        # Only the first and the last real-time signal have names.
        named = -code in set(signal.Signals)
        return f"was killed by {signal.Signals(-code).name if named else f'signal {-code}'}"
    return f"ended with exit code {code}"


def _keep(worker: int) -> NoReturn:
    # The server notices the worker's end when the worker's descriptors close, so the keeper must hold no
    # copies.
    for fd in sorted(map(int, os.listdir("/proc/self/fd"))):
        if fd > 2:
            try:
                os.close(fd)
            except OSError:
                pass  # the descriptor of listdir
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
    """Kill all children, and the processes that thereby become children; returns wait statuses by process
    id."""
    ended: dict[int, int] = {}
    deadline = time.monotonic() + _END_TIMEOUT_SECONDS
    while (ours := children(os.getpid())) and time.monotonic() < deadline:
        for pid in ours:
            os.kill(pid, signal.SIGKILL)  # its process id is not reused before it is reaped
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
        ctypes.CDLL(None).prctl(_PR_SET_DUMPABLE, 0)  # the worker has already dumped its core
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [number])
    os.kill(os.getpid(), number)
    time.sleep(1.0)
    os._exit(1)


if __name__ == "__main__":
    main()
