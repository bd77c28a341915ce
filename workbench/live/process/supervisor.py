"""Keeps a worker running: starts it, watches it, and replaces it when it ends."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, auto

from workbench.live.messages import (
    Answer,
    EnterRecording,
    Event,
    ListenForDebugger,
    Load,
    Loaded,
    Loading,
    Request,
    Reset,
    Restore,
    SingleStep,
    WarmUp,
    hands_over,
)
from workbench.live.process.heartbeat import Beat, Busy, Doing, busy_at, fatal_error
from workbench.live.process.memory_limit import format_size
from workbench.live.process.worker_process import Output, WorkerProcess
from workbench.machine.processes.family import describe_exit
from workbench.machine.processes.watched_thread import report_failure
from workbench.machine.processes.wire import Call, Unreadable
from workbench.task.problem import shorten

_LOOK = 0.1
"""Seconds between two checks of the worker."""
_BUSY = 2.0
_LONG: dict[Doing, float] = {"starting": 20.0, "warming up": 20.0, "drawing": 20.0}
"""Seconds after which a piece of work is reported, for work that takes long anyway: imports, shaders. For other work
see `_BUSY`."""
_STACK_EVERY = 1.0
"""Seconds between two reads of the worker's stack."""
_IGNORED_AFTER = 1.5
"""Seconds after an interrupt in which the author's code must have ended."""
_LOAD_WAITS = 2.0
"""Seconds that a load may wait behind other work; then that work is interrupted."""
_LONGEST_SILENCE = 4.0
"""Seconds after the interrupt at which the worker is ended if the load still waits."""
_AFTER_A_FAILURE = 0.5
_HEADLESS = 1.0
"""Seconds without a main thread after which a worker is ended; a process that exits has none for a moment."""
_MOST_DEATHS = 3
"""Most workers that may die in a row without a load in between."""
_SPARE_DELAY = 5.0
"""Seconds between a load and the start of a spare."""
_MOST_SPARE_FAILURES = 2
"""Most spares that may die while they warm up; then no more are started."""


@dataclass(frozen=True)
class WorkerOptions:
    """Limits and debugging of a session's workers."""

    memory_limit: int | None = None
    """Bytes of memory of the worker and the processes that it started; None sets no limit."""
    spare: bool = False
    """Keep a second, warmed-up worker to replace one that dies."""
    debug_port: int | None = None
    """Every worker listens there, on this machine only, for a debugger; None for none."""
    debug_wait: bool = False
    """The first worker loads nothing until a debugger has attached."""


class End(Enum):
    """How a worker came to its end."""

    DIED = auto()
    ASKED = auto()
    """Ended by `Supervisor.replace`."""
    FILE_WAITS = auto()
    """Killed because it did not begin a load."""
    HANDED_OVER = auto()
    """Ended because another process has to continue, see `messages.hands_over`."""


@dataclass(frozen=True)
class Death:
    """The end of a worker."""

    why: str
    """Why it ended, for example ``was killed by SIGSEGV``."""
    end: End
    doing: str | None
    """What the worker was doing; None for an idle worker."""
    stack: str
    """The worker's last stack, as faulthandler writes it; may be empty."""
    gives_up: bool
    """Whether too many workers died: the next is started only when `Supervisor.replace` is called."""


@dataclass(frozen=True)
class ProcessMemory:
    """Memory of the processes."""

    memory: int = 0
    """Bytes of the worker and the processes that it started."""
    memory_limit: int | None = None
    spare_memory: int | None = None
    """Bytes of the spare; None while there is none."""
    spare_ready: bool = False


class SpareWorker:
    """A second, warmed-up worker that replaces one that dies. Used on one thread, which must live as long as it.

    A new worker makes a render system and compiles its shaders, and where it is no fork (`worker_start`) it imports torch,
    SAPIEN and ManiSkill, 4 s and more. The spare does this in the background once a task runs, and then sleeps; it costs
    memory (`memory`). After it is taken, the next one is started a while later.
    """

    def __init__(self, warm_up: WarmUp) -> None:
        self._warm_up = warm_up
        self._process: WorkerProcess | None = None
        self._ready = False
        self._failures = 0
        self._due: float | None = None

    def begin_soon(self) -> None:
        """Start a spare after `_SPARE_DELAY`, if there is none."""
        if self._process is None and self._due is None and self._failures < _MOST_SPARE_FAILURES:
            self._due = time.monotonic() + _SPARE_DELAY

    def poll(self) -> None:
        """Start a spare if it is due, and read its events. Does not block."""
        if self._process is None:
            if self._due is not None and time.monotonic() >= self._due:
                self._due = None
                # ManiSkill and the renderer print in it what the first worker has shown already.
                self._process = WorkerProcess(lambda stream, piece: False)
                self._process.send(Call(0, self._warm_up))
            return
        try:
            while (event := self._process.receive(timeout=0)) is not None:
                self._ready = self._ready or isinstance(event, Answer)
        except EOFError:
            self._failures += 1
            self.stop()
            self.begin_soon()

    def take(self) -> WorkerProcess | None:
        """Hand over the spare, which may not be ready yet; None if there is none."""
        self.poll()
        taken, self._process, self._ready, self._due = self._process, None, False, None
        return taken

    @property
    def ready(self) -> bool:
        return self._process is not None and self._ready

    @property
    def memory(self) -> int:
        """Bytes of memory of the spare; 0 without one."""
        process = self._process
        return 0 if process is None else process.memory()

    def kill(self) -> None:
        """End the spare without waiting; `stop` waits."""
        if self._process is not None:
            self._process.kill()

    def stop(self) -> None:
        """End the spare and wait for its end."""
        process, self._process, self._ready, self._due = self._process, None, False, None
        if process is not None:
            process.stop(grace=0.0)


