"""The process that has imported what a worker needs, and forks workers."""

from __future__ import annotations

import os
import random
import select
import signal
import socket
import sys
from contextlib import suppress
from pathlib import Path
from typing import NoReturn

from workbench.app.worker import start
from workbench.live.process.worker_start import Forked, ForkEnded, NewWorker
from workbench.machine.processes.child_python import python_command, quick_imports
from workbench.machine.processes.wire import Unpacker, pack_message

_LONGEST = 1 << 12
_STANDARD = (1, 2)
"""File descriptors of stdout and stderr."""
_MOST_PRINTED = 1 << 15
"""Most bytes that are kept of what the imports printed: what fits into a pipe that is not read yet."""
_FDS = 6
"""File descriptors of a request: the socket that reports the worker's end, the three of `start.run`, and its stdout
and stderr."""


def main() -> None:
    """Run it: ``python -m workbench.app.worker.fork_workers SOCKET``. It ends when its socket closes, and its workers with it.

    A fork takes some 30 ms, where the imports take a core for five seconds. It runs nothing of the author's, and has one
    thread of Python's: a fork copies no other, and those of OpenBLAS start again by themselves.
    """
    control = socket.socket(fileno=int(sys.argv[1]))
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    printed = [os.memfd_create("workbench-imports") for _ in _STANDARD]
    for fd, standard in zip(printed, _STANDARD):
        os.dup2(fd, standard)
    try:
        with quick_imports():
            from workbench.app.worker import main_loop as loop  # noqa: F401
    except BaseException:
        versions = None  # each worker imports for itself, and says what is wrong
    else:
        versions = _versions()
    texts = [os.pread(fd, _MOST_PRINTED, 0) for fd in printed]
    for fd in printed:
        os.close(fd)
    _ForkServer(control, versions, texts).serve()


def _versions() -> dict[str, int]:
    """Modification time of the file of each imported module, in nanoseconds; -1 if the file is gone."""
    files = {getattr(module, "__file__", None) for module in list(sys.modules.values())}
    return {file: _written(file) for file in files if isinstance(file, str)}


def _written(file: str) -> int:
    try:
        return os.stat(file).st_mtime_ns
    except OSError:
        return -1


class _ForkServer:
    def __init__(self, control: socket.socket, versions: dict[str, int] | None, printed: list[bytes]) -> None:
        self._control, self._versions, self._printed = control, versions, printed
        self._workers: dict[int, socket.socket] = {}
        """Sockets by process id of the worker's keeper."""
        self._woken, self._wakes = socket.socketpair()
        for end in (self._woken, self._wakes):
            end.setblocking(False)
        signal.set_wakeup_fd(self._wakes.fileno())
        signal.signal(signal.SIGCHLD, lambda *_: None)

    def serve(self) -> None:
        while True:
            looker = select.poll()
            for end in (self._control, self._woken, *self._workers.values()):
                looker.register(end, select.POLLIN)
            ready = {fd for fd, _ in looker.poll()}
            for pid, end in list(self._workers.items()):
                if end.fileno() in ready:
                    self._signal(pid, end)
            if self._woken.fileno() in ready:
                self._woken.recv(_LONGEST)
                self._reap()
            if self._control.fileno() in ready:
                message, fds, _, _ = socket.recv_fds(self._control, _LONGEST, _FDS)
                if not message:
                    os._exit(0)  # the kernel ends the workers
                self._fork(Unpacker().unpack(message, NewWorker), fds)

    def _signal(self, pid: int, end: socket.socket) -> None:
        """Handle a message on a worker's socket: a signal number to send, or the end of the connection."""
        try:
            asked = end.recv(_LONGEST)
        except ConnectionResetError:  # it left without having read what we told
            asked = b""
        # It is our child, and its number is free only after we have waited for it.
        os.kill(pid, Unpacker().unpack(asked, int) if asked else signal.SIGTERM)
        if not asked:
            self._workers.pop(pid).close()

    def _reap(self) -> None:
        with suppress(ChildProcessError):
            while (found := os.waitpid(-1, os.WNOHANG))[0]:
                pid, status = found
                if (end := self._workers.pop(pid, None)) is not None:
                    _tell(end, ForkEnded(os.waitstatus_to_exitcode(status)))
                    end.close()

    def _fork(self, request: NewWorker, fds: list[int]) -> None:
        end = socket.socket(fileno=fds[0])
        looker = select.poll()
        looker.register(end, select.POLLIN)
        pid, server = 0, os.getpid()
        if looker.poll(0):
            _tell(end, ForkEnded(-signal.SIGTERM))  # it was ended while we imported
        else:
            try:
                pid = os.fork()
            except OSError as error:  # no memory, or too many processes; those that run are to go on
                os.write(fds[-1], f"workbench: no worker can be started: {error}\n".encode())
                _tell(end, ForkEnded(1))
            else:
                if pid == 0:
                    self._become_worker(request, server, end, fds[1:])
        if pid:
            _tell(end, Forked(pid))
            with suppress(OSError):
                os.setpgid(pid, pid)  # also here: its group may be signalled before it has made it
            self._workers[pid] = end
        else:
            end.close()
        for fd in fds[1:]:
            os.close(fd)

    def _become_worker(self, request: NewWorker, server: int, end: socket.socket, fds: list[int]) -> NoReturn:
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        for other in (self._control, self._woken, self._wakes, end, *self._workers.values()):
            other.close()
        os.setpgid(0, 0)
        for fd, standard in zip(fds[-2:], _STANDARD):
            os.dup2(fd, standard)
            os.close(fd)
        arguments = [*fds[:-2], server, request.niceness]
        if self._versions is None or any(_written(file) != at for file, at in self._versions.items()):
            for fd in fds[:-2]:
                os.set_inheritable(fd, True)
            command = python_command("-m", start.__name__, *map(str, arguments))
            os.execv(command[0], command)
        for standard, text in zip(_STANDARD, self._printed):
            os.write(standard, text)
        import numpy as np

        # Else all workers draw the same numbers. Torch begins with the same ones in every process.
        random.seed()
        np.random.seed()
        sys.argv[:] = [str(Path(start.__file__))]
        start.run(*arguments)
        sys.exit()


def _tell(end: socket.socket, message: Forked | ForkEnded) -> None:
    with suppress(OSError):  # who started it has left
        end.send(pack_message(message))


if __name__ == "__main__":
    main()
