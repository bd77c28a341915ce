"""A worker that is always there: one process after the other, with a reason for each end.

The author's code may crash its process, exit it, loop for ever or fill the memory, and the page must not care.
One thread starts a worker, greets it, hands on its events, looks at it ten times a second, and when it ends says
why and takes the next, from the warm spare if there is one.

It ends a worker by itself for two reasons only: more memory than allowed; and a load that waits behind
something that cannot be interrupted, since a mended file must not wait behind a worker that hangs. One that is
merely busy is never ended unasked, as it may only be slow: that it is busy, with what and where, is told. While a
debugger makes it stand still, no time passes for it.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from workbench.authoring.problem import shorten
from workbench.jobs.pool import Answer
from workbench.machine.processes.family import describe_exit
from workbench.machine.processes.watched_thread import report_failure
from workbench.machine.processes.wire import Call, Unreadable
from workbench.session.process.heartbeat import Beat, Busy, Doing, busy_at, fatal_error
from workbench.session.process.memory_limit import in_words
from workbench.session.process.worker_process import Output, WorkerProcess
from workbench.session.protocol.messages import (
    Event,
    ListenForDebugger,
    Load,
    Loaded,
    Loading,
    Request,
    WarmUp,
)

_LOOK = 0.1
"""Seconds between two looks at the worker."""
_BUSY = 2.0
_LONG: dict[Doing, float] = {"starting": 20.0, "warming up": 20.0, "drawing": 20.0}
"""Seconds of one piece of work after which it is told: importing and compiling shaders takes long anyway."""
_STACK_EVERY = 1.0
"""Seconds between two looks at where it is."""
_DEAF = 1.5
"""Seconds after an interrupt in which the author's code must have been left."""
_LOAD_WAITS = 2.0
"""Seconds that a load may wait behind something else, which is then interrupted ..."""
_LONGEST_SILENCE = 4.0
"""... and so many later the worker is ended."""
_AFTER_A_FAILURE = 0.5
_HEADLESS = 1.0
"""Seconds without a main thread; in the midst of its end a process has none either."""
_MOST_DEATHS = 3
"""Workers that may die one after the other without a load in between."""
_SPARE_DELAY = 5.0
"""Seconds after a task was loaded in which the machine is left to the page."""
_MOST_SPARE_FAILURES = 2
"""Spares that may die of their warming up; after that the machine cannot have one."""


@dataclass(frozen=True)
class WorkerOptions:
    """How the processes of a session are kept."""

    memory_limit: int | None = None
    """Bytes that the worker and what it started may have in memory; None sets no limit."""
    spare: bool = False
    """Keep a second worker, warmed up, to take the place of one that dies."""
    debug_port: int | None = None
    """Every worker listens there, on this machine only, for a debugger; None for none."""
    debug_wait: bool = False
    """The first worker loads nothing until one has attached."""


@dataclass(frozen=True)
class Death:
    """The end of a worker."""

    why: str
    """For example ``was killed by SIGSEGV``."""
    asked: bool
    """Somebody had it replaced."""
    file_waits: bool
    """It was ended because it did not take up a load."""
    doing: str | None
    """What it was at; None for nothing."""
    stack: str
    """Where it was, as faulthandler writes it; may be empty."""
    gives_up: bool
    """Too many died: the next is started only when `Supervisor.replace` is called."""


@dataclass(frozen=True)
class Vitals:
    """What the processes hold."""

    memory: int = 0
    """Bytes of the worker, with the processes that it started."""
    memory_limit: int | None = None
    spare_memory: int | None = None
    """Bytes of the spare; None while there is none."""
    spare_ready: bool = False