class Supervisor:
    """Runs one worker after the other, and reports why each ended.

    The author's code may crash its process, exit it, loop for ever or fill the memory; the page must survive that. One
    thread starts a worker, sends it the requests of `first_requests`, hands on its events and checks it ten times a second. When it
    ends, the thread reports why and takes the next, from the spare if there is one.

    Only two things make it end a worker unasked: memory above the limit, and a load that waits behind work that cannot
    be interrupted, since a corrected file must not wait for a worker that hangs. A busy worker may just be slow: it is
    reported with its line and left alone. Time during which a debugger holds the worker does not count.
    """

    def __init__(
        self,
        options: WorkerOptions,
        warm_up: WarmUp,
        *,
        first_requests: Callable[[], list[Request]],
        on_event: Callable[[Event], None],
        on_death: Callable[[Death], None],
        on_busy: Callable[[Busy | None], None],
        own_files: Callable[[], list[str]],
        output: Output,
    ) -> None:
        """The callbacks are called on this object's threads, and may call `send`, `replace` and `interrupt`.

        Args:
            first_requests: requests for each new worker: the state that the previous one had.
            on_busy: called about once a second during a long piece of work, and with None when it is done.
            own_files: the author's files, to find their line on a stack.
            output: as for `WorkerProcess`.
        """
        self._options, self._warm_up = options, warm_up
        self._first_requests, self._on_event, self._on_death, self._on_busy = (
            first_requests,
            on_event,
            on_death,
            on_busy,
        )
        self._own_files, self._output = own_files, output
        self._condition = threading.Condition()
        self._worker: WorkerProcess | None = None
        self._spare: SpareWorker | None = SpareWorker(warm_up) if options.spare else None
        self._vitals = ProcessMemory(memory_limit=options.memory_limit)
        self._load_sent: float | None = None
        self._replace_asked = False
        self._closing = False
        self._hands_over = False
        self._pressed: list[Request] = []
        """Requests from a person that wait for the next worker."""
        self._begun = False
        """Whether the worker has got its first requests."""
        self._late: Load | None = None
        """Load that was sent before the worker had its first requests, perhaps too late to be among them."""
        self._deaths = 0
        self._interrupted: tuple[int, float] | None = None
        self._lives = 0
        self._thread = threading.Thread(target=self._run, name="session", daemon=True)

    def start(self) -> None:
        """Start the thread and the first worker."""
        self._thread.start()

    @property
    def pid(self) -> int | None:
        """Process id of the current worker; None between two workers."""
        with self._condition:
            worker = self._worker
        return None if worker is None else worker.pid

    @property
    def vitals(self) -> ProcessMemory:
        """Memory of the processes, as measured at the last check."""
        return self._vitals

    @property
    def load_pending(self) -> bool:
        """Whether the worker has not begun a load that was sent."""
        return self._load_sent is not None

    def send(self, request: Request) -> None:
        """Send to the current worker. While one hands over to the next, what a person pressed waits, and so does a load that
        came too late for the `first_requests` of the next. Everything else that is sent between two workers is lost;
        `first_requests` must include its effect."""
        with self._condition:
            worker = self._worker
            if isinstance(request, Load) and not self._begun:
                self._late = request
                return
            if isinstance(request, Load) and self._load_sent is None:
                self._load_sent = time.monotonic()
            if self._hands_over:
                if isinstance(request, SingleStep | Reset | Restore | EnterRecording):
                    self._pressed.append(request)
                return
        if worker is not None:
            worker.send(request)

    def interrupt(self) -> None:
        """Raise Interrupted in the author's code, if Python runs it and no debugger holds it."""
        with self._condition:
            worker = self._worker
        if worker is not None:
            beat = worker.beat()
            # A held worker runs the debugger's own code.
            if beat.seconds > 0 and not beat.held:
                self._interrupted = beat.number, time.monotonic()
                worker.interrupt()

    def replace(self) -> None:
        """End the worker and start another."""
        with self._condition:
            self._replace_asked, self._deaths = True, 0
            self._condition.notify_all()

    def reset_deaths(self) -> None:
        """Start counting deaths again from 0: a task was loaded."""
        self._deaths = 0

    def stop(self) -> None:
        """End the worker for good; returns when the thread has ended."""
        with self._condition:
            self._closing = True
            self._condition.notify_all()
        self._thread.join()

    def _run(self) -> None:
        try:
            while self._run_worker_safely():
                pass
        finally:
            if self._spare is not None:
                self._spare.stop()

    def _run_worker_safely(self) -> bool:
        """Run `_run_worker`; an exception in it ends the worker, not the thread."""
        try:
            return self._run_worker()
        except Exception as error:
            # Not in a new thread: the kernel ends a worker with the thread that started it.
            report_failure("The thread that supervises the worker failed and is started again", error)
            with self._condition:
                worker, self._worker, self._begun = self._worker, None, False
                self._deaths += 1
                gives_up = self._deaths >= _MOST_DEATHS
            if worker is not None:
                worker.stop(grace=0.0)
            why = f"was lost by the thread that supervises it ({type(error).__name__}: {shorten(str(error))})"
        try:
            self._on_death(Death(why, End.DIED, None, "", gives_up))
        except Exception as failure:
            report_failure("The page cannot be told that the worker was lost", failure)
        with self._condition:
            # A pause, or what fails at once would use up all attempts.
            self._condition.wait_for(
                lambda: self._replace_asked or self._closing, None if gives_up else _AFTER_A_FAILURE
            )
            return not self._closing

    def _run_worker(self) -> bool:
        """Run one worker from start to end. Returns False if there is to be no other."""
        worker = self._spare.take() if self._spare is not None else None
        if worker is None:
            worker = WorkerProcess(self._output)
        else:
            worker.redirect_output(self._output)
        with self._condition:
            self._worker, self._load_sent, self._replace_asked = worker, None, False
            self._interrupted = None
        if self._options.debug_port is not None:
            first = self._lives == 0
            worker.send(ListenForDebugger(self._options.debug_port, self._options.debug_wait and first))
        self._lives += 1
        requests = self._first_requests()
        if not any(isinstance(request, Load) for request in requests):
            # No version to bring back: the mended file, which comes next, finds shaders and imports ready.
            requests.append(Call(0, self._warm_up))
        first = max((request.number for request in requests if isinstance(request, Load)), default=0)
        with self._condition:
            requests += self._pressed
            if self._late is not None and self._late.number > first:
                requests.append(self._late)
                self._load_sent = time.monotonic()
            self._pressed, self._late, self._hands_over, self._begun = [], None, False, True
            for request in requests:
                worker.send(request)
        state = _WorkerState()
        try:
            self._serve(worker, state)
        except Unreadable as error:
            state.why = f"sent unreadable data ({error}) and was ended"
            worker.kill()
        except EOFError:
            try:
                self._drain_events(worker)
            except Exception as error:
                report_failure("The last that a worker sent could not be taken", error)
        except Exception as error:
            # An event that does not fit the state is treated as one that cannot be read.
            report_failure("What the worker sent could not be taken, so it is ended", error)
            state.why = f"sent unusable data ({type(error).__name__}: {shorten(str(error))}) and was ended"
            worker.kill()
        self._on_busy(None)
        if self._closing:
            if self._spare is not None:
                self._spare.kill()  # before the worker: freeing a gigabyte takes a while, so both do it at once
            worker.stop(grace=0.3)  # nothing is lost: the server has all that is kept
            return False
        code = worker.exit_code()
        if code is None and state.why is None:
            state.why = "closed its line to the server and was ended"
        report, beat = worker.crash_report(), worker.beat()  # both files outlive the process
        worker.stop(grace=0.0)
        with self._condition:
            self._worker, self._begun = None, False
            if self._replace_asked:
                state.end = End.ASKED
            self._deaths += state.end is End.DIED
            gives_up = self._deaths >= _MOST_DEATHS
        seen = state.stack if state.stack_of == beat.number else ""
        stack = report if fatal_error(report) is not None else seen
        # A crash may take a while, and is then seen as a main thread that ended, or as half a message.
        crashed = code is not None and code < 0 and code != -signal.SIGKILL
        why = describe_exit(code) if crashed or state.why is None else state.why
        self._on_death(Death(why, state.end, _doing(beat), stack, gives_up))
        with self._condition:
            if gives_up:
                self._condition.wait_for(lambda: self._replace_asked or self._closing)
            return not self._closing

    def _serve(self, worker: WorkerProcess, state: _WorkerState) -> None:
        """Hand on events and check the worker until it is gone (EOFError) or this object closes."""
        looked = 0.0
        while not self._closing:
            event = worker.receive(timeout=_LOOK)
            if isinstance(event, Loading):
                self._load_sent = None
            if isinstance(event, Loaded) and self._spare is not None:
                self._spare.begin_soon()
            if hands_over(event):
                with self._condition:
                    self._hands_over, self._begun = True, False
            if event is not None:
                self._on_event(event)
            if hands_over(event):
                state.end, state.why = End.HANDED_OVER, "was ended for another to go on"
                worker.kill()
                raise EOFError
            if time.monotonic() - looked >= _LOOK:
                looked = time.monotonic()
                self._check(worker, state)
                if self._spare is not None:
                    self._spare.poll()

    def _drain_events(self, worker: WorkerProcess) -> None:
        """Handle the events that the worker sent before it died: a recording loses only the step under way."""
        try:
            while (event := worker.receive(timeout=_LOOK)) is not None:
                self._on_event(event)
        except EOFError:
            return

    def _check(self, worker: WorkerProcess, state: _WorkerState) -> None:
        now = time.monotonic()
        beat = worker.beat()
        if self._replace_asked:
            state.why = "was stopped by hand"
            self._end(worker, state)
        if not worker.main_thread_ended():
            state.headless_since = None
        elif state.headless_since is None:
            state.headless_since = now
        elif now - state.headless_since > _HEADLESS:
            state.why = "was ended because its main thread had ended and left another thread running,"
            self._end(worker, state)
        self._check_memory(worker, state)
        if beat.held != state.held:
            # Reported at once, and time counts from here: the debugger's time is not the task's.
            state.held, state.held_changed, state.reported = beat.held, now, 0.0
        load_sent = self._load_sent
        if load_sent is not None and not beat.held and beat.doing not in _LONG and beat.since < load_sent:
            waited = now - max(load_sent, state.held_changed)
            # Counted from the interrupt: a load that is interrupted must close what it built.
            ignored = self._since_interrupt(beat)
            if waited > _LOAD_WAITS and ignored is None:
                self.interrupt()
            elif waited > _LOAD_WAITS and ignored is not None and ignored > _LONGEST_SILENCE:
                state.why = f"did not answer for {waited:.0f} s"
                state.end = End.FILE_WAITS
                self._end(worker, state)
        seconds = min(beat.seconds, now - state.held_changed)
        if not beat.held and seconds < _LONG.get(beat.doing, _BUSY):
            if state.reported is not None:
                state.reported = None
                self._on_busy(None)
        elif state.reported is None or now - state.reported >= _STACK_EVERY:
            state.reported = now
            self._read_stack(worker, state, beat)
            ignores_interrupt = (self._since_interrupt(beat) or 0.0) > _IGNORED_AFTER
            self._on_busy(
                busy_at(seconds, beat.doing, state.stack, self._own_files(), ignores_interrupt, beat.held)
            )

    def _check_memory(self, worker: WorkerProcess, state: _WorkerState) -> None:
        limit = self._options.memory_limit
        used = worker.memory(limit)
        spare = self._spare.memory if self._spare is not None else 0
        ready = self._spare is not None and self._spare.ready
        self._vitals = ProcessMemory(used, limit, spare or None, ready)
        if limit is not None and used > limit:
            state.why = (
                f"was ended because it and what it started had {format_size(used)} in memory, more than the {format_size(limit)} that "
                "--memory-limit allows,"
            )
            self._end(worker, state)

    def _since_interrupt(self, beat: Beat) -> float | None:
        """Seconds since this piece of work was interrupted; None if not interrupted."""
        number, moment = self._interrupted or (0, 0.0)
        return time.monotonic() - moment if number == beat.number else None

    def _read_stack(self, worker: WorkerProcess, state: _WorkerState, beat: Beat) -> None:
        if state.stack_of != beat.number:
            state.stack, state.stack_of = "", beat.number
        state.stack = worker.stack() or state.stack

    def _end(self, worker: WorkerProcess, state: _WorkerState) -> None:
        beat = worker.beat()
        if beat.seconds > 0:
            self._read_stack(worker, state, beat)
        worker.kill()
        raise EOFError


@dataclass
class _WorkerState:
    """State of one worker."""

    why: str | None = None
    """Why the supervisor ended it."""
    end: End = End.DIED
    stack: str = ""
    stack_of: int = 0
    """Number of the piece of work that `stack` was read in."""
    headless_since: float | None = None
    """When the worker was first seen without its main thread."""
    reported: float | None = None
    """When the worker was last reported as busy."""
    held: bool = False
    """Whether a debugger held it at the last check."""
    held_changed: float = 0.0
    """When `held` last changed."""


def _doing(beat: Beat) -> str | None:
    return None if beat.doing in ("idle", "starting") else beat.doing
