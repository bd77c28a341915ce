"""The worker as a child process: messages, output, stack, memory and exit code."""

from __future__ import annotations

import ctypes
import errno
import fcntl
import os
import signal
import socket
import subprocess
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import get_args

from workbench.live.messages import (
    Event,
    Load,
    PlaceCamera,
    Play,
    Quit,
    Request,
    Reset,
    SetSliderAction,
    Settings,
    SingleStep,
    without_steps,
)
from workbench.live.process.fork_client import worker_forks
from workbench.live.process.heartbeat import (
    INTERRUPT_SIGNAL,
    STACK_SIGNAL,
    Beat,
    HeartbeatReader,
    make_heartbeat,
)
from workbench.live.process.memory_limit import FamilyMemory
from workbench.machine.processes.family import end_family, main_thread_ended
from workbench.machine.processes.watched_thread import report_failure
from workbench.machine.processes.wire import MessageSocket

_ONLY_LAST = (Load, Settings)
"""Request types of which only the last counts if several are queued in a row."""
_MAX_REQUESTS = 1000
"""Maximum queue length while the worker reads nothing. Above it, steps and resets are dropped: many come from
a key that is held down."""
_PIECE_BYTES = 1 << 20
_FLOOD_PAUSE_SECONDS = 0.005
"""Pause between two reads during a flood: with pieces of a megabyte, 200 MB are read in a second."""
_F_SETPIPE_SZ = 1031
_START_TIMEOUT_SECONDS = 60.0
"""Start-up timeout of a worker; generous for a cold first start on a loaded machine."""

Output = Callable[[str, bytes], bool]
"""Output callback: gets ``stdout`` or ``stderr`` and new bytes (empty at the end of the stream). Returns True
to request a pause before the next read."""


