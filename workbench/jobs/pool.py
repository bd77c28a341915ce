"""Work cut into numbered items, done in this process or by several, each of which keeps its env from item to item.

`Work.run` is the same function everywhere. It asks its `Share` for items, and tells what came of each. Items are dealt
in ascending order to whoever asks. From the limit on none is wanted any more: a caller that has enough lowers it, and
stopping is a limit of 0. So what is done does not depend on how many processes do it, and a job that was stopped is
resumed by dealing what is left.
"""

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
from typing import Any, Generic, Protocol, TypeVar

from workbench.authoring.problem import Problem, TaskError, treat_ctrl_c_as_error
from workbench.machine.processes.breakpoints import ONE_PROCESS, refuse_breakpoints
from workbench.machine.processes.child_python import child_environment, python_command, quick_imports
from workbench.machine.processes.family import describe_exit, end_family
from workbench.machine.processes.wire import MessageSocket, Unpacker, Unreadable, pack, pack_message
from workbench.machine.text import guard_terminal

_LOOK_SECONDS = 0.1
_END_SECONDS = 120.0
"""In which a process that was told to stop must have finished what is over."""
_EXIT_SECONDS = 10.0
_NO_LIMIT = sys.maxsize

Setup = TypeVar("Setup")
Result = TypeVar("Result")
News = TypeVar("News")


class PoolError(RuntimeError):
    """A process died or failed; what the others had under way was finished."""


@dataclass(frozen=True)
class Progress:
    """How far a `wire.Call` is."""

    number: int
    done: int
    total: int
    part: bytes = b""
    """What is known of the answer since the last one, packed; see `wire.Question.part`."""


@dataclass(frozen=True)
class Answer:
    """The end of a `wire.Call`."""

    number: int
    value: bytes = b""
    """Packed: only who asked knows of what kind it is to be."""
    why: str = ""
    """Why there is no value, for the reader; empty where there is one."""
    problem: Problem | None = None
    """What the author's code raised, if that is why."""


class CannotAnswer(Exception):
    """In a worker: a question has no answer here; a sentence."""


class Share(Protocol):
    """The items of one process. Used on one thread."""

    def next(self) -> int | None:
        """The next item to begin; None when there is none any more."""
        ...

    def limit(self) -> int:
        """Items from this number on are not wanted any more, also if they are under way. It only falls."""
        ...

    def tell(self, number: int, result: Any) -> None:
        """What came of an item."""
        ...

    def say(self, news: Any) -> None:
        """How it goes meanwhile."""
        ...


class Deal(Generic[Result, News]):
    """The items of a job, and who hears what comes of them. Used on one thread."""

    def __init__(
        self,
        numbers: Iterable[int],
        on_result: Callable[[int, Result], None],
        on_news: Callable[[News], None] = lambda news: None,
        stop: Callable[[], bool] = lambda: False,
    ) -> None:
        """
        Args:
            numbers: ascending, from 0 on.
            stop: asked often; after a yes nothing more is wanted.
        """
        self._numbers = iter(numbers)
        self._on_result, self._on_news, self._stop = on_result, on_news, stop
        self._limit = _NO_LIMIT

    def lower(self, limit: int) -> None:
        """Items from `limit` on are not wanted any more."""
        self._limit = min(limit, self._limit)

    def limit(self) -> int:
        if self._stop():
            self.lower(0)
        return self._limit

    def next(self) -> int | None:
        number = next(self._numbers, _NO_LIMIT)
        return number if number < self.limit() else None

    def tell(self, number: int, result: Result) -> None:
        self._on_result(number, result)

    def say(self, news: News) -> None:
        self._on_news(news)


@dataclass(frozen=True)
class Work(Generic[Setup, Result, News]):
    """What each process does."""

    run: Callable[[Setup, Share], None]
    """A function that can be imported by its name. It returns when its share has no next item and none is under way.

    A TaskError, OSError, ValueError or RuntimeError that it raises ends the job.
    """
    setups: Sequence[Setup]
    """Its first argument, one for each process; can be pickled."""
    result: Any
    news: Any
    """Types of what it tells and says, as `wire` packs it. Another process's words are held against them."""
    name: str
    """As in "a process *that records* was killed by SIGKILL"."""


class Executor(Protocol):
    """Who does the work."""

    def run(self, work: Work[Setup, Result, News], deal: Deal[Result, News]) -> None:
        """Deal until nothing is left or wanted, and everything under way is finished.

        Raises:
            TaskError, PoolError: a share failed, or its process died; the others were stopped before.
        """
        ...


class Here:
    """This process does all of it; what `Work.run` raises is raised as it is."""

    def run(self, work: Work[Setup, Result, News], deal: Deal[Result, News]) -> None:
        (setup,) = work.setups
        work.run(setup, deal)


class Processes:
    """Spawned processes, each with its share of the cores."""

    def __init__(self, chunk: int = 1) -> None:
        """
        Args:
            chunk: items that a process is given at once: more than one where an item takes milliseconds.
        """
        self._chunk = chunk

    def run(self, work: Work[Setup, Result, News], deal: Deal[Result, News]) -> None:
        pool = _WorkerPool(work, deal, self._chunk)
        try:
            pool.start()
            pool.serve()
        finally:
            pool.end()


