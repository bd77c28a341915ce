"""Runs a job's work in several processes of this machine."""

from __future__ import annotations

import os
import pickle
import socket
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import Any

from workbench.jobs.scheduler import NO_LIMIT, Chunk, PoolError, Result, Scheduler, Setup, Update, Work
from workbench.jobs.worker_messages import MESSAGES, ChunkRequest, Listener, Message, WorkerQueue, work_on
from workbench.machine.processes.child_environment import child_environment, python_command, quick_imports
from workbench.machine.processes.debugger import ONE_PROCESS, refuse_breakpoints
from workbench.machine.processes.family import describe_exit, end_family
from workbench.machine.processes.time_limit import end_after
from workbench.machine.processes.wire import MessageSocket, Unreadable, pack_message
from workbench.machine.text import guard_terminal
from workbench.task.problem import TaskError, treat_ctrl_c_as_error

_POLL_SECONDS = 0.1
_END_SECONDS = 120.0
"""Timeout for a stopped process to write its finished items."""
_EXIT_SECONDS = 10.0


class Processes:
    """Runs the work in spawned processes, each on its share of the cores."""

    @property
    def is_remote(self) -> bool:
        return False

    def __init__(self, workers: int, on_death: Callable[[str], None] = lambda text: None) -> None:
        """
        Args:
            workers: maximum number of processes; there are never more processes than chunks.
            on_death: as in `Listener`.
        """
        self._workers, self._on_death = workers, on_death

    def run(self, work: Work[Setup, Result, Update], scheduler: Scheduler[Result, Update]) -> None:
        pool = _ProcessPool(work, scheduler, self._workers, self._on_death)
        try:
            pool.serve()
        finally:
            pool.end()


@dataclass(eq=False)
class _Process:
    """A process of the pool, as seen by the process that started it."""

    line: MessageSocket
    keeper: subprocess.Popen[bytes]
    place: int
    """Index of the process's share of the cores."""
    heard: bool = True
    """Whether more messages of the process are awaited; False after its last message or its end."""


class _ProcessPool:
    """Starts the processes of one run, deals chunks to them, and replaces those that fail."""

    def __init__(
        self, work: Work, scheduler: Scheduler, workers: int, on_death: Callable[[str], None]
    ) -> None:
        self._work, self._scheduler = work, scheduler
        self._workers = max(1, scheduler.count_left(workers))
        self._listener = Listener("a process", work, scheduler, on_death)
        self._processes: list[_Process] = []

    def serve(self) -> None:
        sent_limit, stopped = self._scheduler.limit(), 0.0
        failure: TaskError | PoolError | None = None
        for place in range(self._workers):
            self._start(place)
        while busy := self._busy():
            if (limit := self._scheduler.limit()) != sent_limit:
                sent_limit = limit
                for process in busy:
                    self._send(process, limit)
            if limit == 0:
                stopped = stopped or time.monotonic()
                if time.monotonic() - stopped > _END_SECONDS:
                    raise failure or PoolError(f"a process {self._work.name} did not end in time")
            by_end: dict[Any, _Process] = {process.line.end: process for process in busy}
            for end in wait(by_end, _POLL_SECONDS):
                process = by_end[end]
                try:
                    self._receive(process)
                except (TaskError, PoolError) as error:
                    self._leave(process)
                    failure = failure or error
                    self._scheduler.lower(0)
            # If a process fails after all others have ended, no process is left for the chunk that it gave
            # back.
            if not self._busy() and self._scheduler.count_left(1):
                self._start(0)
        if failure is not None:
            raise failure

    def end(self) -> None:
        """Wait until finished processes exit, and kill the others at once: these may hang after a second
        Ctrl-C."""
        for process in self._processes:
            if not process.heard:
                self._exit_code(process, _EXIT_SECONDS)
            end_family(process.keeper)
            process.line.end.close()

    def _busy(self) -> list[_Process]:
        return [process for process in self._processes if process.heard]

    def _start(self, place: int) -> None:
        cores = sorted(os.sched_getaffinity(0))
        ours, theirs = socket.socketpair()
        with theirs:
            module = (__name__, str(theirs.fileno()))
            keeper = subprocess.Popen(
                python_command("-m", "workbench.machine.processes.family", str(os.getpid()), *module),
                stdin=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
                start_new_session=True,  # Ctrl-C in the terminal reaches only the parent, which ends the pool
                env=child_environment(),
            )
        process = _Process(MessageSocket(ours, MESSAGES), keeper, place)
        self._processes.append(process)
        self._send(process, cores[place :: self._workers] or cores)
        self._send(process, (self._work.run, self._work.setup))

    def _leave(self, process: _Process) -> None:
        """End a process that failed."""
        process.heard = False
        end_family(process.keeper)

    def _replace(self, process: _Process) -> None:
        """End a process that failed, and start another one for the remaining chunks."""
        self._leave(process)
        if self._scheduler.count_left(1):
            self._start(process.place)

    def _receive(self, process: _Process) -> None:
        """Handle the complete messages of a process. They are untrusted: the author's code in the process may
        write to any descriptor.

        Raises:
            TaskError, PoolError: the process failed, and the job is over.
        """
        try:
            while process.heard and (message := process.line.receive(0)) is not None:
                outcome = self._listener.take(process, message)
                if outcome == "asks":
                    self._send(process, self._scheduler.next(process))
                elif outcome == "failed":
                    self._replace(process)
                elif outcome == "done":
                    process.heard = False
        except Unreadable as error:
            raise PoolError(f"a process {self._work.name} sent an unreadable message ({error})") from error
        except EOFError:
            code = self._exit_code(process, 2.0)
            self._listener.died(process, describe_exit(code), code)
            self._replace(process)

    def _exit_code(self, process: _Process, patience: float) -> int | None:
        try:
            return process.keeper.wait(timeout=patience)
        except subprocess.TimeoutExpired:
            return None

    def _send(self, process: _Process, message: Any) -> None:
        try:
            process.line.send_bytes(pickle.dumps(message))
        except (BrokenPipeError, ConnectionResetError):
            pass  # the process has ended; `_receive` reports it


# --- a process of the pool -----------------------------------------------------------------------------


class _SocketQueue(WorkerQueue):
    """The chunks of a process of the pool, requested from the parent process."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._limit = NO_LIMIT

    def next(self) -> Chunk | None:
        self.send(ChunkRequest())
        while isinstance(message := self._connection.recv(), int):
            self._limit = message
        return message

    def limit(self) -> int:
        while self._connection.poll(0):
            self._limit = self._connection.recv()
        return self._limit

    def send(self, message: Message) -> None:
        self._connection.send_bytes(pack_message(message))


def main(socket_fd: str) -> None:
    """Entry point of a process of the pool, started by `machine.processes.family`."""
    guard_terminal()
    refuse_breakpoints(ONE_PROCESS)
    treat_ctrl_c_as_error()
    end_after()
    connection = Connection(int(socket_fd))
    queue = _SocketQueue(connection)
    try:
        # Limit the cores: PhysX and the software renderer start a thread for each core of the process.
        os.sched_setaffinity(0, connection.recv())
        with quick_imports():
            run, setup = connection.recv()
        work_on(run, setup, queue)
    except (ConnectionError, EOFError):
        return  # the parent process has ended
