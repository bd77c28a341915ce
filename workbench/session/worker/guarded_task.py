"""The worker's line to the server, the task that it holds open, and what happens when its author's code raises or is left
by hand.

Whichever part of the worker calls into the task does it through here, so that each failure ends the same way: the steps
that wait are dropped if somebody interrupted, the server is told with the author's line, and the batch stands again
where the last step ended.
"""

from __future__ import annotations

import socket
import traceback
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import get_args

from workbench.authoring.loading.modules import is_own_file
from workbench.authoring.problem import Interrupted, Problem, TaskError, problem_from_exception
from workbench.core.snapshots.snapshot import restore_snapshot
from workbench.jobs.open_task import OpenedTask
from workbench.machine.processes.wire import MessageSocket, Unreadable
from workbench.session.process.heartbeat import Doing, HeartbeatWriter, Interrupts
from workbench.session.protocol.messages import Event, Load, LoadFailed, Request, without_steps
from workbench.session.protocol.questions import QUESTIONS
from workbench.session.worker.step_events import StepEvents

_STAGE: dict[Doing, str] = {"loading": "build", "stepping": "step", "resetting": "reset"}


class ServerLine:
    """What the server asks, in order, and what it is told. One that is gone is an end like any other: nothing raises here,
    and `closed` says so. What is sent is sent whole, whatever the person at the page interrupts meanwhile.
    """

    def __init__(self, connection: int, interrupts: Interrupts) -> None:
        self._line = MessageSocket(socket.socket(fileno=connection), get_args(Request), QUESTIONS)
        self._interrupts = interrupts
        self._queue: deque[Request] = deque()
        """What has come and was not carried out."""
        self.closed = False
        """The server hung up."""

    def listen(self, timeout: float) -> None:
        """Wait so many seconds for requests, and queue what has come."""
        self._queue.extend(self._requests(timeout))

    def next(self) -> Request | None:
        """The next request that is queued."""
        return self._queue.popleft() if self._queue else None

    def waits(self) -> bool:
        """Whether something has come that is not even queued."""
        return self._line.waits()

    def send(self, event: Event) -> None:
        try:
            with self._interrupts.shielded():
                self._line.send(event)
        except OSError:
            self.closed = True

    def drop_steps(self) -> None:
        """What was pressed while a hook hung is not to make it hang again. Before the page is told of the
        interrupt: what is pressed after that is meant."""
        with self._interrupts.shielded():
            waiting = [*self._queue, *self._requests(0.0)]
            self._queue = deque(without_steps(waiting))

    def _requests(self, timeout: float) -> list[Request]:
        """What has come; of several loads only the last, since each replaces the one before."""
        requests: list[Request] = []
        try:
            while (request := self._line.receive(0.0 if requests else timeout)) is not None:
                requests.append(request)
        except Unreadable:
            raise  # the server is believed: what it sent and cannot be read is a fault of ours
        except EOFError:
            self.closed = True
        loads = [request for request in requests if isinstance(request, Load)]
        return [request for request in requests if not isinstance(request, Load) or request is loads[-1]]


class GuardedTask:
    """See the module's text."""

    def __init__(
        self,
        line: ServerLine,
        interrupts: Interrupts,
        heartbeat: HeartbeatWriter,
        steps: StepEvents,
        on_failure: Callable[[], None],
    ) -> None:
        """
        Args:
            steps: has the moment that is gone back to.
            on_failure: called when the server has been told of one.
        """
        self.line, self.interrupts, self.heartbeat, self.steps = line, interrupts, heartbeat, steps
        self._on_failure = on_failure
        self.opened: OpenedTask | None = None
        self.asked_for: Path | None = None
        """The file that is to be loaded, whether or not it ever was."""

    def at_work(self, doing: Doing | None, work: Callable[[], object]) -> Problem | None:
        """Do `work`; if the author's code is at work in it, it can be left. What it failed with was told.

        An exception that is none of Python's ordinary ones (a KeyboardInterrupt, which nobody but the author's code
        raises here, or a class of theirs) is a failure like others; an ordinary one is the workbench's own, and ends
        the process.
        """
        if doing is None:
            work()
            return None
        self.heartbeat.begin(doing)
        try:
            self.interrupts.run(work)
        except Exception:
            raise
        except BaseException as error:
            # Outside of what knows its task: between two hooks, or in the workbench's own code.
            if isinstance(error, Interrupted):
                self.line.drop_steps()
            problem = problem_from_exception(error, _STAGE.get(doing, "step"), self._own_files(error))
            self.fail(problem)
            self.back_to_the_moment()
            return problem
        finally:
            self.heartbeat.begin("idle")
        return None

    def _own_files(self, error: BaseException) -> list[Path]:
        """The author's files, with those on the traceback that lie beside the task and were never loaded whole."""
        known = [] if self.opened is None else list(self.opened.loaded.source_files)
        if self.asked_for is not None:
            beside, frames = self.asked_for.parent, traceback.extract_tb(error.__traceback__)
            known += [Path(frame.filename) for frame in frames if is_own_file(frame.filename, beside)]
        return known

    def guarded(self, do: Callable[[OpenedTask], object]) -> None:
        """Do it with the task, if there is one; what raises a TaskError has failed."""
        if self.opened is None:
            return
        try:
            do(self.opened)
        except TaskError as error:
            left = self.drop_steps_if_left(error)
            self.fail(error.problem)
            if left:
                self.back_to_the_moment()

    def drop_steps_if_left(self, error: TaskError) -> bool:
        """Whether somebody had the author's code left; then the steps that wait are dropped."""
        left = isinstance(error.__cause__, Interrupted)
        if left:
            self.line.drop_steps()
        return left

    def fail(self, problem: Problem) -> None:
        """Tell the server, and stop playing."""
        self.line.send(LoadFailed(problem, kept=self.opened is not None))
        self._on_failure()

    def back_to_the_moment(self) -> None:
        """After a step was left half done: the batch stands again where the last one ended."""
        if self.opened is None or self.steps.moment is None:
            return
        try:
            # Not `TaskEnv.restore`: that calls `evaluate`, which may be what would not end.
            restore_snapshot(self.opened.env.env, self.steps.moment)
        except (RuntimeError, ValueError, TypeError) as error:
            self.fail(problem_from_exception(error, "reset", self.opened.loaded.source_files))