def shares(count: int, processes: int) -> list[int]:
    """`count` envs, or whatever else there is, cut for so many processes; no process without one."""
    processes = min(processes, count)
    return [count // processes + (i < count % processes) for i in range(processes)]


# --- what is said between the processes ----------------------------------------------------------------


@dataclass(frozen=True)
class _Next:
    """More items, please."""


_ALL = -1
"""The number of the last answer: nothing is under way any more, and nothing comes after this. Those before are of items;
news are the parts of a progress."""


@dataclass(eq=False)
class _Process:
    """As the one that started it sees it."""

    line: MessageSocket
    keeper: subprocess.Popen[bytes]
    begun: set[int] = field(default_factory=set)
    """The items that it has and has told nothing of."""


class _WorkerPool:
    """The processes."""

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
                    start_new_session=True,  # Ctrl-C in the terminal is for this process, which tells them
                    env=child_environment(),
                )
            process = _Process(MessageSocket(ours, (_Next, Answer, Progress)), keeper)
            self._processes.append(process)
            self._busy.append(process)
            self._send(process, cores[i :: len(self._work.setups)] or cores)
            self._send(process, (self._work.run, setup))

    def serve(self) -> None:
        told, stopped = self._deal.limit(), 0.0
        failure: TaskError | PoolError | None = None
        while self._busy:
            if (limit := self._deal.limit()) != told:
                told = limit
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
                    self._hear(process)
                except (TaskError, PoolError) as error:
                    self._busy.remove(process)
                    end_family(process.keeper)
                    failure = failure or error
                    self._deal.lower(0)
        if failure is not None:
            raise failure

    def end(self) -> None:
        """Wait for those that are done; those that are not, as after a second Ctrl-C, may be where nothing reaches them."""
        for process in self._processes:
            if process not in self._busy:
                self._exit_code(process, _EXIT_SECONDS)
            end_family(process.keeper)
            process.line.end.close()

    def _hear(self, process: _Process) -> None:
        """What it has said whole. The author's code runs at the other end: it may write into any descriptor.

        Raises:
            TaskError, PoolError: it failed.
        """
        try:
            while process in self._busy and (said := process.line.receive(0)) is not None:
                self._take(process, said)
        except Unreadable as error:
            raise PoolError(f"a process {self._work.name} sent what cannot be read ({error})") from error
        except EOFError:
            words = describe_exit(self._exit_code(process, 2.0))
            raise PoolError(f"a process {self._work.name} {words}") from None

    def _take(self, process: _Process, said: _Next | Answer | Progress) -> None:
        if isinstance(said, _Next):
            numbers = [n for n in (self._deal.next() for _ in range(self._chunk)) if n is not None]
            process.begun.update(numbers)
            self._send(process, numbers)
        elif isinstance(said, Progress):
            self._deal.say(self._unpack(said.part, self._work.news))
        elif said.number != _ALL:
            result = self._unpack(said.value, self._work.result)
            if said.number not in process.begun:
                raise PoolError(f"a process {self._work.name} told of an item that it does not have")
            process.begun.remove(said.number)
            self._deal.tell(said.number, result)
        elif said.why:
            raise PoolError(said.why) if said.problem is None else TaskError(said.problem)
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
            pass  # it is gone, and `_hear` says so


# --- a process of the pool -----------------------------------------------------------------------------


class _FarShare:
    """Asks the process that started this one."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._mine: deque[int] = deque()
        self._limit = _NO_LIMIT
        self._none_left = False

    def next(self) -> int | None:
        if not self._mine and not self._none_left:
            self.send(_Next())
            while not isinstance(heard := self._take(), list):
                pass
            self._none_left = not heard
        if not self._mine or self._mine[0] >= self._limit:
            return None
        return self._mine.popleft()

    def limit(self) -> int:
        while self._connection.poll(0):
            self._take()
        return self._limit

    def tell(self, number: int, result: Any) -> None:
        self.send(Answer(number, pack(result)))

    def say(self, news: Any) -> None:
        self.send(Progress(0, 0, 0, pack(news)))

    def _take(self) -> list[int] | int:
        heard: list[int] | int = self._connection.recv()
        if isinstance(heard, list):
            self._mine.extend(heard)
        else:
            self._limit = heard
        return heard

    def send(self, said: object) -> None:
        self._connection.send_bytes(pack_message(said))


def main(socket_fd: str) -> None:
    """Entry of a process, which `machine.processes.family` has started."""
    guard_terminal()
    refuse_breakpoints(ONE_PROCESS)
    treat_ctrl_c_as_error()
    connection = Connection(int(socket_fd))
    share = _FarShare(connection)
    try:
        # PhysX and the software renderer take a thread for each core that the process may use.
        os.sched_setaffinity(0, connection.recv())
        with quick_imports():
            run, setup = connection.recv()
        try:
            run(setup, share)
            share.send(Answer(_ALL))
        except TaskError as error:
            share.send(Answer(_ALL, why=str(error) or "TaskError", problem=error.problem))
        except (OSError, ValueError, RuntimeError) as error:
            share.send(Answer(_ALL, why=str(error) or type(error).__name__))
    except (ConnectionError, EOFError):
        return  # the process that started this one is gone
