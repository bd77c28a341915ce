"""Client of the fork server (`app/worker/fork_server.py`): asks it for worker processes."""

from __future__ import annotations

import atexit
import os
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import IO

from workbench.machine.processes.child_environment import child_environment, python_command, start_with_socket
from workbench.machine.processes.family import Keeper
from workbench.machine.processes.wire import Unpacker, has_come, pack

GPU_DEVICES = ("/dev/nvidiactl", "/dev/dxg")
"""If one of these device files exists (the second is that of WSL), CUDA may be available, and no worker is
forked: CUDA does not work in a fork of a process that has used CUDA, and any import may use it."""
_MAX_MESSAGE_BYTES = 1 << 12
_UNBUFFERED = {"PYTHONUNBUFFERED": "1"}


@dataclass(frozen=True)
class NewWorker:
    """Request to the fork server for a new worker."""

    niceness: int


@dataclass(frozen=True)
class Forked:
    """Report of the fork server: a worker was forked."""

    pid: int
    """Process id of the worker's keeper."""


@dataclass(frozen=True)
class ForkEnded:
    code: int
    """Exit code as in ``subprocess``: negative for the signal that ended the process."""


class ForkedKeeper:
    """The keeper of a forked worker. Thread-safe."""

    def __init__(self, report_socket: socket.socket, stdout: int, stderr: int) -> None:
        """
        Args:
            report_socket: socket on which the fork server reports the worker's start and end.
        """
        self.stdout: IO[bytes] | None = open(stdout, "rb", buffering=0)
        self.stderr: IO[bytes] | None = open(stderr, "rb", buffering=0)
        self._report_socket = report_socket
        self._pid = 0
        self._code: int | None = None
        self._terminated = False
        self._lock = threading.Lock()

    @property
    def pid(self) -> int:
        """Process id of the keeper; 0 until it has been forked."""
        self.poll()
        return self._pid

    def poll(self) -> int | None:
        """Exit code; None while the process runs. If the fork server is killed, its workers are killed too."""
        with self._lock:
            while self._code is None and has_come(self._report_socket):
                try:
                    data = self._report_socket.recv(_MAX_MESSAGE_BYTES)
                except ConnectionResetError:
                    data = b""
                message = Unpacker((Forked, ForkEnded)).message(data) if data else ForkEnded(-signal.SIGKILL)
                if isinstance(message, Forked):
                    self._pid = message.pid
                else:
                    self._code = message.code
            if self._code is None and self._terminated and self._pid == 0:
                # The worker will never be forked, but the fork server reports that only after its imports.
                self._code = -signal.SIGTERM
            if self._code is not None:
                self._report_socket.close()
            return self._code

    def wait(self, timeout: float | None = None) -> int:
        """Wait for the end; returns the exit code, and raises like ``subprocess.Popen.wait``."""
        deadline = None if timeout is None else time.monotonic() + timeout
        while (code := self.poll()) is None:
            left = None if deadline is None else deadline - time.monotonic()
            if left is not None and left <= 0:
                assert timeout is not None
                raise subprocess.TimeoutExpired("a worker", timeout)
            has_come(self._report_socket, left)
        return code

    def terminate(self) -> None:
        self._terminated = True
        self._send(signal.SIGTERM)

    def kill(self) -> None:
        self._terminated = True
        self._send(signal.SIGKILL)

    def _send(self, number: signal.Signals) -> None:
        if self.poll() is None:
            with self._lock:
                try:
                    self._report_socket.send(pack(int(number)))
                except OSError:
                    pass  # the process has ended; `poll` returns its exit code


class WorkerForks:
    """The fork server of this process, started together with the first worker. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._control: socket.socket | None = None
        self._from: tuple[dict[str, str], str] | None = None
        """Environment and working directory with which the fork server was started."""

    def start(self, fds: Sequence[int], niceness: int) -> Keeper:
        """Start a worker without waiting for it.

        Args:
            fds: socket, heartbeat and stacks, see `workbench.app.worker.start.run`.

        Raises:
            OSError: the process cannot be started.
        """
        with self._lock:
            control = None if any(map(os.path.exists, GPU_DEVICES)) else self._fork_server()
            if control is not None:
                try:
                    return _forked(control, fds, niceness)
                except (BrokenPipeError, ConnectionResetError):
                    self._end()  # the fork server was killed; the next worker starts a new one
        return start_anew(fds, niceness)

    def end(self) -> None:
        """End the fork server and all workers that it forked."""
        with self._lock:
            self._end()

    def _fork_server(self) -> socket.socket | None:
        """Start the fork server, unless it runs, and return its socket. None if the environment or the
        working directory has changed since it was started."""
        present = (child_environment(**_UNBUFFERED), _current_folder())
        if self._control is None:
            self._process, self._control = start_with_socket("workbench.app.worker.fork_server", present[0])
            self._from = present
        return self._control if self._from == present else None

    def _end(self) -> None:
        if self._control is not None:
            self._control.close()
        if self._process is not None:
            self._process.kill()
            self._process.wait()
        self._control = self._process = None


def _current_folder() -> str:
    try:
        return os.getcwd()
    except FileNotFoundError:  # the folder was removed
        return ""


def _forked(control: socket.socket, fds: Sequence[int], niceness: int) -> ForkedKeeper:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    out, err = os.pipe(), os.pipe()
    try:
        socket.send_fds(control, [pack(NewWorker(niceness))], [theirs.fileno(), *fds, out[1], err[1]])
    except BaseException:
        ours.close()
        os.close(out[0])
        os.close(err[0])
        raise
    finally:
        theirs.close()
        os.close(out[1])
        os.close(err[1])
    return ForkedKeeper(ours, out[0], err[0])


def start_anew(fds: Sequence[int], niceness: int) -> Keeper:
    """Start a worker that does the imports itself; see `WorkerForks.start`."""
    return subprocess.Popen(
        python_command("-m", "workbench.app.worker.start", *map(str, [*fds, os.getpid(), niceness])),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        bufsize=0,
        pass_fds=fds,
        process_group=0,
        env=child_environment(**_UNBUFFERED),
    )


worker_forks = WorkerForks()
atexit.register(worker_forks.end)
