"""Asks questions of the worker that plays and of a second process in the background."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from functools import partial
from itertools import count
from typing import Any, Literal, TypeVar

from workbench.envs.camera_data import CameraKey
from workbench.live.messages import Answer, Cancel, Load, PlaceCamera, Progress, Request
from workbench.live.process.background_jobs import Job, JobFailed, ProcessDied
from workbench.live.process.worker_process import WorkerProcess
from workbench.machine import loop
from workbench.machine.processes.family import describe_exit
from workbench.machine.processes.watched_thread import report_failure
from workbench.machine.processes.wire import Call, Question, Unpacker, Unreadable, value_type

_POLL_SECONDS = 1.0
"""Interval at which a silent process is checked for being alive."""
_NICENESS = 10
"""Niceness of the background process: the worker that plays has priority when cores are scarce."""
WAITING = "waiting for other work in the background"
IDLE_SECONDS = 300.0
"""Time for which an idle process is kept."""
_STDERR_BYTES = 4096
"""Bytes kept from the end of ``stderr``: the last line is quoted if the process ends with an error."""
CANCEL_TIMEOUT_SECONDS = 3.0
LOAD_CANCEL_TIMEOUT_SECONDS = 10.0
"""Timeout for the answer to a cancelled load; then the process is ended. For other questions it is
`CANCEL_TIMEOUT_SECONDS`."""
Value = TypeVar("Value")
OnProgress = Callable[[int, int, Any], None]
"""Progress callback: gets done, total, and the new part of the answer."""


def _ignore(done: int, total: int, part: Any) -> None:
    pass


@dataclass(frozen=True)
class _Asked:
    """A pending question."""

    question: Question[Any]
    answer: asyncio.Future[Any]
    on_progress: OnProgress


class QuestionClient:
    """Asks questions of the worker that plays; several may be pending. Used on the loop."""

    def __init__(self, send: Callable[[Request], None]) -> None:
        self._send = send
        self._numbers = count(1)
        self._asked: dict[int, _Asked] = {}
        """Pending questions by number."""

    async def ask(self, question: Question[Value], on_progress: OnProgress = _ignore) -> Value:
        """Ask a question and return the answer, unless the caller is cancelled meanwhile.

        Raises:
            JobFailed: there is no answer.
        """
        number = next(self._numbers)
        asked = _Asked(question, asyncio.get_running_loop().create_future(), on_progress)
        self._asked[number] = asked
        try:
            self._send(Call(number, question))
            return await asked.answer
        finally:
            del self._asked[number]

    def take(self, event: Answer | Progress) -> None:
        """Handle an event of the worker."""
        asked = self._asked.get(event.number)
        if asked is None or asked.answer.done():
            return
        try:
            if isinstance(event, Answer):
                asked.answer.set_result(_value(event, asked.question))
            else:
                part = _unpacked(event.part, asked.question.part) if event.part else None
                asked.on_progress(event.done, event.total, part)
        except Exception as error:
            asked.answer.set_exception(error)

    def _fail(self, error: Exception) -> None:
        """Fail all pending questions with `error`."""
        for asked in self._asked.values():
            if not asked.answer.done():
                asked.answer.set_exception(error)


class Preempted(Exception):
    """A job of higher rank needs the process; the caller must ask the question again in its next turn."""


Priority = Literal["person", "low", "lowest"]
"""Priority of a job: ``person`` if the user waits for it, ``low`` if its results are wanted soon, else
``lowest``."""
_ORDER: dict[Priority, int] = {"person": 2, "low": 1, "lowest": 0}
_Rank = tuple[int, int]
"""Rank of a job: its priority and its number; the highest rank runs first."""


class Background(QuestionClient):
    """Asks questions of a background process, one at a time. Jobs use it in turns. Used on the loop.

    Rescoring the past, rendering it and searching for cameras take seconds to minutes and move the envs, so they cannot
    run in the worker that plays. The background process has a higher niceness, takes some seconds to start,
    uses 0.75 GB, and ends after `IDLE_SECONDS` without a job.

    Of the jobs with the highest priority the newest runs first, since the user waits for it; the others are
    preempted and continue later. A worker answers in order, so a job that stops or is preempted leaves one
    pending answer. The next turn starts when this answer has arrived; if it does not arrive in time, the
    process is ended. If the process dies, its job fails, and the next job starts another process.
    """

    def __init__(self, niceness: int = _NICENESS) -> None:
        """
        Args:
            niceness: as for ``nice``.
        """
        super().__init__(self._send_call)
        self._niceness = niceness
        self._turn: _Rank | None = None
        """Rank of the job whose turn it is; None between two turns."""
        self._waiting: dict[_Rank, asyncio.Future[None]] = {}
        self._idle: asyncio.TimerHandle | None = None
        """Timer that ends an idle process."""
        self._process: _Process | None = None
        self._ending: set[_Process] = set()
        self._unanswered: Call | None = None
        self._overdue: asyncio.TimerHandle | None = None
        """Timer that ends the process if the answer to a cancelled question does not arrive."""
        self._loaded: Load | None = None
        """The last load; None after a failure."""
        self._placed: dict[CameraKey, PlaceCamera] = {}
        self.num_envs = 0
        """Number of envs of the version that is loaded in the process; 0 for none."""

    @property
    def pid(self) -> int | None:
        """Process id; None without a process. A process that is being ended still counts."""
        process = self._process or next(iter(self._ending), None)
        return None if process is None else process.pid

    # --- turns ---------------------------------------------------------------------------------------

    async def in_turns(
        self, job: Job, work: Callable[[], Awaitable[Value]], priority: Priority = "person"
    ) -> Value:
        """Run `work` when it is this job's turn. If a job of higher rank preempts `work`, `work` is called
        again in the next turn; the envs are in another state then.
        """
        rank = _ORDER[priority], job.number
        while True:
            await self._begin_turn(rank)
            try:
                return await work()
            except Preempted:
                job.report(0, 0, WAITING)
            finally:
                self._end_turn()

    async def _begin_turn(self, rank: _Rank) -> None:
        granted = self._waiting[rank] = asyncio.get_running_loop().create_future()
        if self._is_waited_for() and not _is_load(self._question):
            self._fail(Preempted())
        self._grant()
        try:
            await granted
        except asyncio.CancelledError:
            if self._turn == rank:
                self._end_turn()  # the turn was granted at the same moment
            raise
        finally:
            self._waiting.pop(rank, None)

    def _grant(self) -> None:
        if self._turn is not None or self._unanswered is not None:
            return
        if self._idle is not None:
            self._idle.cancel()
        # If two jobs are stopped at once, one of them may still be in the list.
        waiting = [rank for rank, granted in self._waiting.items() if not granted.done()]
        if not waiting:
            self._idle = loop.later(IDLE_SECONDS, self.end)
            return
        self._turn = max(waiting)
        self._waiting.pop(self._turn).set_result(None)

    def _end_turn(self) -> None:
        self._turn = None
        if self._unanswered is not None and self._process is not None:
            self._process.send(Cancel())
            timeout = LOAD_CANCEL_TIMEOUT_SECONDS if _is_load(self._question) else CANCEL_TIMEOUT_SECONDS
            self._overdue = loop.later(timeout, self.end)
        self._grant()

    def _is_waited_for(self) -> bool:
        """Whether a waiting job has a higher rank than the job that has the process."""
        return self._turn is not None and max(self._waiting, default=self._turn) > self._turn

    @property
    def _question(self) -> Any:
        return None if self._unanswered is None else self._unanswered.request

    # --- questions -----------------------------------------------------------------------------------

    def has_loaded(self, load: Load) -> bool:
        """Whether the version of `load` is loaded; False for a level other than ``auto``."""
        return load.level == "auto" and self._loaded == load

    async def ensure(
        self, job: Job, load: Load, placed: tuple[PlaceCamera, ...] = (), or_else: Load | None = None
    ) -> int:
        """Start the process, load this version and place the cameras, unless that was done before.

        Args:
            load: the version; with a level other than ``auto`` it is loaded in any case.
            or_else: loaded if the author's code raises in `load`.

        Returns:
            the number of envs.

        Raises:
            JobFailed: one of these steps failed; `JobFailed.problem` is set if the author's code raised.
        """
        if self._process is None:
            job.report(0, 0, "starting a process in the background")
        if not self.has_loaded(load):
            self._loaded = None
            job.report(0, 0, "building envs in the background")
            try:
                loaded = await self.ask(load)
            except JobFailed as failure:
                if failure.problem is None:
                    raise
                if or_else is None:
                    why = f"the task failed in the background: {failure.problem.message}"
                    raise JobFailed(why, failure.problem) from failure
                loaded = await self.ask(or_else)
            self._loaded, self.num_envs = load, loaded.task.num_envs
            if loaded.reload is None or loaded.reload.level not in ("same", "patched"):
                self._placed = {}
        wanted = {request.key: request for request in placed}
        # Cameras that are not in `placed` any more go back to the file's pose.
        for key in [key for key in self._placed if key not in wanted]:
            await self.ask(PlaceCamera(key, None))
            del self._placed[key]
        for key, request in wanted.items():
            if self._placed.get(key) != request:
                await self.ask(request)
                self._placed[key] = request
        return self.num_envs

    async def ask(self, question: Question[Value], on_progress: OnProgress = _ignore) -> Value:
        """Ask a question as `QuestionClient.ask` does; starts the process if there is none.

        Raises:
            JobFailed: there is no answer.
            ProcessDied: there is no answer because the process died.
            Preempted: a job of higher rank waits. A load is not preempted: the waiting job probably needs it
                too.
        """
        # Check before sending: otherwise the waiting job would have to wait for the answer.
        if self._is_waited_for() and not _is_load(question):
            raise Preempted
        if self._idle is not None:
            self._idle.cancel()  # or the process would be ended during a long question outside a turn
        if self._process is None:
            self._process = _Process(self, self._niceness)
        return await super().ask(question, on_progress)

    def take(self, event: Answer | Progress) -> None:
        super().take(event)
        if isinstance(event, Answer) and self._unanswered is not None:
            if event.number == self._unanswered.number:
                self._answered()

    def _answered(self) -> None:
        self._unanswered = None
        if self._overdue is not None:
            self._overdue.cancel()
            self._overdue = None
        self._grant()

    def _send_call(self, request: Request) -> None:
        assert self._process is not None and isinstance(request, Call)
        self._unanswered = request
        self._process.send(request)

    # --- the process ---------------------------------------------------------------------------------

    @loop.on_loop
    def end(self) -> None:
        """End the process, if there is one."""
        process, self._process = self._process, None
        if process is None:
            return
        self._ending.add(process)
        process.kill()
        self._forget(ProcessDied("the process in the background was ended"))

    def close(self) -> None:
        """End the process; returns when it has ended. Called on another thread than the loop."""
        self.end()
        for process in loop.do(lambda: tuple(self._ending)):
            process.join()

    def _ended(self, process: _Process, why: str) -> None:
        """Handle the end of this process."""
        self._ending.discard(process)
        if process is self._process:
            self._process = None
            self._forget(ProcessDied(why))

    def _forget(self, error: ProcessDied) -> None:
        self._loaded, self._placed, self.num_envs = None, {}, 0
        self._fail(error)
        self._answered()


class _Process:
    """A worker process, started and read on its own thread; the kernel ends the process with that thread."""

    def __init__(self, background: Background, niceness: int) -> None:
        self._background, self._niceness = background, niceness
        self._worker: WorkerProcess | None = None
        self._unsent: list[Request] = []
        self._killed = False
        self._stderr = b""
        """The last bytes of the process's ``stderr``."""
        self._lock = threading.Lock()
        """Guards `_worker`, `_unsent` and `_killed`: requests are queued until the process has started."""
        self._thread = threading.Thread(target=self._run, name="background", daemon=True)
        self._thread.start()

    @property
    def pid(self) -> int | None:
        worker = self._worker
        return None if worker is None else worker.pid

    def send(self, request: Request) -> None:
        with self._lock:
            if self._worker is None:
                self._unsent.append(request)
            else:
                self._worker.send(request)

    def kill(self) -> None:
        with self._lock:
            self._killed = True
            if self._worker is not None:
                self._worker.kill()

    def join(self) -> None:
        self._thread.join()

    def _run(self) -> None:
        why = "the workbench itself failed while it read from the process in the background"
        try:
            why = self._serve()
        except OSError as error:
            why = f"no process could be started in the background: {error}"
        except Exception as error:
            report_failure("Reading from the process in the background failed", error)
        finally:
            loop.do(partial(self._background._ended, self, why))

    def _serve(self) -> str:
        """Start the process and read its events until it ends; returns why it ended."""
        # The author's output is not shown, since the worker that plays shows the same. Only the end of
        # stderr is kept, to explain a death.
        worker = WorkerProcess(self._keep_end_of_stderr, self._niceness)
        code: int | None = None
        with self._lock:
            self._worker = worker
            for request in self._unsent:
                worker.send(request)
            if self._killed:
                worker.kill()
        try:
            while True:
                event: Any = worker.receive(timeout=_POLL_SECONDS)
                if isinstance(event, Answer | Progress):
                    loop.do(partial(self._take, event))
        except Unreadable as error:
            why = f"sent unreadable data ({error}) and was ended"
        except EOFError:
            code = worker.exit_code()
            why = describe_exit(code)
        worker.stop(grace=0.0)  # afterwards all its output has been read
        if (code or 0) > 0 and (last := self._stderr.decode(errors="replace").strip().rpartition("\n")[2]):
            why += f": {last}"
        return f"the process in the background {why}"

    def _take(self, event: Answer | Progress) -> None:
        if self._background._process is self:
            self._background.take(event)

    def _keep_end_of_stderr(self, stream: str, piece: bytes) -> bool:
        if stream == "stderr":
            self._stderr = (self._stderr + piece)[-_STDERR_BYTES:]
        return False


def _is_load(question: object) -> bool:
    return isinstance(question, Load)


def _value(answer: Answer, question: Question[Value]) -> Value:
    if answer.why:
        raise JobFailed(answer.why, answer.problem)
    return _unpacked(answer.value, value_type(type(question)))


def _unpacked(packed: bytes, kind: Any) -> Any:
    try:
        return Unpacker().unpack(packed, kind)
    except Unreadable as error:
        raise JobFailed(f"the worker answered with unreadable data ({error})") from error
