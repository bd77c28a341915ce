"""Calls the author's code in the worker and handles its errors."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from pathlib import Path

from workbench.envs.snapshots.snapshot import restore_snapshot
from workbench.live.messages import TaskFailed
from workbench.live.process.heartbeat import Doing, HeartbeatWriter, Interrupts
from workbench.live.worker.connection import ServerConnection
from workbench.live.worker.process_state import ProcessState, changed_settings, read_process_state, some_of
from workbench.live.worker.step_events import StepEvents
from workbench.task.modules import is_own_file
from workbench.task.open import OpenedTask
from workbench.task.problem import Interrupted, Problem, TaskError, problem_from_exception

REFUSED = "a refused version had run in the process"

_STAGE: dict[Doing, str] = {"loading": "build", "stepping": "step", "resetting": "reset"}


class GuardedTask:
    """The open task. All parts of the worker call the author's code through this object, so that every
    failure is handled in the same way: the server gets the problem with the author's line, and the batch is
    restored to the end of the last step. If the failure is an interrupt, waiting steps are dropped."""

    def __init__(
        self,
        line: ServerConnection,
        interrupts: Interrupts,
        heartbeat: HeartbeatWriter,
        steps: StepEvents,
        on_failure: Callable[[], None],
    ) -> None:
        """
        Args:
            steps: holds the snapshot of the last step.
            on_failure: called after a failure was sent.
        """
        self.line, self.interrupts, self.heartbeat, self.steps = line, interrupts, heartbeat, steps
        self._on_failure = on_failure
        self.opened: OpenedTask | None = None
        self.requested_file: Path | None = None
        """The last requested file, loaded or not."""
        self.failed = False
        """Whether a call of the code of `opened` has failed. That call may have stopped half-way."""
        self.when_loaded: ProcessState | None = None
        """Process settings at the end of the load of `opened`."""
        self.spoiled = False
        """Whether the author's code left something in this process that cannot be undone: the process must
        end."""

    def run(self, doing: Doing | None, work: Callable[[], object], loads: bool = False) -> Problem | None:
        """Run `work`. Returns the failure, which was sent to the server, or None.

        A BaseException that is not an Exception (KeyboardInterrupt, which only the author's code raises here,
        or an author's class) is a failure. An Exception is a bug of the workbench: it passes through, and
        ends the process.

        Args:
            doing: what the heartbeat shows; None if `work` runs no code of the author, and cannot be
                interrupted.
            loads: whether `work` loads a version; if `work` fails, this version is refused.
        """
        if doing is None:
            work()
            return None
        self.heartbeat.begin(doing)
        self.interrupts.begin()
        try:
            try:
                self.interrupts.allowed = True
                work()
            finally:
                self.interrupts.allowed = False
        except Exception:
            raise
        except BaseException as error:
            # The error was raised outside `blamed`: between two hooks, or in the workbench's own code.
            if isinstance(error, Interrupted):
                self.line.drop_steps()
            problem = problem_from_exception(error, _STAGE.get(doing, "step"), self._own_files(error))
            if loads:
                self.refuse(TaskFailed(problem, kept=self.opened is not None, spoiled=REFUSED))
            else:
                self.fail(problem)
            return problem
        finally:
            self.heartbeat.begin("idle")
        return None

    def _own_files(self, error: BaseException) -> list[Path]:
        """The author's files, and the files on the traceback that are in the task's folder: these may not be
        known yet, since their import may not have finished."""
        known = [] if self.opened is None else list(self.opened.loaded.source_files)
        if self.requested_file is not None:
            folder, frames = self.requested_file.parent, traceback.extract_tb(error.__traceback__)
            known += [Path(frame.filename) for frame in frames if is_own_file(frame.filename, folder)]
        return known

    def guarded(self, do: Callable[[OpenedTask], object]) -> None:
        """Call `do` with the task, if there is one; a TaskError is sent as a failure."""
        if self.opened is None:
            return
        try:
            do(self.opened)
        except TaskError as error:
            self.drop_steps_if_interrupted(error)
            self.fail(error.problem)

    def drop_steps_if_interrupted(self, error: TaskError) -> bool:
        """Drop the waiting steps if the user interrupted the author's code; returns whether the user did."""
        interrupted = isinstance(error.__cause__, Interrupted)
        if interrupted:
            self.line.drop_steps()
        return interrupted

    def fail(self, problem: Problem) -> None:
        """Send a failure of the running task, and stop playing. The batch is restored to the end of the last
        step; if this process is spoiled, another process restores the batch."""
        self.failed = self.failed or problem.stage != "policy"
        spoiled = self._settings_changed()
        if not spoiled and problem.stage != "policy" and self.restore_last_step() is not None:
            spoiled = "the last step could not be put back"
        self._send_failure(TaskFailed(problem, self.opened is not None, at_run=True, spoiled=spoiled))
        self._on_failure()

    def _settings_changed(self) -> str:
        changed = changed_settings(self.when_loaded, read_process_state()) if self.when_loaded else []
        return f"{some_of(changed)} changed since the version was loaded" if changed else ""

    def refuse(self, failed: TaskFailed) -> None:
        """Report that a version was refused."""
        self._send_failure(failed)

    def _send_failure(self, failed: TaskFailed) -> None:
        self.spoiled = self.spoiled or failed.spoiled != ""
        self.line.send(failed)

    def restore_last_step(self) -> Problem | None:
        """Restore the batch to the end of the last step after a step was cut short. Returns the problem if
        the restore failed, else None."""
        if self.opened is None or self.steps.moment is None:
            return None
        try:
            # Not `TaskEnv.restore`: it calls `evaluate`, which may be the hook that hangs.
            restore_snapshot(self.opened.env.env, self.steps.moment)
        except Exception as error:  # the failed code may have replaced the objects that are restored
            return problem_from_exception(error, "reset", self.opened.loaded.source_files)
        return None
