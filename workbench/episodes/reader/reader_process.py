"""Starts reader processes, sends them requests and ends them."""

from __future__ import annotations

import contextlib
import itertools
import os
import signal
import socket
import subprocess
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

from workbench.episodes.reader.requests import Answer, CloseEpisodes, GetExitCode, NewReader, Request
from workbench.machine.processes.child_environment import child_environment, start_with_socket
from workbench.machine.processes.family import describe_exit
from workbench.machine.processes.wire import MessageSocket, Unpacker, Unreadable, pack

START_SECONDS = 60.0
"""Timeout of the fork server's start, whose imports take half a second."""
POLL_SECONDS = 0.2
"""Interval of checking whether an answer is still needed."""


FOR_READING = {
    # Start no further threads: a fork copies only one thread.
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    # Load no filter plugins of HDF5.
    "HDF5_PLUGIN_PRELOAD": "::",
    # Arrow and rerun would each commit 1 GB at once, and a reader's memory is limited.
    "MIMALLOC_ARENA_EAGER_COMMIT": "0",
}


class ReaderEnded(OSError):
    """A request ended the reader; the message follows the name of the recording."""


class ReaderBusy(OSError):
    """The reader is busy with another request."""


class WrongProcess(Exception):
    """The requested process has ended and was replaced."""


@dataclass(frozen=True)
class Answered:
    answer: Answer
    process: int
    """Number of the process that answered."""


class _ForkServer:
    """Client of this process's fork server, which starts on first use."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._control: socket.socket | None = None
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start the server without waiting."""
        with self._lock:
            self._start()

    def new_reader(self, request: NewReader) -> tuple[int, MessageSocket]:
        """Fork a reader; returns its process id and socket. Raises OSError."""
        ours, theirs = socket.socketpair()
        message = pack(request)
        with theirs, self._lock:
            for _ in range(2):
                control = self._start()
                try:
                    socket.send_fds(control, [message], [theirs.fileno()])
                    return self._answer(control), MessageSocket(ours, get_args(Answer))
                except (OSError, Unreadable):
                    self._end()  # the server was killed: retry with a new one
        ours.close()
        raise OSError("the process that reads recordings cannot be started")

    def exit_code(self, pid: int) -> int | None:
        """The exit code of a reader that has ended; None if unknown."""
        with self._lock:
            if self._control is None:
                return None
            try:
                self._control.send(pack(GetExitCode(pid)))
                return self._answer(self._control)
            except (OSError, Unreadable):
                self._end()
                return None

    def end(self) -> None:
        with self._lock:
            self._end()

    def _start(self) -> socket.socket:
        if self._control is None or self._process is None or self._process.poll() is not None:
            self._end()
            self._process, control = start_with_socket(
                "workbench.episodes.reader.fork_readers", child_environment(**FOR_READING), new_session=True
            )
            control.settimeout(START_SECONDS)
            self._control = control
        return self._control

    @staticmethod
    def _answer(control: socket.socket) -> int:
        """The number that the server answers. Raises Unreadable if the server has ended."""
        return Unpacker().unpack(control.recv(64), int)

    def _end(self) -> None:
        if self._control is not None:
            self._control.close()
        if self._process is not None:
            self._process.kill()
            self._process.wait()
        self._control = self._process = None


fork_server = _ForkServer()


