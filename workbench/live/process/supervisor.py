"""Keeps a worker running: starts it, watches it, and replaces it when it ends."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Mapping
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

_POLL_SECONDS = 0.1
"""Interval at which the worker is checked."""
BUSY_SECONDS = 2.0
SLOW_WORK_SECONDS: dict[Doing, float] = {"starting": 20.0, "warming up": 20.0, "drawing": 20.0}
"""Time after which slow work (imports, shaders) is reported as busy; for other work it is `BUSY_SECONDS`."""
STACK_PERIOD_SECONDS = 1.0
"""Interval at which the worker's stack is read."""
INTERRUPT_TIMEOUT_SECONDS = 1.5
"""Timeout for the author's code to end after an interrupt."""
LOAD_WAIT_SECONDS = 2.0
"""Time that a load may wait behind other work before this work is interrupted."""
SILENCE_TIMEOUT_SECONDS = 4.0
"""The worker is ended if the load still waits this long after the interrupt."""
RESTART_DELAY_SECONDS = 0.5
HEADLESS_SECONDS = 1.0
"""Time without a main thread after which a worker is ended; an exiting process has no main thread for a
moment."""
_MAX_DEATHS = 3
"""After this many deaths of workers in a row, without a load in between, the next worker is started only on
request."""
SPARE_DELAY_SECONDS = 5.0
"""Time between a load and the start of a spare."""
_MAX_SPARE_FAILURES = 2
"""When this many spares have died, no more are started."""


@dataclass(frozen=True)
class WorkerOptions:
    """Limits and debugging of a session's workers."""

    memory_limit: int | None = None
    """Maximum memory in bytes of the worker and the processes that it started; None: no limit."""
    spare: bool = False
    """Keep a second, warmed-up worker to replace one that dies."""
    debug_port: int | None = None
    """Port on which every worker listens for a debugger, on this machine only; None: no debugger."""
    debug_wait: bool = False
    """Whether the first worker waits for a debugger before it loads anything."""


class End(Enum):
    """How a worker ended."""

    DIED = auto()
    ASKED = auto()
    """Ended by `Supervisor.replace`."""
    FILE_WAITS = auto()
    """Killed because it did not begin a load."""
    HANDED_OVER = auto()
    """Ended so that another process continues, see `messages.hands_over`."""


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
    """Whether too many workers died in a row. If so, only `Supervisor.replace` starts the next one."""


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
    """A second, warmed-up worker that replaces a worker that dies. Used on one thread, which must outlive the
    spare.

    A new worker makes a render system and compiles its shaders; if it is not forked (`fork_client`), it also imports
    torch, SAPIEN and ManiSkill, which takes 4 s or more. The spare does this in the background once a task runs, then
    sleeps; it takes memory (`memory`). After it is taken, the next load starts another one (`begin_soon`).
    """

    def __init__(self, warm_up: WarmUp) -> None:
        self._warm_up = warm_up
        self._process: WorkerProcess | None = None
        self._ready = False
        self._failures = 0
        self._due: float | None = None

    def begin_soon(self) -> None:
        """Start a spare after `SPARE_DELAY_SECONDS`, if there is none."""
        if self._process is None and self._due is None and self._failures < _MAX_SPARE_FAILURES:
            self._due = time.monotonic() + SPARE_DELAY_SECONDS

    def poll(self) -> None:
        """Start a spare if it is due, and read its events. Does not block."""
        if self._process is None:
            if self._due is not None and time.monotonic() >= self._due:
                self._due = None
                # The spare's output is dropped: the first worker has already shown the same lines.
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
        """Return the spare, which may not be ready yet, and forget it; None if there is none."""
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
        """End the spare without waiting, unlike `stop`."""
        if self._process is not None:
            self._process.kill()

    def stop(self) -> None:
        """End the spare and wait for its end."""
        process, self._process, self._ready, self._due = self._process, None, False, None
        if process is not None:
            process.stop(grace=0.0)


