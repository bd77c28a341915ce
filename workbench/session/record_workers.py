"""A recording by several processes: the episodes are dealt out from here, so they are the same as in one.

Each process opens the task and has its share of the envs and of the cores. It asks for the number of the next episode
when an env is free, says when one is over, and is told which are kept; it writes its files itself (`record_worker`).
Ctrl-C in the terminal is for this process alone, which tells them. One that dies takes its episodes under way along,
and the recording ends with a sentence; what it left is mended at the next start.
"""

from __future__ import annotations

import os
import socket
import subprocess
import time
from collections.abc import Callable
from dataclasses import replace
from multiprocessing.connection import Connection, wait
from typing import Any

from workbench.authoring.problem import Problem, TaskError
from workbench.core.rules import Finding
from workbench.machine.child_python import child_environment, python_command
from workbench.recording.landing import RecordingError
from workbench.session.dealer import Dealer
from workbench.session.family import end_family
from workbench.session.message_reader import Unreadable, receive_message
from workbench.session.process import describe_exit
from workbench.session.record import (
    Progress,
    Recorded,
    RecordOptions,
    Written,
)

_LOOK = 0.1
_ENDING_SECONDS = 120.0
"""In which a process that was told to stop must have written what is over."""


def record_in_processes(
    what: RecordOptions,
    dealer: Dealer,
    on_activity: Callable[[str], None],
    on_progress: Callable[[Progress], None],
    stop: Callable[[], bool],
    on_finding: Callable[[Finding], None],
) -> Recorded:
    """See `record.record`, which this is the other way of doing; raises as it does."""
    workers = _start(what)
    parent = _Parent(workers, dealer, on_activity, on_progress, on_finding)
    try:
        parent.serve(stop)
    except KeyboardInterrupt:
        # Asked for a second time: they may be where nothing reaches them. What they had written is mended later.
        parent.kill()
        raise
    finally:
        parent.end()
    parent.written.sort(key=lambda episode: episode.index)
    return Recorded(tuple(parent.written), dealer.tried, stop(), parent.put_right)