class WorkerProcess:
    """One worker process. `receive` is called on one thread; all other methods are thread-safe.

    Start a worker on a thread that outlives it: a worker that is not forked (`fork_client`) is ended by the
    kernel with the thread that started it, so that no worker is left behind when the server is killed.

    A worker has no standard input, so that a task that reads it gets EOF and does not hang. It has its own
    process group, so that Ctrl-C in the terminal reaches only the server. The author's code may keep the
    worker from reading, writing and ending, so nothing here waits for the worker: requests go through a queue
    and a thread (an unread socket is full after some hundred messages, and the page would block), the
    activity is in shared memory (`heartbeat`), and faulthandler writes the stack into a memory file, in a
    signal handler.
    """

    def __init__(self, output: Output, niceness: int = 0) -> None:
        """
        Args:
            output: called with the worker's output on threads of this object; see `redirect_output`.
            niceness: as for ``nice``.
        """
        ours, theirs = socket.socketpair()
        heartbeat = make_heartbeat()
        self._stacks = os.memfd_create("workbench-stacks")
        # O_APPEND: the file position is shared; the worker appends, the server reads and truncates.
        fcntl.fcntl(self._stacks, fcntl.F_SETFL, os.O_APPEND)
        fds = [theirs.fileno(), heartbeat, self._stacks]
        try:
            # This starts the worker's keeper, which starts the worker and ends with its exit code.
            self._process = worker_forks.start(fds, niceness)
            self._heartbeat = HeartbeatReader(heartbeat)
        except BaseException:
            ours.close()
            os.close(self._stacks)
            raise
        finally:
            theirs.close()
            os.close(heartbeat)
        self._line = MessageSocket(ours, get_args(Event))
        self._memory = FamilyMemory()
        self._output = output
        self._waiting: deque[Request] = deque()
        self._wake = threading.Condition()
        self._ending = False
        self._look_lock = threading.Lock()
        self._writer = threading.Thread(target=self._write_all, name="worker-requests", daemon=True)
        self._readers = [
            threading.Thread(
                target=self._read_output, args=(name, stream), name=f"worker-{name}", daemon=True
            )
            for name, stream in (("stdout", self._process.stdout), ("stderr", self._process.stderr))
        ]
        for thread in (self._writer, *self._readers):
            thread.start()

    @property
    def pid(self) -> int:
        """Id of the process that runs the task. Blocks until the process has started: about 50 ms, some seconds for the
        first worker.

        Raises:
            ProcessLookupError: it did not start.
        """
        deadline = time.monotonic() + _START_TIMEOUT_SECONDS
        while self._heartbeat.pid == 0 and self._process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.005)
        pid = self._heartbeat.pid or self._process.pid
        if pid == 0:  # with 0, `os.kill` would signal this process and its group
            raise ProcessLookupError("the worker has not started")
        return pid

    # --- messages ----------------------------------------------------------------------------------

    def send(self, request: Request) -> None:
        """Queue a request. Never blocks. If the worker has ended, the request is lost; `receive` reports the end."""
        with self._wake:
            if self._waiting and _replaces(request, self._waiting[-1]):
                self._waiting.pop()
            if len(self._waiting) >= _MAX_REQUESTS:
                # Drop steps and resets, never the newest request, which may be a load or Pause. A step pauses
                # first, so a pause takes the place of the dropped steps.
                self._waiting = deque(r for r in self._waiting if not isinstance(r, (SingleStep, Reset)))
                self._waiting.append(Play(False))
            self._waiting.append(request)
            self._wake.notify()

    def receive(self, timeout: float) -> Event | None:
        """The next event; None after `timeout` seconds without one.

        Raises:
            Unreadable: the data is not an event; `kill` the worker.
            EOFError: the worker has ended (see `exit_code`), and all its events were received.
        """
        message = self._line.receive(timeout)
        # A process that the author's code forked may hold the socket open after the worker's death.
        if message is None and self._process.poll() is not None:
            message = self._line.receive(0)
            if message is None:
                raise EOFError
        return message

    def redirect_output(self, output: Output) -> None:
        """Redirect the output from now on."""
        self._output = output

    # --- inspection ----------------------------------------------------------------------------------

    def beat(self) -> Beat:
        """The worker's activity, and since when."""
        return self._heartbeat.read()

    def memory(self, limit: int | None = None) -> int:
        """Memory in bytes of the worker and all processes that it started; see `FamilyMemory.measure`."""
        return self._memory.measure(self._process.pid, limit)

    def main_thread_ended(self) -> bool:
        """Whether the main thread has ended while another thread keeps the process alive."""
        pid = self._heartbeat.pid
        return pid != 0 and main_thread_ended(pid) and self._process.poll() is None

    def stack(self, timeout: float = 0.3) -> str:
        """The worker's current stack, as faulthandler writes it; empty if it does not arrive within `timeout` seconds."""
        if self.beat().number == 0 or self._process.poll() is not None:
            return ""  # the signal would end a worker that has not installed its handlers yet
        with self._look_lock:
            start = size = os.fstat(self._stacks).st_size
            try:
                os.kill(self.pid, STACK_SIGNAL)
            except ProcessLookupError:
                return ""  # the worker died meanwhile; `receive` reports it
            deadline = time.monotonic() + timeout
            while time.monotonic() < deadline:
                time.sleep(0.005)
                now = os.fstat(self._stacks).st_size
                if now == size > start:
                    break
                size = now
            dump = os.pread(self._stacks, max(0, size - start), start).decode(errors="replace")
            if self._process.poll() is None:
                os.ftruncate(self._stacks, 0)
        return dump

    def crash_report(self) -> str:
        """The stack of a crash or of ``os._exit``; empty after a plain kill."""
        return os.pread(self._stacks, 100_000, 0).decode(errors="replace")

    def interrupt(self) -> None:
        """Raise Interrupted in the author's code (see `Interrupts`), and drop queued control steps. Native code is not stopped
        until it returns to Python."""
        with self._wake:
            self._waiting = deque(without_steps(self._waiting))
        if self.beat().number > 0 and self._process.poll() is None:
            signal_main_thread(self.pid, INTERRUPT_SIGNAL)

    # --- the end -----------------------------------------------------------------------------------

    def exit_code(self) -> int | None:
        """Exit code as in ``subprocess``: negative for the signal that ended the worker. Blocks up to 2 s; None if
        the worker still runs."""
        try:
            return self._process.wait(timeout=2.0)
        except subprocess.TimeoutExpired:
            return None

    def kill(self) -> None:
        """End the worker now with all processes that it started; `receive` then raises EOFError."""
        self._process.terminate()

    def stop(self, grace: float = 1.0) -> None:
        """Send Quit, and after `grace` seconds end the worker with all processes that it started."""
        if grace > 0 and self._process.poll() is None:
            self.send(Quit())
            try:
                self._process.wait(timeout=grace)
            except subprocess.TimeoutExpired:
                pass
        end_family(self._process)
        with self._wake:
            self._ending = True
            self._wake.notify()
        # A process that left the group may hold the other end: without this shutdown, the writer would hang.
        self._line.end.shutdown(socket.SHUT_RDWR)
        self._writer.join()
        # A worker that is not forked yet has no output, but the fork server holds the worker's pipes.
        timeout = 1.0 if self._process.pid else 0.0
        for reader in self._readers:
            # A process that left the group may hold the pipe: then the thread that reads the pipe is left
            # behind.
            reader.join(timeout=timeout)
        self._line.end.close()
        os.close(self._stacks)

    # --- threads -----------------------------------------------------------------------------------

    def _write_all(self) -> None:
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._waiting or self._ending)
                if not self._waiting:
                    return
                request = self._waiting.popleft()
            try:
                self._line.send(request)
            except OSError:
                return  # the worker has ended; `receive` reports it
            except Exception as error:
                report_failure(f"A {type(request).__name__} could not be sent to the worker", error)

    def _read_output(self, name: str, stream: object) -> None:
        with stream as pipe:  # type: ignore[attr-defined]
            fd = pipe.fileno()
            try:
                fcntl.fcntl(fd, _F_SETPIPE_SZ, _PIECE_BYTES)
            except OSError:
                pass  # the user's limit for pipe memory is reached: the pieces will be smaller
            failed = False
            while True:
                piece = os.read(fd, _PIECE_BYTES)
                try:
                    too_fast = self._output(name, piece)
                except Exception as error:
                    # For example a closed terminal. Keep reading: a worker whose pipe is full blocks.
                    too_fast = False
                    if not failed:
                        report_failure("The task's output could not be shown", error)
                    failed = True
                if not piece:
                    return
                if too_fast:
                    time.sleep(_FLOOD_PAUSE_SECONDS)


def _replaces(request: Request, before: Request) -> bool:
    if isinstance(request, PlaceCamera):
        return isinstance(before, PlaceCamera) and before.key == request.key
    if isinstance(request, SetSliderAction):
        return isinstance(before, SetSliderAction) and (before.env_idx, before.dimensions) == (
            request.env_idx,
            request.dimensions,
        )
    return isinstance(request, _ONLY_LAST) and type(before) is type(request)


def signal_main_thread(pid: int, number: signal.Signals) -> None:
    """Send a signal to the main thread of a process, where Python's handlers run.

    The kernel may deliver a signal to any thread of a process; on a busy machine this may be a thread of
    torch or of the renderer. CPython 3.11 then records the signal without waking the main thread: an endless
    loop in the main thread continues until another Python thread wants to run, which may never happen.
    """
    if _libc.tgkill(pid, pid, int(number)) != 0:
        error = ctypes.get_errno()
        if error != errno.ESRCH:  # ESRCH: the worker died meanwhile; `receive` reports it
            raise OSError(error, os.strerror(error))


_libc = ctypes.CDLL(None, use_errno=True)