class SpareWorker:
    """A second worker that waits, warmed up, for the first one to die. Used on one thread, which must live as long as it.

    A worker that starts from nothing imports torch, SAPIEN and ManiSkill (4 s and more), makes a render system and
    has its shaders compiled (5 to 19 s on a software renderer). Somebody whose task has just crashed should not
    wait for that. So once a task runs, another process does all of it in the background and then sleeps; it
    costs memory (`memory` says how much) and no time. When it is taken, the next one is begun a while later.
    """

    def __init__(self, warm_up: WarmUp) -> None:
        self._warm_up = warm_up
        self._process: WorkerProcess | None = None
        self._ready = False
        self._failures = 0
        self._due: float | None = None

    def begin_soon(self) -> None:
        """The first worker is well: there may be a spare, after a while."""
        if self._process is None and self._due is None and self._failures < _MOST_SPARE_FAILURES:
            self._due = time.monotonic() + _SPARE_DELAY

    def attend(self) -> None:
        """Start one if it is due, and notice how it does; takes no time."""
        if self._process is None:
            if self._due is not None and time.monotonic() >= self._due:
                self._due = None
                # What it prints is of ManiSkill's and the renderer's making, and was seen before.
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
        """The spare, which is the caller's from now on; None if there is none. It may not be quite ready."""
        self.attend()
        taken, self._process, self._ready, self._due = self._process, None, False, None
        return taken

    @property
    def ready(self) -> bool:
        return self._process is not None and self._ready

    @property
    def memory(self) -> int:
        """Bytes that it holds; 0 when there is none."""
        process = self._process
        return 0 if process is None else process.memory()

    def kill(self) -> None:
        """Have it end, without waiting for it; `stop` does that."""
        if self._process is not None:
            self._process.kill()

    def stop(self) -> None:
        """End it; it has nothing to lose."""
        process, self._process, self._ready, self._due = self._process, None, False, None
        if process is not None:
            process.stop(grace=0.0)


