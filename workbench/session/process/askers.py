"""Asks questions of the worker that plays, and of a second process in the background."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import count
from typing import Any, Literal, TypeVar

from workbench.core.camera_data import CameraKey
from workbench.machine.processes.family import describe_exit
from workbench.machine.processes.wire import Call, Question, Unpacker, Unreadable, value_type
from workbench.session.process.job_lane import Job, JobFailed, ProcessDied
from workbench.session.process.worker_process import WorkerProcess
from workbench.session.protocol.messages import Answer, Cancel, Load, PlaceCamera, Progress, Request

_LOOK = 0.05
"""Seconds between two checks whether the job is stopped."""
_NICENESS = 10
"""The worker that plays comes first where there are fewer cores than work."""
WAITING = "waiting for other work in the background"
IDLE_SECONDS = 300.0
"""How long an idle process is kept."""
_KEPT_OF_WORDS = 4096
"""Bytes of what a process writes to ``stderr``: the last line is quoted if it ends with an error."""
_PATIENCE = 3.0
_LOAD_PATIENCE = 10.0
"""Seconds in which a process must answer a cancelled question, or is ended."""
Value = TypeVar("Value")
OnProgress = Callable[[int, int, Any], None]
"""Gets done, total, and the new part of the answer."""


def _ignore(done: int, total: int, part: Any) -> None:
    pass


class Asker:
    """Asks the worker that plays. Thread-safe; several questions may be under way."""

    def __init__(self, send: Callable[[Request], None]) -> None:
        self._send = send
        self._numbers = count(1)
        self._condition = threading.Condition()
        self._received: dict[int, deque[Answer | Progress]] = {}
        """Received and not yet handled, for each question under way."""

    def ask(
        self, check: Callable[[], None], question: Question[Value], on_progress: OnProgress = _ignore
    ) -> Value:
        """
        Args:
            check: called often while waiting; an exception from it ends the question, and the answer is dropped.

        Raises:
            JobFailed: there is no answer.
        """
        with self._condition:
            number = next(self._numbers)
            self._received[number] = deque()
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
                del self._received[number]

    def take(self, event: Answer | Progress) -> None:
        """Handle an event of the worker."""
        with self._condition:
            if event.number in self._received:
                self._received[event.number].append(event)
                self._condition.notify_all()

    def _next(self, number: int) -> Answer | Progress | None:
        with self._condition:
            received = self._received[number]
            self._condition.wait_for(lambda: received, _LOOK)
            return received.popleft() if received else None


class GaveWay(Exception):
    """A job of higher priority needs the process: ask again in another turn."""


Priority = Literal["person", "low", "lowest"]
"""Whether a person waits for the job; else whether its results are wanted soon."""
_ORDER: dict[Priority, int] = {"person": 2, "low": 1, "lowest": 0}
_Rank = tuple[int, int]
"""The place of its priority, and the job's number: the highest comes first."""


