"""Runs a job's numbered items in this process or in several, each with an env of its own."""

from __future__ import annotations

import os
import pickle
import socket
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from typing import Any, Generic, Protocol, TypeVar, get_args

from workbench.authoring.problem import Problem, TaskError, treat_ctrl_c_as_error
from workbench.machine.processes.child_python import child_environment, python_command, quick_imports
from workbench.machine.processes.debugger import ONE_PROCESS, refuse_breakpoints
from workbench.machine.processes.family import describe_exit, end_family
from workbench.machine.processes.wire import MessageSocket, Unpacker, Unreadable, pack, pack_message
from workbench.machine.text import guard_terminal

_LOOK_SECONDS = 0.1
_END_SECONDS = 120.0
"""How long a stopped process may take to write the items that have ended."""
_EXIT_SECONDS = 10.0
_NO_LIMIT = sys.maxsize

Setup = TypeVar("Setup")
Result = TypeVar("Result")
Update = TypeVar("Update")


class PoolError(RuntimeError):
    """A process died or failed; the others were stopped and dropped the items under way."""


class ItemQueue(Protocol):
    """The items of one process. Used on one thread."""

    def next(self) -> int | None:
        """The next item to begin; None if there is none."""
        ...

    def limit(self) -> int:
        """Items from this number on are not needed, even if they have begun. It never rises."""
        ...

    def send_result(self, number: int, result: Any) -> None:
        """Send the result of an item."""
        ...

    def send_update(self, update: Any) -> None:
        """Send progress."""
        ...


class Deal(Generic[Result, Update]):
    """The items of a job, and the callbacks for their results. Used on one thread.

    Items are dealt in ascending order. From the limit on none is needed: a caller that has enough lowers it, and stopping
    is a limit of 0. So the result does not depend on the number of processes, and a stopped job continues by dealing
    the rest.
    """

    def __init__(
        self,
        numbers: Iterable[int],
        on_result: Callable[[int, Result], None],
        on_update: Callable[[Update], None] = lambda update: None,
        stop: Callable[[], bool] = lambda: False,
    ) -> None:
        """
        Args:
            numbers: ascending, from 0 on.
            stop: called often; after True nothing more is needed.
        """
        self._numbers = iter(numbers)
        self._on_result, self._on_update, self._stop = on_result, on_update, stop
        self._limit = _NO_LIMIT

    def lower(self, limit: int) -> None:
        """Lower the limit: items from `limit` on are not needed."""
        self._limit = min(limit, self._limit)

    def limit(self) -> int:
        if self._stop():
            self.lower(0)
        return self._limit

    def next(self) -> int | None:
        number = next(self._numbers, _NO_LIMIT)
        return number if number < self.limit() else None

    def send_result(self, number: int, result: Result) -> None:
        self._on_result(number, result)

    def send_update(self, update: Update) -> None:
        self._on_update(update)


@dataclass(frozen=True)
class Work(Generic[Setup, Result, Update]):
    """What each process does."""

    run: Callable[[Setup, ItemQueue], None]
    """A function that can be imported by its name. It returns when its queue has no next item and none is under way.

    A TaskError, OSError, ValueError or RuntimeError from it ends the job.
    """
    setups: Sequence[Setup]
    """The first argument of `run` for each process; can be pickled."""
    result: Any
    update: Any
    """Types of results and progress, against which `wire` checks messages of other processes."""
    name: str
    """As in "a process *that records* was killed by SIGKILL"."""


class Executor(Protocol):
    """Does the work of a job."""

    def run(self, work: Work[Setup, Result, Update], deal: Deal[Result, Update]) -> None:
        """Deal until no item is left or needed, and all items under way are finished.

        Raises:
            TaskError, PoolError: one process failed or died; the others were stopped and dropped the items under way.
        """
        ...


class ThisProcess:
    """Runs the work in this process; exceptions of `Work.run` pass through."""

    def run(self, work: Work[Setup, Result, Update], deal: Deal[Result, Update]) -> None:
        (setup,) = work.setups
        work.run(setup, deal)