class Supervisor:
    """Runs one worker after another, and reports why each ended.

    The author's code may crash its process, exit it, loop for ever or fill the memory; the page must survive that. One
    thread starts a worker, sends the requests of `first_requests`, forwards the worker's events and checks
    the worker ten times a second.
    When the worker ends, the thread reports why and continues with the next one: the spare, if there is one.

    The supervisor ends a worker whose main thread has ended or whose data is unusable. Otherwise it ends a
    worker in only two cases: memory above the limit, and a load that waits behind work that cannot be
    interrupted, since a corrected file must not wait for a worker that hangs. A busy worker may just be slow:
    it is reported with its line of code, and left alone. Time during which a debugger holds the worker does
    not count.
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
        texts: Callable[[bool], Mapping[str, str]],
        output: Output,
    ) -> None:
        """The callbacks are called on this object's threads, and may call `send`, `replace` and `interrupt`.

        Args:
            first_requests: returns the requests that restore the previous worker's state in a new worker.
            on_busy: called about once a second during a long piece of work, and with None at its end.
            own_files: returns the author's files, to find the author's line in a stack.
            texts: returns the source by path of the version that is loading (True) or running (False): the files may have
                been edited since. A missing file is read.
            output: as for `WorkerProcess`.
        """
        self._options, self._warm_up = options, warm_up
        self._first_requests, self._on_event, self._on_death, self._on_busy = (
            first_requests,
            on_event,
            on_death,
            on_busy,
        )
        self._own_files, self._texts, self._output = own_files, texts, output
        self._condition = threading.Condition()
        self._worker: WorkerProcess | None = None
        self._spare: SpareWorker | None = SpareWorker(warm_up) if options.spare else None
        self._vitals = ProcessMemory(memory_limit=options.memory_limit)
        self._load_sent: float | None = None
        self._replace_asked = False
        self._closing = False
        self._hands_over = False
        self._pressed: list[Request] = []
        """Requests of the user that wait for the next worker."""
        self._begun = False
        """Whether the first requests were sent to the worker."""
        self._late: Load | None = None
        """The last load that was sent between two workers; the next `first_requests` may not include it."""
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
        """Whether a load was sent that the worker has not begun."""
        return self._load_sent is not None

    def send(self, request: Request) -> None:
        """Send a request to the current worker. While one worker hands over to the next, commands of the user
        are queued for the next worker; so is a load that came too late for that worker's `first_requests`.
        Other requests that are sent between two workers are lost: `first_requests` must include their
        effect."""
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
        """Raise Interrupted in the author's code, if it is running in Python and not held by a debugger."""
        with self._condition:
            worker = self._worker
        if worker is not None:
            beat = worker.beat()
            # A worker held by a debugger runs the debugger's own code.
            if beat.seconds > 0 and not beat.held:
                self._interrupted = beat.number, time.monotonic()
                worker.interrupt()

    def replace(self) -> None:
        """End the worker and start another."""
        with self._condition:
            self._replace_asked, self._deaths = True, 0
            self._condition.notify_all()

    def reset_deaths(self) -> None:
        """Reset the count of deaths, because a task was loaded."""
        self._deaths = 0

    def stop(self) -> None:
        """End the worker without a successor; returns when the thread has ended."""
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
        """Run `_run_worker`; an exception ends the worker, not the thread."""
        try:
            return self._run_worker()
        except Exception as error:
            # Do not start a new thread: the kernel ends a worker with the thread that started it.
            report_failure("The supervision of the worker failed and is started again", error)
            with self._condition:
                worker, self._worker, self._begun = self._worker, None, False
                self._deaths += 1
                gives_up = self._deaths >= _MAX_DEATHS
            if worker is not None:
                worker.stop(grace=0.0)
            why = f"was lost by the thread that supervises it ({type(error).__name__}: {shorten(str(error))})"
        try:
            self._on_death(Death(why, End.DIED, None, "", gives_up))
        except Exception as failure:
            report_failure("The loss of the worker could not be reported to the page", failure)
        with self._condition:
            # Without a delay, a failure that repeats at once would use up all attempts.
            self._condition.wait_for(
                lambda: self._replace_asked or self._closing, None if gives_up else RESTART_DELAY_SECONDS
            )
            return not self._closing

    def _run_worker(self) -> bool:
        """Run one worker from start to end. Returns False if this object closes: no worker must follow."""
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
            # There is no version to restore: warm up, so that the fixed file finds shaders and imports ready.
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
                report_failure("The last events of a worker could not be handled", error)
        except Exception as error:
            # An event that cannot be handled is treated like unreadable data.
            report_failure("An event of the worker could not be handled, so the worker is ended", error)
            state.why = f"sent unusable data ({type(error).__name__}: {shorten(str(error))}) and was ended"
            worker.kill()
        self._on_busy(None)
        if self._closing:
            if self._spare is not None:
                self._spare.kill()  # before the worker, so that both free their gigabyte at the same time
            worker.stop(grace=0.3)  # a short grace loses nothing: the server has all data worth keeping
            return False
        code = worker.exit_code()
        if code is None and state.why is None:
            state.why = "closed its connection to the server and was ended"
        report, beat = worker.crash_report(), worker.beat()  # both files outlive the process
        worker.stop(grace=0.0)
        with self._condition:
            self._worker, self._begun = None, False
            if self._replace_asked:
                state.end = End.ASKED
            self._deaths += state.end is End.DIED
            gives_up = self._deaths >= _MAX_DEATHS
        seen = state.stack if state.stack_of == beat.number else ""
        stack = report if fatal_error(report) is not None else seen
        # A crash may take a while, and first show as an ended main thread or half a message: so its exit code
        # counts more than `state.why`.
        crashed = code is not None and code < 0 and code != -signal.SIGKILL
        why = describe_exit(code) if crashed or state.why is None else state.why
        self._on_death(Death(why, state.end, _doing(beat), stack, gives_up))
        with self._condition:
            if gives_up:
                self._condition.wait_for(lambda: self._replace_asked or self._closing)
            return not self._closing

    def _serve(self, worker: WorkerProcess, state: _WorkerState) -> None:
        """Forward events and check the worker until it has ended (EOFError) or this object closes."""
        looked = 0.0
        while not self._closing:
            event = worker.receive(timeout=_POLL_SECONDS)
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
                state.end, state.why = End.HANDED_OVER, "was ended so that another process continues"
                worker.kill()
                raise EOFError
            if time.monotonic() - looked >= _POLL_SECONDS:
                looked = time.monotonic()
                self._check(worker, state)
                if self._spare is not None:
                    self._spare.poll()

    def _drain_events(self, worker: WorkerProcess) -> None:
        """Handle the events that the worker sent before it died, so that a recording loses only the unfinished step."""
        try:
            while (event := worker.receive(timeout=_POLL_SECONDS)) is not None:
                self._on_event(event)
        except EOFError:
            return

    def _check(self, worker: WorkerProcess, state: _WorkerState) -> None:
        now = time.monotonic()
        beat = worker.beat()
        if self._replace_asked:
            state.why = "was stopped by the user"
            self._end(worker, state)
        if not worker.main_thread_ended():
            state.headless_since = None
        elif state.headless_since is None:
            state.headless_since = now
        elif now - state.headless_since > HEADLESS_SECONDS:
            state.why = "was ended because its main thread had ended and left another thread running,"
            self._end(worker, state)
        self._check_memory(worker, state)
        if beat.held != state.held:
            # Report the change at once, and measure from now on: time in the debugger is not the task's.
            state.held, state.held_changed, state.reported = beat.held, now, 0.0
        load_sent = self._load_sent
        if (
            load_sent is not None
            and not beat.held
            and beat.doing not in SLOW_WORK_SECONDS
            and beat.since < load_sent
        ):
            waited = now - max(load_sent, state.held_changed)
            # Count from the interrupt: an interrupted load needs time to close what it built.
            ignored = self._since_interrupt(beat)
            if waited > LOAD_WAIT_SECONDS and ignored is None:
                self.interrupt()
            elif waited > LOAD_WAIT_SECONDS and ignored is not None and ignored > SILENCE_TIMEOUT_SECONDS:
                state.why = f"did not answer for {waited:.0f} s"
                state.end = End.FILE_WAITS
                self._end(worker, state)
        seconds = min(beat.seconds, now - state.held_changed)
        if not beat.held and seconds < SLOW_WORK_SECONDS.get(beat.doing, BUSY_SECONDS):
            if state.reported is not None:
                state.reported = None
                self._on_busy(None)
        elif state.reported is None or now - state.reported >= STACK_PERIOD_SECONDS:
            state.reported = now
            self._read_stack(worker, state, beat)
            ignores_interrupt = (self._since_interrupt(beat) or 0.0) > INTERRUPT_TIMEOUT_SECONDS
            own, texts = self._own_files(), self._texts(beat.doing == "loading")
            self._on_busy(busy_at(seconds, beat.doing, state.stack, own, ignores_interrupt, beat.held, texts))

    def _check_memory(self, worker: WorkerProcess, state: _WorkerState) -> None:
        limit = self._options.memory_limit
        used = worker.memory(limit)
        spare = self._spare.memory if self._spare is not None else 0
        ready = self._spare is not None and self._spare.ready
        self._vitals = ProcessMemory(used, limit, spare or None, ready)
        if limit is not None and used > limit:
            state.why = (
                f"was ended because it and its child processes used {format_size(used)} of memory, more than "
                f"the {format_size(limit)} that --memory-limit allows,"
            )
            self._end(worker, state)

    def _since_interrupt(self, beat: Beat) -> float | None:
        """Seconds since this piece of work was interrupted; None if it was not."""
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
    """Why the supervisor ended the worker."""
    end: End = End.DIED
    stack: str = ""
    stack_of: int = 0
    """Number of the piece of work during which `stack` was read."""
    headless_since: float | None = None
    """When the worker was first seen without its main thread."""
    reported: float | None = None
    """When the worker was last reported as busy."""
    held: bool = False
    """Whether a debugger held the worker at the last check."""
    held_changed: float = 0.0
    """When `held` last changed."""


def _doing(beat: Beat) -> str | None:
    return None if beat.doing in ("idle", "starting") else beat.doing