class Background(Asker):
    """Asks a process in the background, one question at a time. Jobs share it in turns.

    Rescoring the past, drawing it and searching cameras take seconds to minutes and move the envs, so they cannot run
    in the worker that plays. This process has a lower priority; it costs some seconds to start and 0.75 GB. It ends
    after `IDLE_SECONDS` without a job, and with the thread that started it, that of the first lane.

    The job that was begun last comes first, since a person waits for it: the others give way and continue later. A
    worker answers in order, so a job that stops or gives way leaves one unread answer, which is taken at the end of its
    turn, or the process is ended. A process that dies fails its job; the next job starts another.
    """

    def __init__(self, niceness: int = _NICENESS) -> None:
        """
        Args:
            niceness: as for ``nice``.
        """
        super().__init__(self._send_call)
        self._niceness = niceness
        self._turns = threading.Condition()
        self._current: _Rank | None = None
        self._waiting: list[_Rank] = []
        self._idle: threading.Timer | None = None
        """Ends the process if it stays idle."""
        self._process: WorkerProcess | None = None
        self._said = b""
        """The end of what the process wrote to ``stderr``."""
        self._unanswered: Call | None = None
        self._loaded: Load | None = None
        """The last load; None after a failure."""
        self._placed: dict[CameraKey, PlaceCamera] = {}
        self.num_envs = 0
        """Of the version that is open in the process; 0 for none."""

    @property
    def pid(self) -> int | None:
        """None while there is no process."""
        process = self._process
        return None if process is None else process.pid

    @contextmanager
    def turn(self, job: Job, priority: Priority = "person") -> Iterator[None]:
        """Hold the process for a job. Waits while another job has it, or one of higher priority waits; where such a job
        comes during the turn, `ask` raises GaveWay.

        Raises:
            Stopped: the job was stopped.
        """
        self._begin_turn(job, (_ORDER[priority], job.number))
        try:
            yield
        finally:
            self._settle(job)
            with self._turns:
                self._current = None
                self._end_when_idle()
                self._turns.notify_all()

    def in_turns(self, job: Job, work: Callable[[], Value], priority: Priority = "person") -> Value:
        """Run `work` in a turn, again after each time it gave way; the envs are elsewhere then."""
        while True:
            try:
                with self.turn(job, priority):
                    return work()
            except GaveWay:
                job.report(0, 0, WAITING)

    def has_loaded(self, load: Load) -> bool:
        """Whether this version is loaded."""
        return load.level == "auto" and self._loaded == load

    def _end_when_idle(self) -> None:
        if self._idle is not None:
            self._idle.cancel()
        self._idle = threading.Timer(IDLE_SECONDS, self._end_if_idle)
        self._idle.daemon = True
        self._idle.start()

    def _end_if_idle(self) -> None:
        with self._turns:
            # A turn since then has set another timer.
            if threading.current_thread() is self._idle and self._current is None and not self._waiting:
                self.end()

    def _begin_turn(self, job: Job, rank: _Rank) -> None:
        with self._turns:
            self._waiting.append(rank)
            try:
                while self._current is not None or max(self._waiting) > rank:
                    job.check()
                    self._turns.wait(_LOOK)
                self._current = rank
            finally:
                self._waiting.remove(rank)

    def _must_give_way(self) -> bool:
        """Whether a job of higher priority waits."""
        with self._turns:
            return self._current is not None and max(self._waiting, default=self._current) > self._current

    def start(self) -> None:
        """Start the process if there is none.

        Raises:
            JobFailed: it cannot be started.
        """
        if self._process is not None:
            return
        try:
            # The worker that plays shows the author's output; here it would appear twice. Its last words tell why it died.
            self._said = b""
            self._process = WorkerProcess(self._hear, self._niceness)
        except OSError as error:
            raise JobFailed(f"no process could be started in the background: {error}") from error

    def ensure(
        self, job: Job, load: Load, placed: tuple[PlaceCamera, ...] = (), or_else: Load | None = None
    ) -> int:
        """Start the process, load this version and place the cameras, as far as that is not done.

        Args:
            load: with a level other than ``auto`` it is always loaded.
            or_else: loaded if `load` fails.

        Returns:
            the number of envs.

        Raises:
            Stopped: the job was stopped.
            JobFailed: one of the steps failed; with the problem, if the author's code raised.
        """
        if self._process is None:
            job.report(0, 0, "starting a process in the background")
            job.check()  # a stopped job must not start a process
            self.start()
        if not self.has_loaded(load):
            self._loaded = None
            job.report(0, 0, "building envs in the background")
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
        # A camera that is no longer placed goes back to the file's pose.
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
            JobFailed: there is no answer.
            ProcessDied: for that reason.
            GaveWay: a job of higher priority waits. A load is finished first: that job most likely needs it too.
        """

        def check_turn() -> None:
            check()
            if not isinstance(question, Load) and self._must_give_way():
                raise GaveWay

        check_turn()  # before the question: the waiting job would wait for it too
        try:
            return super().ask(check_turn, question, on_progress)
        except EOFError as error:
            if isinstance(error, Unreadable):
                code, why = None, f"sent unreadable data ({error}) and was ended"
            else:
                code = None if self._process is None else self._process.exit_code()
                why = describe_exit(code)
            self.end()  # all that it wrote is read then
            check()
            if (code or 0) > 0 and (last := self._said.decode(errors="replace").strip().rpartition("\n")[2]):
                why += f": {last}"
            raise ProcessDied(f"the process in the background {why}") from None

    def end(self) -> None:
        """End the process, if there is one. `pid` stays its own until it has ended."""
        with self._turns:
            if self._process is not None:
                self._process.stop(grace=0.0)
            self._process, self._unanswered, self._loaded, self._placed, self.num_envs = (
                None,
                None,
                None,
                {},
                0,
            )

    def _settle(self, job: Job) -> None:
        """Read the answer that is still due; end the process if it does not come in time."""
        if self._process is None or self._unanswered is None:
            return
        self._process.send(Cancel())
        patience = _LOAD_PATIENCE if isinstance(self._unanswered.request, Load) else _PATIENCE
        deadline = time.monotonic() + patience
        try:
            while self._unanswered is not None and not job.closing:
                if time.monotonic() > deadline:
                    self.end()
                    return
                self._next(self._unanswered.number)
        except EOFError:
            self.end()  # it died of the last question; the next job starts another

    def _send_call(self, request: Request) -> None:
        assert self._process is not None and isinstance(request, Call)
        self._unanswered = request
        self._process.send(request)

    def _next(self, number: int) -> Answer | Progress | None:
        assert self._process is not None
        event: Any = self._process.receive(timeout=_LOOK)
        if not isinstance(event, Answer | Progress) or event.number != number:
            return None
        if isinstance(event, Answer):
            self._unanswered = None
        return event

    def _hear(self, stream: str, piece: bytes) -> bool:
        if stream == "stderr":
            self._said = (self._said + piece)[-_KEPT_OF_WORDS:]
        return False


def _value(answer: Answer, question: Question[Value]) -> Value:
    if answer.why:
        raise JobFailed(answer.why, answer.problem)
    return _unpacked(answer.value, value_type(type(question)))


def _unpacked(packed: bytes, kind: Any) -> Any:
    try:
        return Unpacker().unpack(packed, kind)
    except Unreadable as error:
        raise JobFailed(f"the worker answered with unreadable data ({error})") from error