class Processes:
    """Runs the work in spawned processes, each on its share of the cores."""

    def __init__(self, chunk: int = 1) -> None:
        """
        Args:
            chunk: items per request of a process: more than one where an item takes milliseconds.
        """
        self._chunk = chunk

    def run(self, work: Work[Setup, Result, Update], deal: Deal[Result, Update]) -> None:
        pool = _ProcessPool(work, deal, self._chunk)
        try:
            pool.start()
            pool.serve()
        finally:
            pool.end()


def envs_per_process(count: int, processes: int) -> list[int]:
    """`count` envs divided among so many processes; fewer processes where some would get none."""
    processes = min(processes, count)
    return [count // processes + (i < count % processes) for i in range(processes)]


# --- messages between the processes --------------------------------------------------------------------


@dataclass(frozen=True)
class _Next:
    """A request for more items."""


@dataclass(frozen=True)
class _Update:
    """Progress of a process."""

    value: bytes
    """Packed, as `Work.update`."""


@dataclass(frozen=True)
class _Result:
    """The result of an item."""

    number: int
    value: bytes
    """Packed, as `Work.result`."""


@dataclass(frozen=True)
class _Ended:
    """The last message of a process: no item is under way."""

    why: str = ""
    """Why it failed; empty if it did not."""
    problem: Problem | None = None
    """What the author's code raised, if that is the reason."""


_Message = _Next | _Update | _Result | _Ended


@dataclass(eq=False)
class _Process:
    """A process of the pool, in the process that started it."""

    line: MessageSocket
    keeper: subprocess.Popen[bytes]
    begun: set[int] = field(default_factory=set)
    """Items that it has and did not report yet."""


class _ProcessPool:
    """Starts the processes of one run, deals items to them and collects results."""

    def __init__(self, work: Work, deal: Deal, chunk: int) -> None:
        self._work, self._deal, self._chunk = work, deal, chunk
        self._unpack = Unpacker().unpack
        self._processes: list[_Process] = []
        self._busy: list[_Process] = []

    def start(self) -> None:
        cores = sorted(os.sched_getaffinity(0))
        for i, setup in enumerate(self._work.setups):
            ours, theirs = socket.socketpair()
            with theirs:
                module = ("workbench.jobs.pool", str(theirs.fileno()))
                keeper = subprocess.Popen(
                    python_command("-m", "workbench.machine.processes.family", str(os.getpid()), *module),
                    stdin=subprocess.DEVNULL,
                    pass_fds=[theirs.fileno()],
                    start_new_session=True,  # Ctrl-C in the terminal reaches only this process, which stops them
                    env=child_environment(),
                )
            process = _Process(MessageSocket(ours, get_args(_Message)), keeper)
            self._processes.append(process)
            self._busy.append(process)
            self._send(process, cores[i :: len(self._work.setups)] or cores)
            self._send(process, (self._work.run, setup))

    def serve(self) -> None:
        sent_limit, stopped = self._deal.limit(), 0.0
        failure: TaskError | PoolError | None = None
        while self._busy:
            if (limit := self._deal.limit()) != sent_limit:
                sent_limit = limit
                for process in self._busy:
                    self._send(process, limit)
            if limit == 0:
                stopped = stopped or time.monotonic()
                if time.monotonic() - stopped > _END_SECONDS:
                    raise failure or PoolError(f"a process {self._work.name} did not end in time")
            by_end: dict[Any, _Process] = {process.line.end: process for process in self._busy}
            for end in wait(by_end, _LOOK_SECONDS):
                process = by_end[end]
                try:
                    self._receive(process)
                except (TaskError, PoolError) as error:
                    self._busy.remove(process)
                    end_family(process.keeper)
                    failure = failure or error
                    self._deal.lower(0)
        if failure is not None:
            raise failure

    def end(self) -> None:
        """Wait for the processes that are done, and end the others, as after a second Ctrl-C: they may not respond."""
        for process in self._processes:
            if process not in self._busy:
                self._exit_code(process, _EXIT_SECONDS)
            end_family(process.keeper)
            process.line.end.close()

    def _receive(self, process: _Process) -> None:
        """Handle its complete messages. The author's code runs at the other end, and may write into any descriptor.

        Raises:
            TaskError, PoolError: it failed.
        """
        try:
            while process in self._busy and (message := process.line.receive(0)) is not None:
                self._take(process, message)
        except Unreadable as error:
            raise PoolError(f"a process {self._work.name} sent what cannot be read ({error})") from error
        except EOFError:
            words = describe_exit(self._exit_code(process, 2.0))
            raise PoolError(f"a process {self._work.name} {words}") from None

    def _take(self, process: _Process, message: _Message) -> None:
        if isinstance(message, _Next):
            numbers = [n for n in (self._deal.next() for _ in range(self._chunk)) if n is not None]
            process.begun.update(numbers)
            self._send(process, numbers)
        elif isinstance(message, _Update):
            self._deal.send_update(self._unpack(message.value, self._work.update))
        elif isinstance(message, _Result):
            result = self._unpack(message.value, self._work.result)
            if message.number not in process.begun:
                raise PoolError(
                    f"a process {self._work.name} sent the result of an item that it does not have"
                )
            process.begun.remove(message.number)
            self._deal.send_result(message.number, result)
        elif message.why:
            raise PoolError(message.why) if message.problem is None else TaskError(message.problem)
        elif min(process.begun, default=_NO_LIMIT) < self._deal.limit():
            raise PoolError(f"a process {self._work.name} ended before it was done")
        else:
            self._busy.remove(process)

    def _exit_code(self, process: _Process, patience: float) -> int | None:
        try:
            return process.keeper.wait(timeout=patience)
        except subprocess.TimeoutExpired:
            return None

    def _send(self, process: _Process, message: Any) -> None:
        try:
            process.line.send_bytes(pickle.dumps(message))
        except (BrokenPipeError, ConnectionResetError):
            pass  # it is gone; `_receive` reports it


# --- a process of the pool -----------------------------------------------------------------------------


class _RemoteQueue:
    """The items of a process of the pool: asks the process that started it."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._mine: deque[int] = deque()
        self._limit = _NO_LIMIT
        self._none_left = False

    def next(self) -> int | None:
        if not self._mine and not self._none_left:
            self.send(_Next())
            while not isinstance(message := self._take(), list):
                pass
            self._none_left = not message
        if not self._mine or self._mine[0] >= self._limit:
            return None
        return self._mine.popleft()

    def limit(self) -> int:
        while self._connection.poll(0):
            self._take()
        return self._limit

    def send_result(self, number: int, result: Any) -> None:
        self.send(_Result(number, pack(result)))

    def send_update(self, update: Any) -> None:
        self.send(_Update(pack(update)))

    def _take(self) -> list[int] | int:
        message: list[int] | int = self._connection.recv()
        if isinstance(message, list):
            self._mine.extend(message)
        else:
            self._limit = message
        return message

    def send(self, message: object) -> None:
        self._connection.send_bytes(pack_message(message))


def main(socket_fd: str) -> None:
    """Entry of a process of the pool, started through `machine.processes.family`."""
    guard_terminal()
    refuse_breakpoints(ONE_PROCESS)
    treat_ctrl_c_as_error()
    connection = Connection(int(socket_fd))
    queue = _RemoteQueue(connection)
    try:
        # PhysX and the software renderer start a thread for each core that the process may use.
        os.sched_setaffinity(0, connection.recv())
        with quick_imports():
            run, setup = connection.recv()
        try:
            run(setup, queue)
            queue.send(_Ended())
        except TaskError as error:
            queue.send(_Ended(str(error) or "TaskError", error.problem))
        except (OSError, ValueError, RuntimeError) as error:
            queue.send(_Ended(str(error) or type(error).__name__))
    except (ConnectionError, EOFError):
        return  # the process that started this one is gone