class Reader:
    """A confined process that may read one folder and do little else; starts on first use.

    Thread-safe; requests are answered in order.
    """

    _numbers = itertools.count(1)

    def __init__(self, folder: Path, writes: Path | None = None) -> None:
        """
        Args:
            writes: folder that the process may write to; None for none.
        """
        self._folder, self._writes = Path(folder), writes
        self._allowed: set[Path] = set()
        """Other files that the process may read: targets of links in the folder."""
        self._turns = _FairLock()
        self._pid = 0
        self._line: MessageSocket | None = None
        self._there: tuple[tuple[int, int] | None, ...] = ()
        """Device and inode of the folder and of `_allowed` when the current process started."""
        self._closed: deque[tuple[int, int]] = deque()
        self.process = 0
        """Number of the current process; 0 if there is none."""

    def ask(
        self,
        request: Request,
        seconds: float,
        patience: float | None = None,
        process: int | None = None,
        stopped: Callable[[], bool] = lambda: False,
    ) -> Answered:
        """Send a request and wait for the answer.

        Args:
            seconds: timeout of the answer.
            patience: timeout in seconds of waiting for other requests; None waits forever.
            process: number of the process that must answer, such as the one in which an episode is open; None
                for any process.
            stopped: polled a few times a second; once it returns True, the answer is no longer needed.

        Raises:
            ReaderEnded: the request ended the reader, or timed out. A new reader serves the next request.
            ReaderBusy: another request still runs after `patience`.
            WrongProcess: `process` has ended.
            OSError: no reader can be started.
        """
        (answer,) = self.ask_all([request], seconds, patience, process, stopped)
        if isinstance(answer, ReaderEnded):
            raise answer
        return answer

    def ask_all(
        self,
        requests: Sequence[Request],
        seconds: float,
        patience: float | None = None,
        process: int | None = None,
        stopped: Callable[[], bool] = lambda: False,
    ) -> list[Answered | ReaderEnded]:
        """Send several requests at once, each with a timeout of `seconds`; a request that ends the reader
        does not affect the others.

        A request whose reader dies is retried once: the cause may have been external.
        """
        answers: list[Answered | ReaderEnded] = []
        again = -1
        """Index of the request that was retried."""
        with self._turns.hold(patience):
            while len(answers) < len(requests):
                line = self._started()
                if process is not None and process != self.process:
                    raise WrongProcess
                begun = len(answers)
                try:
                    self._send_closed(line)
                    for request in requests[begun:]:
                        line.send(request)
                    for _ in requests[begun:]:
                        answer = _receive(line, seconds, stopped)
                        answers.append(Answered(answer, self.process))
                except (OSError, EOFError) as error:
                    ended = self._ended(error, seconds)
                    by_itself = not isinstance(error, (TimeoutError, Unreadable))
                    if by_itself and again != len(answers):
                        again = len(answers)
                    else:
                        answers.append(ended)
        return answers

    def allow(self, paths: Sequence[Path]) -> None:
        """Allow the process to read these files too. If a path is new, the process is replaced, and its
        episodes are closed."""
        with self._turns.hold(None):
            if not self._allowed.issuperset(paths):
                self._allowed.update(paths)
                self._kill()

    def close_episode(self, process: int, opened: int) -> None:
        """Close an episode when the next request is sent. Does not block, because a finalizer may call this
        on any thread."""
        self._closed.append((process, opened))

    def close(self) -> None:
        """End the process; the next request starts a new one."""
        with self._turns.hold(None):
            self._kill()

    def _started(self) -> MessageSocket:
        paths = (self._folder, *sorted(self._allowed))
        # The process may read the folder that existed when it started, not a new one of the same name.
        there = tuple(map(_identity, paths))
        # EOF or data while no request is pending: the process was killed from outside.
        if self._line is not None and (there != self._there or self._line.waits()):
            self._kill()
        if self._line is None:
            request = NewReader(list(paths), self._writes)
            self._pid, self._line = fork_server.new_reader(request)
            self.process, self._there = next(self._numbers), there
        return self._line

    def _send_closed(self, line: MessageSocket) -> None:
        gone = []
        while self._closed:
            process, opened = self._closed.popleft()
            if process == self.process:
                gone.append(opened)
        if gone:
            line.send(CloseEpisodes(gone))

    def _ended(self, error: Exception, seconds: float) -> ReaderEnded:
        status = self._kill()
        if isinstance(error, TimeoutError):
            return ReaderEnded(f"takes longer to read than {seconds:.0f} s")
        if isinstance(error, Unreadable):
            return ReaderEnded(f"made the process that reads recordings send an invalid answer: {error}")
        with_what = "" if status is None else f" (it {describe_exit(status)})"
        return ReaderEnded(f"ended the process that reads recordings{with_what}")

    def _kill(self) -> int | None:
        """Kill the process; returns its exit code, if known."""
        if self._line is None:
            return None
        self._line.end.close()
        self._line, self.process = None, 0
        # Kills the reader and its children. The reader's id cannot have been reused, because only `exit_code`
        # reaps the reader.
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self._pid, signal.SIGKILL)
        return fork_server.exit_code(self._pid)


def _receive(line: MessageSocket, seconds: float, stopped: Callable[[], bool]) -> Answer:
    """The next answer. Raises TimeoutError after `seconds`, or once `stopped` returns True."""
    until = time.monotonic() + seconds
    while (left := until - time.monotonic()) > 0 and not stopped():
        if (answer := line.receive(min(left, POLL_SECONDS))) is not None:
            return answer
    raise TimeoutError


class _FairLock:
    """A fair lock (first come, first served). Python's own lock may go back to the thread that just released
    it."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._waiting: deque[object] = deque()

    @contextlib.contextmanager
    def hold(self, patience: float | None) -> Iterator[None]:
        """Hold the lock. Raises ReaderBusy after `patience` seconds."""
        me = object()
        with self._changed:
            self._waiting.append(me)
            if not self._changed.wait_for(lambda: self._waiting[0] is me, patience):
                self._waiting.remove(me)
                raise ReaderBusy("the process that reads recordings is busy with another recording")
        try:
            yield
        finally:
            with self._changed:
                self._waiting.remove(me)
                self._changed.notify_all()


def _identity(path: Path) -> tuple[int, int] | None:
    try:
        found = os.stat(path)
    except OSError:
        return None
    return found.st_dev, found.st_ino