def shares(num_envs: int, workers: int) -> list[int]:
    """Envs of each process; no process without one."""
    workers = min(workers, num_envs)
    return [num_envs // workers + (i < num_envs % workers) for i in range(workers)]


def _start(what: RecordOptions) -> dict[Connection, subprocess.Popen[bytes]]:
    workers: dict[Connection, subprocess.Popen[bytes]] = {}
    envs = shares(what.options.num_envs, what.workers)
    cores = sorted(os.sched_getaffinity(0))
    for i, count in enumerate(envs):
        ours, theirs = socket.socketpair()
        share = replace(what, workers=1, options=replace(what.options, num_envs=count))
        with theirs:
            process = subprocess.Popen(
                python_command(
                    "-m", "workbench.session.record_worker", str(theirs.fileno()), str(os.getpid())
                ),
                stdin=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
                start_new_session=True,  # Ctrl-C in the terminal is for this process, which tells them
                env=child_environment(),
            )
        connection = Connection(ours.detach())
        workers[connection] = process
        try:
            connection.send(cores[i :: len(envs)] or cores)
            connection.send(share)
        except (BrokenPipeError, ConnectionResetError):
            pass  # it is gone, and `serve` says so when it reads
    return workers


class _Parent:
    def __init__(
        self,
        workers: dict[Connection, subprocess.Popen[bytes]],
        dealer: Dealer,
        on_activity: Callable[[str], None],
        on_progress: Callable[[Progress], None],
        on_finding: Callable[[Finding], None],
    ) -> None:
        self._workers, self._dealer = workers, dealer
        self._on_activity, self._on_progress = on_activity, on_progress
        self._on_finding = on_finding
        self._found: set[object] = set()
        """Each process finds the same, and it is told once."""
        self._steps = 0
        self._busy = set(workers)
        self._whose: dict[int, Connection] = {}
        """Which process has an episode."""
        self.written: list[Written] = []
        self.put_right = 0

    def serve(self, stop: Callable[[], bool]) -> None:
        told, since = False, 0.0
        while self._busy:
            if stop() and not told:
                told, since = True, time.monotonic()
                for connection in self._busy:
                    self._tell(connection, ("stop", None))
            if told and time.monotonic() - since > _ENDING_SECONDS:
                raise RecordingError(
                    "a process that records did not end in time; its episodes are mended later"
                )
            for connection in wait(list(self._busy), _LOOK):
                assert isinstance(connection, Connection)
                try:
                    word, value = _said(connection)
                except Unreadable as error:
                    self._kill(connection)
                    raise RecordingError(
                        f"a process that records sent what cannot be read ({error}); what was over is kept"
                    ) from None
                except (EOFError, OSError):
                    raise RecordingError(
                        f"a process that records {describe_exit(self._exit_code(connection))}; what was over is kept"
                    ) from None
                self._hear(connection, word, value)

    def kill(self) -> None:
        for process in self._workers.values():
            end_family(process)

    def end(self) -> None:
        for connection in self._busy:
            self._tell(connection, ("stop", None))
        deadline = time.monotonic() + _ENDING_SECONDS
        for connection, process in self._workers.items():
            while process.poll() is None and connection in self._busy and time.monotonic() < deadline:
                self._take_what_is_written(connection)
            _exit_code(process, 10.0)
            end_family(process)
            process.wait()
            connection.close()

    def _take_what_is_written(self, connection: Connection) -> None:
        try:
            while connection.poll(_LOOK):
                word, value = _said(connection)
                if word == "next":
                    self._tell(connection, ("index", None))
                elif word == "written":
                    self.written.append(value)
                elif word == "done":
                    self._busy.discard(connection)
                    return
        except Unreadable:
            self._kill(connection)
        except (EOFError, OSError):
            self._busy.discard(connection)

    def _kill(self, connection: Connection) -> None:
        end_family(self._workers[connection])
        self._busy.discard(connection)

    def _hear(self, connection: Connection, word: str, value: Any) -> None:
        if word == "next":
            index = self._dealer.next()
            if index is not None:
                self._whose[index] = connection
            self._tell(connection, ("index", index))
        elif word == "ended":
            self._dealer.ended(*value)
            for index, keep in self._dealer.decided():
                self._tell(self._whose[index], ("decided", (index, keep)))
        elif word == "written":
            self.written.append(value)
            self._on_progress(Progress(self._dealer.kept, self._steps))
        elif word == "steps":
            self._steps += value
            self._on_progress(Progress(self._dealer.kept, self._steps))
        elif word == "activity":
            self._on_activity(value)
        elif word == "finding":
            if value.key not in self._found:
                self._found.add(value.key)
                self._on_finding(value)
        elif word == "done":
            self.put_right += value
            self._busy.discard(connection)
        elif word == "failed":
            self._busy.discard(connection)
            if isinstance(value, Problem):
                raise TaskError(value)
            raise RecordingError(value)

    def _exit_code(self, connection: Connection) -> int | None:
        self._busy.discard(connection)
        return _exit_code(self._workers[connection], 2.0)

    def _tell(self, connection: Connection, message: tuple[str, Any]) -> None:
        try:
            connection.send(message)
        except (BrokenPipeError, OSError):
            pass  # it is gone, and `serve` says so when it reads


_VALUES: dict[str, type | tuple[type, ...]] = {
    "next": type(None),
    "ended": tuple,
    "written": Written,
    "steps": int,
    "activity": str,
    "done": int,
    "failed": (Problem, str),
    "finding": Finding,
}


def _said(connection: Connection) -> tuple[str, Any]:
    """The next word of a process, and what belongs to it. Raises Unreadable, EOFError or OSError."""
    message = receive_message(connection, tuple)
    word = message[0] if len(message) == 2 and isinstance(message[0], str) else ""
    if word not in _VALUES or not isinstance(message[1], _VALUES[word]):
        raise Unreadable("it was none of the messages that there are")
    return word, message[1]


def _exit_code(process: subprocess.Popen[bytes], patience: float) -> int | None:
    try:
        return process.wait(timeout=patience)
    except subprocess.TimeoutExpired:
        return None
