"""The fork server: a process that has imported a worker's modules, and forks workers."""

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
from workbench.live.process.fork_client import Forked, ForkEnded, NewWorker
from workbench.machine.processes.child_environment import python_command, quick_imports
from workbench.machine.processes.wire import Unpacker, pack_message

_MAX_MESSAGE_BYTES = 1 << 12
_STANDARD_FDS = (1, 2)
"""File descriptors of stdout and stderr."""
_MAX_PRINTED_BYTES = 1 << 15
"""Maximum size of the imports' output that is kept: the output is written into a pipe before anything reads from
the pipe, so it must fit into the pipe's buffer."""
_NUM_FDS = 6
"""Number of file descriptors of a request: the socket on which the worker's exit is reported, the three
descriptors that `start.run` takes, and the worker's stdout and stderr."""


def main() -> None:
    """Run the fork server: ``python -m workbench.app.worker.fork_server SOCKET``. When SOCKET closes, the
    fork server and its workers end.

    A fork takes some 30 ms; the imports take five seconds of one core. The fork server runs none of the
    author's code, and has a single Python thread: a fork copies only the thread that calls it. OpenBLAS
    restarts its own threads.
    """
    control = socket.socket(fileno=int(sys.argv[1]))
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    printed = [os.memfd_create("workbench-imports") for _ in _STANDARD_FDS]
    for fd, standard in zip(printed, _STANDARD_FDS):
        os.dup2(fd, standard)
    try:
        with quick_imports():
            from workbench.app.worker import main_loop as loop  # noqa: F401
    except BaseException:
        versions = None  # each worker imports the modules itself, and reports the error
    else:
        versions = _versions()
    texts = [os.pread(fd, _MAX_PRINTED_BYTES, 0) for fd in printed]
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
                self._woken.recv(_MAX_MESSAGE_BYTES)
                self._reap()
            if self._control.fileno() in ready:
                message, fds, _, _ = socket.recv_fds(self._control, _MAX_MESSAGE_BYTES, _NUM_FDS)
                if not message:
                    os._exit(0)  # the kernel ends the workers
                self._fork(Unpacker().unpack(message, NewWorker), fds)

    def _signal(self, pid: int, end: socket.socket) -> None:
        """Send a worker's keeper the signal requested on its socket, or SIGTERM if the client closed it."""
        try:
            asked = end.recv(_MAX_MESSAGE_BYTES)
        except ConnectionResetError:  # the client closed the socket without reading our message
            asked = b""
        # The keeper is our child: the kernel does not reuse its pid before we have waited for it.
        os.kill(pid, Unpacker().unpack(asked, int) if asked else signal.SIGTERM)
        if not asked:
            self._workers.pop(pid).close()

    def _reap(self) -> None:
        with suppress(ChildProcessError):
            while (found := os.waitpid(-1, os.WNOHANG))[0]:
                pid, status = found
                if (end := self._workers.pop(pid, None)) is not None:
                    _send(end, ForkEnded(os.waitstatus_to_exitcode(status)))
                    end.close()

    def _fork(self, request: NewWorker, fds: list[int]) -> None:
        end = socket.socket(fileno=fds[0])
        looker = select.poll()
        looker.register(end, select.POLLIN)
        pid, server = 0, os.getpid()
        if looker.poll(0):
            _send(end, ForkEnded(-signal.SIGTERM))  # the worker was cancelled while we imported
        else:
            try:
                pid = os.fork()
            except OSError as error:  # no memory, or too many processes; running workers must continue
                os.write(fds[-1], f"workbench: no worker can be started: {error}\n".encode())
                _send(end, ForkEnded(1))
            else:
                if pid == 0:
                    self._become_worker(request, server, end, fds[1:])
        if pid:
            _send(end, Forked(pid))
            with suppress(OSError):
                os.setpgid(pid, pid)  # the child does this too, but the group may be signalled earlier
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
        for fd, standard in zip(fds[-2:], _STANDARD_FDS):
            os.dup2(fd, standard)
            os.close(fd)
        arguments = [*fds[:-2], server, request.niceness]
        if self._versions is None or any(_written(file) != at for file, at in self._versions.items()):
            for fd in fds[:-2]:
                os.set_inheritable(fd, True)
            command = python_command("-m", start.__name__, *map(str, arguments))
            os.execv(command[0], command)
        for standard, text in zip(_STANDARD_FDS, self._printed):
            os.write(standard, text)
        import numpy as np

        # Without this, all workers would draw the same random numbers. Torch starts with the same seed in
        # every process anyway.
        random.seed()
        np.random.seed()
        sys.argv[:] = [str(Path(start.__file__))]
        start.run(*arguments)
        sys.exit()


def _send(end: socket.socket, message: Forked | ForkEnded) -> None:
    with suppress(OSError):  # the client has closed its end
        end.send(pack_message(message))


if __name__ == "__main__":
    main()
