"""Carries out edits of the author's file: plans a camera's change, writes it, and reverts it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Coroutine, Mapping
from functools import partial
from typing import Any

from workbench.cameras.edit.hook_cameras import HookCameras
from workbench.cameras.edit.plan_request import copy, plan
from workbench.cameras.events import (
    ChangeFile,
    CopyToFolder,
    DrawNewCamera,
    EditFailed,
    FileChanged,
    FileNotChanged,
    FindPlan,
    NewCameraDrawn,
    PlanFound,
    StudioClosed,
    StudioEvent,
    TaskCopied,
)
from workbench.cameras.questions import RunCameras
from workbench.live.events import FileOpened
from workbench.live.messages import Load
from workbench.live.process.ask import QuestionClient
from workbench.live.process.background_jobs import Job, JobFailed
from workbench.machine.loop import BlockingPool, begin, do, result_of
from workbench.machine.processes.watched_thread import report_failure
from workbench.source.parsed import RefusedEdit
from workbench.task.write_edits import apply, revert


class _Stopped(Exception):
    """The answer is no longer needed, or did not arrive in time."""


class FileEdits:
    """Plans, writes and reverts edits. All public methods except `close` are called on the loop; the work is
    done on a separate thread.

    Args:
        asker: asks questions of the worker that plays.
        dispatch: handles the resulting events.
        patience: timeout in seconds for the worker to run the hooks, which may loop for ever.
    """

    def __init__(
        self,
        asker: QuestionClient,
        dispatch: Callable[[StudioEvent | FileOpened], object],
        patience: float = 60.0,
    ) -> None:
        self._asker, self._dispatch, self._patience = asker, dispatch, patience
        self._stopped = threading.Event()
        """Cancels the present question."""
        self._aside = BlockingPool("edits")
        self._closing = False

    def begin(self, effect: FindPlan | ChangeFile | CopyToFolder) -> None:
        match effect:
            case FindPlan():
                begin(self._reported(self._find_plan(effect)))
            case ChangeFile():
                begin(self._reported(self._change_file(effect)))
            case CopyToFolder():
                begin(self._reported(self._copy(effect)))

    async def _find_plan(self, wanted: FindPlan) -> None:
        run_hooks = partial(self._run, wanted.load)
        found = await self._aside.run(partial(plan, wanted.task, wanted.info, wanted.request, run_hooks))
        self._dispatch(PlanFound(wanted.request, found))

    def _run(self, load: Load | None, texts: Mapping[str, str]) -> HookCameras:
        """Run the hooks of these texts; called off the loop."""
        stopped = self._stopped = threading.Event()
        deadline = time.monotonic() + self._patience
        if load is None or self._closing:
            raise RefusedEdit("no task is loaded")

        def check() -> None:
            if stopped.is_set() or time.monotonic() > deadline:
                raise _Stopped

        try:
            return result_of(self._asker.ask(RunCameras(load.task, texts)), check)
        except _Stopped:
            raise RefusedEdit(
                "the task did not answer in time, or another version was loaded meanwhile; try again"
            ) from None
        except JobFailed as failure:
            raise RefusedEdit(str(failure)) from failure

    async def _change_file(self, wanted: ChangeFile) -> None:
        change = revert if wanted.revert else apply
        try:
            await self._aside.run(partial(change, wanted.edit))
        except RefusedEdit as refused:
            self._dispatch(FileNotChanged(refused.reason))
        else:
            self._dispatch(FileChanged())

    async def _copy(self, wanted: CopyToFolder) -> None:
        file, state = await self._aside.run(partial(copy, wanted.task, wanted.folder))
        self._dispatch(TaskCopied(file, state))
        if file is not None:
            self._dispatch(FileOpened(file, wanted.task.class_name))

    async def _reported(self, work: Coroutine[Any, Any, None]) -> None:
        try:
            await work
        except Exception as error:
            report_failure("An edit of the task's file failed", error)
            self._dispatch(EditFailed(repr(error)))

    async def draw(self, job: Job, wanted: DrawNewCamera) -> None:
        """Draw the picture of a new camera; cancelled by the next request."""
        picture = None
        try:
            picture = await self._asker.ask(wanted.question)
        finally:
            self._dispatch(NewCameraDrawn(wanted.request, picture))

    def stop_question(self) -> None:
        """Cancel the present question, because the worker has ended or another version is loading."""
        self._stopped.set()

    def close(self) -> None:
        """Wait for a running edit. Must not be called on the loop's thread."""
        do(self._close)
        self._aside.close()

    def _close(self) -> None:
        self._closing = True
        self._dispatch(StudioClosed())
        self.stop_question()
