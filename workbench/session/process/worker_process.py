"""The worker as a child process: start it, talk to it, hear what it prints, look at it, know when it dies.

A plain subprocess with one end of a socket pair: no standard input (a task that reads it gets end of
file, not a hang), its own process group (Ctrl-C in the terminal is for the server, which then ends the
worker in good order), and its output read as it comes so that an author's prints reach the page.

The author's code may keep it from reading, from writing, and from ending. So nothing here waits for it: what
is sent goes through a queue and a thread of its own (a socket that nobody reads is full after some hundred
messages, and a page's control would wait there); what it is doing stands in shared memory (`pulse`); and where
it is, it says from a signal handler into a file in memory, whatever its interpreter is doing (`last_words`).
"""

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

from workbench.machine.processes.child_python import child_environment, python_command
from workbench.machine.processes.family import end_family, main_thread_ended
from workbench.machine.processes.watched_thread import report_failure
from workbench.machine.processes.wire import MessageSocket
from workbench.session.process.heartbeat import Beat, PulseReader, make_pulse
from workbench.session.process.interrupts import INTERRUPT_SIGNAL, STACK_SIGNAL
from workbench.session.process.memory_limit import FamilyMemory
from workbench.session.protocol.messages import (
    Event,
    Load,
    PlaceCamera,
    Quit,
    Request,
    Settings,
    without_steps,
)

_WHOLE = (Load, Settings)
"""Of two of one kind that wait one behind the other only the second matters."""
_MOST_WAITING = 1000
"""Requests for a worker that reads none; more are dropped (a key held down on Step)."""
_PIECE = 1 << 20
_FLOOD_PAUSE = 0.005
"""Seconds between two reads of a flood: with pieces of a megabyte that drains 200 MB a second."""
_F_SETPIPE_SZ = 1031
_BEGINS = 10.0
"""Seconds in which a worker has begun, also on a machine that is at work."""

Output = Callable[[str, bytes], bool]
"""Gets ``stdout`` or ``stderr`` and the bytes that came (none at its end); True asks for a little rest."""