class Supervisor:
    """Requests go to whichever worker there is; `greet` tells each new one what the last one knew."""

    def __init__(
        self,
        options: WorkerOptions,
        warm_up: WarmUp,
        *,
        greet: Callable[[], list[Request]],
        on_event: Callable[[Event], None],
        on_death: Callable[[Death], None],
        on_busy: Callable[[Busy | None], None],
        own_files: Callable[[], list[str]],
        output: Output,
    ) -> None:
        """The callbacks are called on this object's threads, and may call `send`, `replace` and `interrupt`.

        Args:
            on_busy: called about once a second while the worker is at one piece of work for long, and with
                None when it is done.
            own_files: the author's files, to find their line on a stack.
            output: as for `WorkerProcess`.
        """
        self._options, self._warm_up = options, warm_up
        self._greet, self._on_event, self._on_death, self._on_busy = greet, on_event, on_death, on_busy
        self._own_files, self._output = own_files, output
        self._condition = threading.Condition()
        self._worker: WorkerProcess | None = None
        self._spare: SpareWorker | None = SpareWorker(warm_up) if options.spare else None
        self._vitals = Vitals(memory_limit=options.memory_limit)
        self._load_sent: float | None = None
        self._replace_asked = False
        self._closing = False
        self._deaths = 0
        self._interrupted: tuple[int, float] | None = None
        self._lives = 0
        self._thread = threading.Thread(target=self._run, name="session", daemon=True)

    def start(self) -> None:
        """Start the first worker, on a thread of its own."""
        self._thread.start()

    @property
    def pid(self) -> int | None:
        """Of the present worker; None between two."""
        with self._condition:
            worker = self._worker
        return None if worker is None else worker.pid

    @property
    def vitals(self) -> Vitals:
        """What the processes hold, as of the last look."""
        return self._vitals

    @property
    def load_waits(self) -> bool:
        """Whether a load was sent that the worker has not taken up."""
        return self._load_sent is not None

    def send(self, request: Request) -> None:
        """To the present worker; between two it is lost, and `greet` must make up for it."""
        with self._condition:
            worker = self._worker
            if isinstance(request, Load) and self._load_sent is None:
                self._load_sent = time.monotonic()
        if worker is not None:
            worker.send(request)

    def interrupt(self) -> None:
        """Have the author's code left where it is, if it is at work and Python runs it, and no debugger holds it."""
        with self._condition:
            worker = self._worker
        if worker is not None:
            beat = worker.beat()
            # What runs while it is held is the debugger's own code.
            if beat.seconds > 0 and not beat.held:
                self._interrupted = beat.number, time.monotonic()
                worker.interrupt()

    def replace(self) -> None:
        """End the worker, whatever it is doing, and start another."""
        with self._condition:
            self._replace_asked, self._deaths = True, 0
            self._condition.notify_all()

    def ran(self) -> None:
        """A task was loaded: earlier deaths are forgiven."""
        self._deaths = 0

    def stop(self) -> None:
        """End the worker for good; returns when the thread has ended."""
        with self._condition:
            self._closing = True
            self._condition.notify_all()
        self._thread.join()

    def _run(self) -> None:
        try:
            while self._one_life_or_its_failure():
                pass
        finally:
            if self._spare is not None:
                self._spare.stop()

    def _one_life_or_its_failure(self) -> bool:
        """As `_one_life`; where that itself fails the worker is lost, and not the thread."""
        try:
            return self._one_life()
        except Exception as error:
            # On this thread all the same: the kernel ends a worker with the thread that started it.
            report_failure("The thread that minds the worker failed and is started again", error)
            with self._condition:
                worker, self._worker = self._worker, None
                self._deaths += 1
                gives_up = self._deaths >= _MOST_DEATHS
            if worker is not None:
                worker.stop(grace=0.0)
            why = f"was lost by the thread that minds it ({type(error).__name__}: {shorten(str(error))})"
        try:
            self._on_death(Death(why, False, False, None, "", gives_up))
        except Exception as failure:
            report_failure("The page cannot be told that the worker was lost", failure)
        with self._condition:
            # A moment even for the first: what fails at once would use up all attempts.
            self._condition.wait_for(
                lambda: self._replace_asked or self._closing, None if gives_up else _AFTER_A_FAILURE
            )
            return not self._closing

    def _one_life(self) -> bool:
        """From the start of a worker to its end; False when there is to be no other."""
        worker = self._spare.take() if self._spare is not None else None
        if worker is None:
            worker = WorkerProcess(self._output)
        else:
            worker.hear(self._output)
        with self._condition:
            self._worker, self._load_sent, self._replace_asked = worker, None, False
            self._interrupted = None
        if self._options.debug_port is not None:
            first = self._lives == 0
            worker.send(ListenForDebugger(self._options.debug_port, self._options.debug_wait and first))
        self._lives += 1
        for request in self._greet():
            worker.send(request)
        life = _Life()
        try:
            self._attend(worker, life)
        except Unreadable as error:
            life.why = f"sent what cannot be read ({error}) and was ended"
            worker.kill()
        except EOFError:
            try:
                self._take_the_last_events(worker)
            except Exception as error:
                report_failure("The last that a worker sent could not be taken", error)
        except Exception as error:
            # What it sent is an event, and not one that fits what is known: as bad as no event.
            report_failure("What the worker sent could not be taken, so it is ended", error)
            life.why = (
                f"sent what cannot be used ({type(error).__name__}: {shorten(str(error))}) and was ended"
            )
            worker.kill()
        self._on_busy(None)
        if self._closing:
            if self._spare is not None:
                self._spare.kill()  # now: a gigabyte takes a while to be given back, and it need not be in a row
            worker.stop(grace=0.3)  # it has nothing to lose: what is kept is kept by the server
            return False
        code = worker.exit_code()
        words, beat = worker.last_words(), worker.beat()  # its memory outlives it
        worker.stop(grace=0.0)
        with self._condition:
            self._worker = None
            asked = self._replace_asked
            self._deaths += 0 if asked or life.file_waits else 1
            gives_up = self._deaths >= _MOST_DEATHS
        seen = life.stack if life.stack_of == beat.number else ""
        stack = words if fatal_error(words) is not None else seen
        self._on_death(
            Death(life.why or describe_exit(code), asked, life.file_waits, _doing(beat), stack, gives_up)
        )
        with self._condition:
            if gives_up:
                self._condition.wait_for(lambda: self._replace_asked or self._closing)
            return not self._closing

    def _attend(self, worker: WorkerProcess, life: _Life) -> None:
        """Hand on events and look after the worker until it is gone (EOFError) or all is to end."""
        looked = 0.0
        while not self._closing:
            event = worker.receive(timeout=_LOOK)
            if isinstance(event, Loading):
                self._load_sent = None
            if isinstance(event, Loaded) and self._spare is not None:
                self._spare.begin_soon()
            if event is not None:
                self._on_event(event)
            if time.monotonic() - looked >= _LOOK:
                looked = time.monotonic()
                self._look(worker, life)
                if self._spare is not None:
                    self._spare.attend()

    def _take_the_last_events(self, worker: WorkerProcess) -> None:
        """What it had sent before it was gone: a recording loses nothing but the step under way."""
        try:
            while (event := worker.receive(timeout=_LOOK)) is not None:
                self._on_event(event)
        except EOFError:
            return

    def _look(self, worker: WorkerProcess, life: _Life) -> None:
        now = time.monotonic()
        beat = worker.beat()
        if self._replace_asked:
            life.why = "was ended by hand"
            self._end(worker, life)
        if not worker.main_thread_ended():
            life.headless_since = None
        elif life.headless_since is None:
            life.headless_since = now
        elif now - life.headless_since > _HEADLESS:
            life.why = "was ended because its main thread had ended and left another thread running,"
            self._end(worker, life)
        self._look_at_memory(worker, life)
        if beat.held != life.held:
            # Told at once, and counted from here on: the time that a debugger held it is nobody's fault.
            life.held, life.turned, life.told = beat.held, now, 0.0
        load_sent = self._load_sent
        if load_sent is not None and not beat.held and beat.doing not in _LONG and beat.since < load_sent:
            waited = now - max(load_sent, life.turned)
            # Counted from the interrupt: leaving a load means to close what it had built.
            ignored = self._since_interrupt(beat)
            if waited > _LOAD_WAITS and ignored is None:
                self.interrupt()
            elif waited > _LOAD_WAITS and ignored is not None and ignored > _LONGEST_SILENCE:
                life.why = f"did not answer for {waited:.0f} s"
                life.file_waits = True
                self._end(worker, life)
        seconds = min(beat.seconds, now - life.turned)
        if not beat.held and seconds < _LONG.get(beat.doing, _BUSY):
            if life.told is not None:
                life.told = None
                self._on_busy(None)
        elif life.told is None or now - life.told >= _STACK_EVERY:
            life.told = now
            self._look_where(worker, life, beat)
            deaf = (self._since_interrupt(beat) or 0.0) > _DEAF
            self._on_busy(busy_at(seconds, beat.doing, life.stack, self._own_files(), deaf, beat.held))

    def _look_at_memory(self, worker: WorkerProcess, life: _Life) -> None:
        limit = self._options.memory_limit
        used = worker.memory(limit)
        spare = self._spare.memory if self._spare is not None else 0
        ready = self._spare is not None and self._spare.ready
        self._vitals = Vitals(used, limit, spare or None, ready)
        if limit is not None and used > limit:
            life.why = (
                f"was ended because it and what it started had {in_words(used)} in memory, more than the {in_words(limit)} that "
                "--memory-limit allows,"
            )
            self._end(worker, life)

    def _since_interrupt(self, beat: Beat) -> float | None:
        """Seconds since this piece of work was interrupted; None if it was not."""
        number, moment = self._interrupted or (0, 0.0)
        return time.monotonic() - moment if number == beat.number else None

    def _look_where(self, worker: WorkerProcess, life: _Life, beat: Beat) -> None:
        if life.stack_of != beat.number:
            life.stack, life.stack_of = "", beat.number
        life.stack = worker.stack() or life.stack

    def _end(self, worker: WorkerProcess, life: _Life) -> None:
        beat = worker.beat()
        if beat.seconds > 0:
            self._look_where(worker, life, beat)
        worker.kill()
        raise EOFError


@dataclass
class _Life:
    """What is known of one worker."""

    why: str | None = None
    """Why it was ended, if we ended it."""
    file_waits: bool = False
    stack: str = ""
    stack_of: int = 0
    """The piece of work that it was seen in."""
    headless_since: float | None = None
    """When it was first seen without its main thread."""
    told: float | None = None
    """When it was last told that the worker is busy."""
    held: bool = False
    """A debugger held it at the last look."""
    turned: float = 0.0
    """When that last changed."""


def _doing(beat: Beat) -> str | None:
    return None if beat.doing in ("idle", "starting") else beat.doing
