"""Whoever asks a worker: the one that plays, between its steps, or one in the background.

The worker that plays has the envs that are on the screen, at their present moment. Judging the past, drawing it again
and looking at cameras over many seeds take seconds or minutes, and put the envs wherever they like. So that is asked of
a process of its own with a lower priority, which costs some seconds to start and some 0.75 GB. All jobs of an open task
share one, in turns; it is ended when there was none in a while. What was begun last is what somebody waits for: all else
gives way to it in the middle, and goes on afterwards.

A worker answers in order. A job that is stopped, or gives way, leaves one answer owed, which is taken at the end of its
turn, or the process is ended. One that dies ends the job that asked it, and the next starts another.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import count
from typing import Any, TypeVar

from workbench.core.camera_data import CameraKey
from workbench.jobs.pool import Answer, Progress
from workbench.machine.processes.family import describe_exit
from workbench.machine.processes.wire import Call, Question, Unpacker, Unreadable, value_type
from workbench.session.process.job_lane import Job, JobFailed
from workbench.session.process.worker_process import WorkerProcess
from workbench.session.protocol.messages import Cancel, Load, PlaceCamera, Request

_LOOK = 0.05
"""Seconds between two looks at whether the job is to stop."""
_NICENESS = 10
"""After the one that plays, where there are fewer cores than work."""
WAITING = "waiting for other work in the background"
IDLE_SECONDS = 300.0
"""How long the process is kept without a job."""
_PATIENCE = 3.0
_LOAD_PATIENCE = 10.0
"""Seconds in which a process must answer what nobody waits for any more, or is ended."""
Value = TypeVar("Value")
OnProgress = Callable[[int, int, Any], None]
"""Gets how much is done, of how much, and the part of the answer that is new."""


def _ignore(done: int, total: int, part: Any) -> None:
    pass


class Asker:
    """Asks the worker that plays: any number of questions at a time, from any threads, each with its own answer."""

    def __init__(self, send: Callable[[Request], None]) -> None:
        self._send = send
        self._numbers = count(1)
        self._condition = threading.Condition()
        self._heard: dict[int, deque[Answer | Progress]] = {}
        """What came for each question that is under way, and was not taken."""

    def ask(
        self, check: Callable[[], None], question: Question[Value], on_progress: OnProgress = _ignore
    ) -> Value:
        """
        Args:
            check: called often meanwhile; what it raises ends the question, whose answer is then dropped.

        Raises:
            JobFailed: it cannot be answered.
        """
        with self._condition:
            number = next(self._numbers)
            self._heard[number] = deque()
        try:
            self._send(Call(number, question))
            while True:
                check()
                event = self._next(number)
                if isinstance(event, Progress):
                    part = _unpacked(event.part, question.part) if event.part else None
                    on_progress(event.done, event.total, part)
                elif event is not None:
                    return _value(event, question)
        finally:
            with self._condition:
                del self._heard[number]

    def take(self, event: Answer | Progress) -> None:
        """What the worker said."""
        with self._condition:
            if event.number in self._heard:
                self._heard[event.number].append(event)
                self._condition.notify_all()

    def _next(self, number: int) -> Answer | Progress | None:
        with self._condition:
            heard = self._heard[number]
            self._condition.wait_for(lambda: heard, _LOOK)
            return heard.popleft() if heard else None


class GaveWay(Exception):
    """A job that comes first wants the process: what was asked is to be asked again, in another turn."""


_Rank = tuple[bool, int]
"""Whether somebody waits for a job, and its number: the highest comes first."""


class Background(Asker):
    """Asks a process in the background, one thing at a time; within a turn, where several jobs share it.

    The process ends with the thread that started it, which is that of the lane that came first.
    """

    def __init__(self, niceness: int = _NICENESS) -> None:
        """
        Args:
            niceness: by how much other processes come first.
        """
        super().__init__(self._send_call)
        self._niceness = niceness
        self._turns = threading.Condition()
        self._has_it: _Rank | None = None
        self._waiting: list[_Rank] = []
        self._idle: threading.Timer | None = None
        """Ends the process if nobody wants it meanwhile."""
        self._process: WorkerProcess | None = None
        self._owed: Call | None = None
        self._loaded: Load | None = None
        """What was loaded last; None after a failure."""
        self._placed: dict[CameraKey, PlaceCamera] = {}
        self.num_envs = 0
        """Of the version that the process has open; 0 for none."""

    @property
    def pid(self) -> int | None:
        """None while there is no process."""
        process = self._process
        return None if process is None else process.pid

    @contextmanager
    def turn(self, job: Job, aside: bool = False) -> Iterator[None]:
        """What a job asks is asked within this. It begins when nobody has the process and none that comes first wants it;
        where one does in the middle, `ask` raises GaveWay.

        Args:
            aside: nobody waits for this job: all others come first, and not only those that are begun later.

        Raises:
            Stopped: the job is to stop.
        """
        self._take(job, (not aside, job.number))
        try:
            yield
        finally:
            self._settle(job)
            with self._turns:
                self._has_it = None
                self._rest_later()
                self._turns.notify_all()

    def in_turns(self, job: Job, work: Callable[[], Value], aside: bool = False) -> Value:
        """Do `work`, as often as it had to give way once more; the envs are not where it left them then."""
        while True:
            try:
                with self.turn(job, aside):
                    return work()
            except GaveWay:
                job.tell(0, 0, WAITING)

    def has(self, load: Load) -> bool:
        """Whether it would not have to be loaded."""
        return load.level == "auto" and self._loaded == load

    def _rest_later(self) -> None:
        if self._idle is not None:
            self._idle.cancel()
        self._idle = threading.Timer(IDLE_SECONDS, self._rest)
        self._idle.daemon = True
        self._idle.start()

    def _rest(self) -> None:
        with self._turns:
            # There was a turn since, or there is one, which will say when it ends.
            if threading.current_thread() is self._idle and self._has_it is None and not self._waiting:
                self.end()

    def _take(self, job: Job, rank: _Rank) -> None:
        with self._turns:
            self._waiting.append(rank)
            try:
                while self._has_it is not None or max(self._waiting) > rank:
                    job.check()
                    self._turns.wait(_LOOK)
                self._has_it = rank
            finally:
                self._waiting.remove(rank)

    def _is_wanted(self) -> bool:
        """Whether a job waits that comes before the one that has it."""
        with self._turns:
            return self._has_it is not None and max(self._waiting, default=self._has_it) > self._has_it

    def start(self) -> None:
        """Have a process.

        Raises:
            JobFailed: none could be started.
        """
        if self._process is not None:
            return
        try:
            # What the author's code prints in it is heard of the worker that plays, and not said twice.
            self._process = WorkerProcess(lambda stream, piece: False, self._niceness)
        except OSError as error:
            raise JobFailed(f"no process could be started in the background: {error}") from error

    def ensure(
        self, job: Job, load: Load, placed: tuple[PlaceCamera, ...] = (), or_else: Load | None = None
    ) -> int:
        """Have a process with that version, and cameras where they are placed; started, loaded and placed if need be.

        Args:
            load: a level that is named is always loaded.
            or_else: what is loaded where `load` fails.

        Returns:
            how many envs it has.

        Raises:
            Stopped: the job is to stop.
            JobFailed: it cannot be had; with the problem, if the author's code raised.
        """
        if self._process is None:
            job.tell(0, 0, "starting a process in the background")
            job.check()  # or a job that was stopped meanwhile would start a process for nobody
            self.start()
        if not self.has(load):
            self._loaded = None
            job.tell(0, 0, "building envs in the background")
            try:
                loaded = self.ask(job.check, load)
            except JobFailed as failure:
                if failure.problem is None:
                    raise
                if or_else is None:
                    why = f"the task failed in the background: {failure.problem.message}"
                    raise JobFailed(why, failure.problem) from failure
                loaded = self.ask(job.check, or_else)
            self._loaded, self.num_envs = load, loaded.task.num_envs
            if loaded.reload is None or loaded.reload.level not in ("same", "patched"):
                self._placed = {}
        wanted = {request.key: request for request in placed}
        # Those that are placed no more go back to where the file says.
        for key in [key for key in self._placed if key not in wanted]:
            self.ask(job.check, PlaceCamera(key, None))
            del self._placed[key]
        for key, request in wanted.items():
            if self._placed.get(key) != request:
                self.ask(job.check, request)
                self._placed[key] = request
        return self.num_envs

    def ask(
        self, check: Callable[[], None], question: Question[Value], on_progress: OnProgress = _ignore
    ) -> Value:
        """As `Asker.ask`.

        Raises:
            JobFailed: it cannot be answered, or the process died.
            GaveWay: the process is wanted. A load is not left: who waits most likely needs it too.
        """

        def check_turn() -> None:
            check()
            if not isinstance(question, Load) and self._is_wanted():
                raise GaveWay

        check_turn()  # or who waits would wait for this too
        try:
            return super().ask(check_turn, question, on_progress)
        except EOFError as error:
            why = self._why_gone(error)
            self.end()
            check()
            raise JobFailed(f"the process in the background {why}") from None

    def end(self) -> None:
        """End it, if there is one. `pid` is its own until it has ended."""
        with self._turns:
            if self._process is not None:
                self._process.stop(grace=0.0)
            self._process, self._owed, self._loaded, self._placed, self.num_envs = None, None, None, {}, 0

    def _settle(self, job: Job) -> None:
        """Take the answer that is still owed, or end the process that does not give it in time."""
        if self._process is None or self._owed is None:
            return
        self._process.send(Cancel())
        patience = _LOAD_PATIENCE if isinstance(self._owed.request, Load) else _PATIENCE
        deadline = time.monotonic() + patience
        try:
            while self._owed is not None and not job.closing:
                if time.monotonic() > deadline:
                    self.end()
                    return
                self._next(self._owed.number)
        except EOFError:
            self.end()  # of what it was asked for last; the next job starts another

    def _send_call(self, request: Request) -> None:
        assert self._process is not None and isinstance(request, Call)
        self._owed = request
        self._process.send(request)

    def _next(self, number: int) -> Answer | Progress | None:
        assert self._process is not None
        event: Any = self._process.receive(timeout=_LOOK)
        if not isinstance(event, Answer | Progress) or event.number != number:
            return None
        if isinstance(event, Answer):
            self._owed = None
        return event

    def _why_gone(self, error: EOFError) -> str:
        if isinstance(error, Unreadable):
            return f"sent what cannot be read ({error}) and was ended"
        return describe_exit(None if self._process is None else self._process.exit_code())


def _value(answer: Answer, question: Question[Value]) -> Value:
    if answer.why:
        raise JobFailed(answer.why, answer.problem)
    return _unpacked(answer.value, value_type(type(question)))


def _unpacked(packed: bytes, kind: Any) -> Any:
    try:
        return Unpacker().unpack(packed, kind)
    except Unreadable as error:
        raise JobFailed(f"the worker answered with what cannot be read ({error})") from error