class WorkerProcess:
    """One worker. Events are taken by `receive`, on one thread; all else may be called from any.

    It must be started on a thread that lives as long as the worker may: the kernel ends a worker with the
    thread that started it, so that none is left behind when the server is killed.
    """

    def __init__(self, output: Output, niceness: int = 0) -> None:
        """
        Args:
            output: called with what it prints, on threads of this object; see `hear`.
            niceness: by how much other processes come first.
        """
        ours, theirs = socket.socketpair()
        pulse = make_pulse()
        self._stacks = os.memfd_create("workbench-stacks")
        # Appended to by the worker, read and emptied by us: the position is shared with it.
        fcntl.fcntl(self._stacks, fcntl.F_SETFL, os.O_APPEND)
        fds = [theirs.fileno(), pulse, self._stacks]
        try:
            # What is started is the worker's keeper, and the worker its child; it ends as the worker does.
            self._process = subprocess.Popen(
                python_command(
                    "-m", "workbench.session.worker.start", *map(str, [*fds, os.getpid(), niceness])
                ),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                bufsize=0,
                pass_fds=fds,
                start_new_session=True,
                env=child_environment(PYTHONUNBUFFERED="1"),
            )
            self._pulse = PulseReader(pulse)
        except BaseException:
            ours.close()
            os.close(self._stacks)
            raise
        finally:
            theirs.close()
            os.close(pulse)
        self._line = MessageSocket(ours, get_args(Event))
        self._memory = FamilyMemory(self._process.pid)
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
        """Of the process that runs the task. Waits for it to begin, some 50 ms after it was started."""
        deadline = time.monotonic() + _BEGINS
        while self._pulse.pid == 0 and self._process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.005)
        return self._pulse.pid or self._process.pid

    # --- messages ----------------------------------------------------------------------------------

    def send(self, request: Request) -> None:
        """Never waits. What is sent to a worker that is gone is lost; `receive` says so."""
        with self._wake:
            if self._waiting and _takes_the_place_of(request, self._waiting[-1]):
                self._waiting.pop()
            if len(self._waiting) < _MOST_WAITING:
                self._waiting.append(request)
            self._wake.notify()

    def receive(self, timeout: float) -> Event | None:
        """The next event; None after `timeout` seconds without one.

        Raises:
            Unreadable: what it sent is no event, so it counts as gone; `kill` it.
            EOFError: the worker is gone (see `exit_code`), and all that it sent was received.
        """
        message = self._line.receive(timeout)
        # A process that the author's code forked may hold the socket open after its parent's death.
        if message is None and self._process.poll() is not None:
            message = self._line.receive(0)
            if message is None:
                raise EOFError
        return message

    def hear(self, output: Output) -> None:
        """From now on what it prints goes there."""
        self._output = output

    # --- looking at it -------------------------------------------------------------------------------

    def beat(self) -> Beat:
        """What it is doing, and since when."""
        return self._pulse.read()

    def memory(self, limit: int | None = None) -> int:
        """Bytes that it has in memory together with all that it started; see `FamilyMemory.look`."""
        return self._memory.look(limit)

    def main_thread_ended(self) -> bool:
        """Whether the thread that takes requests is gone while another keeps the process alive."""
        pid = self._pulse.pid
        return pid != 0 and main_thread_ended(pid) and self._process.poll() is None

    def stack(self, patience: float = 0.3) -> str:
        """Where it is now, as faulthandler writes it; empty when it does not say so within `patience` seconds."""
        if self.beat().number == 0 or self._process.poll() is not None:
            return ""  # before its handlers are there the signal would end it
        with self._look_lock:
            start = size = os.fstat(self._stacks).st_size
            os.kill(self.pid, STACK_SIGNAL)
            deadline = time.monotonic() + patience
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

    def last_words(self) -> str:
        """What it wrote on its way out: the stack of a crash, or of ``os._exit``. Empty after a plain kill."""
        return os.pread(self._stacks, 100_000, 0).decode(errors="replace")

    def interrupt(self) -> None:
        """Leave the author's code if Python runs it (see `interrupts`); control steps that wait are not taken."""
        with self._wake:
            self._waiting = deque(without_steps(self._waiting))
        if self.beat().number > 0 and self._process.poll() is None:
            signal_main_thread(self.pid, INTERRUPT_SIGNAL)

    # --- its end -----------------------------------------------------------------------------------

    def exit_code(self) -> int | None:
        """As ``subprocess`` gives it: negative is the signal that ended it. Waits a little for it."""
        try:
            return self._process.wait(timeout=2.0)
        except subprocess.TimeoutExpired:
            return None

    def kill(self) -> None:
        """End it now with all that it started; `receive` then raises EOFError."""
        self._process.terminate()

    def stop(self, grace: float = 1.0) -> None:
        """Ask it to end, and after `grace` seconds end it with all that it started."""
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
        # Else the writer may wait for ever where a process that left the group still holds the other end.
        self._line.end.shutdown(socket.SHUT_RDWR)
        self._writer.join()
        for reader in self._readers:
            # A process that left the group may hold the pipe; its thread then stays with it.
            reader.join(timeout=1.0)
        self._line.end.close()
        os.close(self._stacks)

    # --- its threads -------------------------------------------------------------------------------

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
                return  # it is gone, and `receive` says so
            except Exception as error:
                report_failure(f"A {type(request).__name__} could not be sent to the worker", error)

    def _read_output(self, name: str, stream: object) -> None:
        with stream as pipe:  # type: ignore[attr-defined]
            fd = pipe.fileno()
            try:
                fcntl.fcntl(fd, _F_SETPIPE_SZ, _PIECE)
            except OSError:
                pass  # the system's limit for pipes is reached: smaller pieces then
            failed = False
            while True:
                piece = os.read(fd, _PIECE)
                try:
                    too_fast = self._output(name, piece)
                except Exception as error:
                    # Such as a terminal that is closed. It is read on: a worker whose pipe is full stands still.
                    too_fast = False
                    if not failed:
                        report_failure("What the task printed could not be shown", error)
                    failed = True
                if not piece:
                    return
                if too_fast:
                    time.sleep(_FLOOD_PAUSE)


def _takes_the_place_of(request: Request, before: Request) -> bool:
    if isinstance(request, PlaceCamera):
        return isinstance(before, PlaceCamera) and before.key == request.key
    return isinstance(request, _WHOLE) and type(before) is type(request)


def signal_main_thread(pid: int, number: signal.Signals) -> None:
    """Send a signal to the thread of a process that Python's handlers run in.

    The kernel hands a signal for the whole process to any of its threads, on a busy machine also to one of torch's
    or the renderer's. CPython 3.11 then notes the signal and does not tell the main thread, whose endless loop goes
    on until another Python thread wants to run: never.
    """
    if _libc.tgkill(pid, pid, int(number)) != 0:
        error = ctypes.get_errno()
        if error != errno.ESRCH:  # it died meanwhile: `receive` says so
            raise OSError(error, os.strerror(error))


_libc = ctypes.CDLL(None, use_errno=True)
