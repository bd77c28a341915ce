"""Edits the author's file for the page: shows a camera's change, writes it, and takes it back."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable, Coroutine, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from workbench.authoring.camera_source.cameras import HookCameras
from workbench.authoring.camera_source.disk import SourceEdit, apply, revert
from workbench.authoring.source.text import RefusedEdit, plain_line_ends
from workbench.core.camera_data import CameraKey, CameraSettings, differences
from workbench.jobs.task import TaskDescription
from workbench.machine.processes.watched_thread import report_failure
from workbench.session.cameras.edit_state import DONE, LEFT, change_text, copy, mismatch, plan
from workbench.session.cameras.selection import StudioCameras
from workbench.session.cameras.view import EditRequest, EditStage, EditState
from workbench.session.loop import Aside, begin, on_loop, result_of
from workbench.session.process.askers import Asker
from workbench.session.process.jobs import JobFailed, Jobs
from workbench.session.protocol.questions import DrawCamera, RunCameras
from workbench.session.run.run import Run

IN_FILE: tuple[EditStage, ...] = ("written", "checked", "mismatch")
"""Stages in which the change is in the file."""
_LARGEST = 256
"""Pixels of the shorter side of a new camera's preview."""


class _Stopped(Exception):
    """The answer is not needed any more."""


class FileEdits:
    """Makes edits one after the other; `view` has the result. Methods return at once.

    Placements change when the version with the edit is loaded, and none is lost by it.

    Args:
        on_change: called when `view` has changed.
        open_copy: opens a class of a copied file in place of the task.
        asker: asks the worker that plays.
        run: returns the present run.
        patience: seconds for the worker to run the hooks: one of them may loop for ever.
    """

    def __init__(
        self,
        cameras: StudioCameras,
        on_change: Callable[[], None],
        open_copy: Callable[[Path, str], None],
        asker: Asker,
        run: Callable[[], Run],
        patience: float = 60.0,
    ) -> None:
        self._cameras, self._notify, self._open_copy = cameras, on_change, open_copy
        self.folder = Path.cwd()
        """Folder for a copy of a task: the one in which the program was started."""
        self._asker, self._present, self._patience = asker, run, patience
        self._stopped = threading.Event()
        """Cancels the present question."""
        self.view = EditState()
        self._copied: Path | None = None
        """The copy of the task that is being opened."""
        self._just_copied = ""
        """First sentence of the message about the plan in the copy."""
        self._done: list[EditState] = []
        """Edits that are in the file and can be taken back, the newest last."""
        self._removed: dict[CameraKey, CameraSettings] = {}
        """Placements of cameras that were removed from the file."""
        self._turn = asyncio.Lock()
        """Lock that makes edits run one after the other."""
        self._drawings = Jobs(on_change, self._not_drawn)
        """Jobs that draw the previews of new cameras."""
        self._aside = Aside("edits")
        """Reads and writes the file, and finds edits in it."""
        self._closing = False

    @on_loop
    def plan(self, request: EditRequest) -> None:
        """Find the edit for a request; it becomes `StudioView.edit_state`."""
        if request.settings is None:
            request = replace(request, settings=self._cameras.placements.now(request.key))
        self._begin(self._find_plan(request))

    async def _find_plan(self, request: EditRequest) -> None:
        task, info = self._cameras.task, self._cameras.info(request.key)
        if task is None:
            return
        before = self.view.request if self.view.stage == "planned" else None
        # Clear the answer to another request. But a written edit waits for its version, which needs the state.
        self.view = self.view if self.view.loading else EditState(request=request)
        self._notify()
        edit_state = await self._aside.run(partial(plan, task, info, request, self._run))
        first, self._just_copied = self._just_copied, ""
        if before is not None and (before.what, before.key) != (request.what, request.key):
            first = change_text(before, LEFT)
        drawing = edit_state.stage == "planned" and request.what == "add"
        message = f"{first} {edit_state.message}".strip()
        self.view = replace(edit_state, message=message, drawing=drawing)
        self._notify()
        if drawing and request.settings is not None:
            settings = request.settings
            self._drawings.start("a new camera", lambda job: self._draw_new(request, settings))

    async def _draw_new(self, request: EditRequest, settings: CameraSettings) -> None:
        """Draw what a new camera would see; cancelled by the next request."""
        moment, smaller = self._present().shown_moment(), _LARGEST / min(settings.width, settings.height)
        poses = moment.of(moment.env)
        question = DrawCamera(request.key, settings, moment.env, poses=poses, scale=min(1.0, smaller))
        picture = None
        try:
            picture = await self._asker.ask(question)
        finally:
            if self.view.request is request:
                self.view = replace(self.view, picture=picture, drawing=False)
            self._notify()

    def _not_drawn(self, failure: JobFailed) -> None:
        self._cameras.problem = f"There is no picture of the new camera: {failure}."

    def _run(self, texts: Mapping[str, str]) -> HookCameras:
        """Run the hooks of these texts; called off the loop."""
        stopped = self._stopped = threading.Event()
        load, deadline = self._present().running_load(), time.monotonic() + self._patience
        if load is None or self._closing:
            raise RefusedEdit("no task is loaded")

        def check() -> None:
            if stopped.is_set() or time.monotonic() > deadline:
                raise _Stopped

        try:
            return result_of(self._asker.ask(RunCameras(load.task, texts)), check)
        except _Stopped:
            raise RefusedEdit(
                "the task did not answer, or another version came meanwhile; ask again"
            ) from None
        except JobFailed as failure:
            raise RefusedEdit(str(failure)) from failure

    @on_loop
    def stop(self) -> None:
        """Cancel the present question: the worker is gone, or another version comes."""
        self._stopped.set()
        self._drawings.stop()

    @on_loop
    def write(self) -> None:
        """Write the planned edit; the file is reloaded, and the new camera compared with the edit."""
        message = "Saved to {file}; loading it."
        self._begin(self._change_file(("planned",), apply, "written", message))

    @on_loop
    def undo_write(self) -> None:
        """Take the newest edit out of the file."""
        message = "Edit reverted in {file}; loading it."
        self._begin(self._change_file(IN_FILE, revert, "undone", message))

    async def _change_file(
        self,
        needs: tuple[EditStage, ...],
        do: Callable[[SourceEdit], None],
        stage: EditStage,
        message: str,
    ) -> None:
        before = self.view
        if before.edit is None or before.stage not in needs:
            return
        # Before the file is written: the version with the edit may be loaded before the disk says that it is done.
        self._set_state(message.format(file=before.edit.names), stage, loading=True)
        if stage == "undone":
            taken = self._done[-1:]
            del self._done[-1:]
        else:
            self._done.append(self.view)
        self._notify()
        try:
            await self._aside.run(partial(do, before.edit))
        except RefusedEdit as refused:
            if stage == "undone":
                self._done += taken
            else:
                del self._done[-1:]
            kept = "refused" if stage == "written" else before.stage
            self.view = replace(before, stage=kept, message=f"Not done: {refused.reason}.")
        self._notify()

    @on_loop
    def copy_task(self) -> None:
        """Copy the task's file into `folder`, open the copy, and plan the refused request in it.

        Does nothing unless ``view.can_copy``. Never overwrites a file.
        """
        self._begin(self._copy())

    async def _copy(self) -> None:
        task = self._cameras.task
        if task is None or not self.view.can_copy:
            return
        file, view = await self._aside.run(partial(copy, task, self.folder))
        # The request waits until the copy is loaded.
        self._copied, self.view = file, replace(view, request=self.view.request)
        self._just_copied = "" if file is None else f"This is your copy of the task, {file}."
        if file is not None:
            self._done.clear()  # they are of the other file
        self._notify()
        if file is not None:
            self._open_copy(file, task.class_name)

    @on_loop
    def drop_plan(self) -> None:
        """Drop the plan and show the newest written edit again; if that is shown, forget all written edits."""
        self._drawings.stop()
        if self.view.stage in IN_FILE:
            self._done.clear()
        self.view = self._done[-1] if self._done else EditState()
        self._copied, self._just_copied = None, ""
        if self._cameras.task is not None:
            self.loaded(self._cameras.task)  # the version with that edit may have been loaded meanwhile
        self._notify()

    # --- events, from the studio -----------------------------------------------------------------------

    def loaded(self, task: TaskDescription) -> frozenset[CameraKey]:
        """Compare the running version with the written edit.

        Returns:
            The cameras that the edit changed, if this is the version with it.
        """
        request, edit = self.view.request, self.view.edit
        if request is None or edit is None or not self._is_in(task, edit):
            return frozenset()
        infos = {info.key: info for info in task.cameras}
        had = infos.get(request.key)
        went_back = self._update_placements(request, None if had is None else had.settings)
        if self.view.stage == "undone":
            back = (
                f" {request.key[1]} is where the file places it; Undo restores your placement."
                if went_back
                else ""
            )
            message = f"Edit reverted in {edit.names}.{back}"
            if self._done:
                # The edit before it, which can be reverted next.
                earlier = self._done[-1]
                self.view = replace(earlier, message=f"{message} Before it: {earlier.message}")
            else:
                self._set_state(message, "undone")
            return frozenset({request.key, request.result})
        if wrong := mismatch(request, infos, edit.settings):
            more = "Revert the change, or look for what else in the task places this camera."
            self._set_state(f"{wrong} {more}", "mismatch")
        else:
            self._set_state(change_text(request, DONE, edit.names), "checked")
        self._done[-1:] = [self.view]
        return frozenset({request.key, request.result})

    def _is_in(self, task: TaskDescription, edit: SourceEdit) -> bool:
        """Whether this is the expected version, with the edit or without it."""
        written = self.view.stage == "written"
        return self.view.loading and all(
            task.source.get(change.file) == plain_line_ends(change.new_text if written else change.old_text)
            for change in edit.changes
        )

    def plan_in_copy(self, task: TaskDescription) -> None:
        """Plan the refused request in the copy of the task, if this is the copy."""
        if self._copied is None or task.file != str(self._copied):
            return
        self._copied = None
        if self.view.request is not None:
            self._begin(self._find_plan(self.view.request))

    def _update_placements(self, request: EditRequest, in_file: CameraSettings | None) -> bool:
        """Update the placements after an edit was made or undone; none is lost.

        Args:
            in_file: the camera's settings in the loaded version; None if there is no such camera.

        Returns:
            Whether the camera moved from its placement to the file's pose.
        """
        went_back, placements = False, self._cameras.placements
        undone = self.view.stage == "undone"
        now, placed = placements.now(request.key), placements.placed.get(request.key)
        if request.what == "rename":
            pair = (request.result, request.key) if undone else (request.key, request.result)
            placements = placements.rename(*pair)
        elif request.what == "duplicate" and not undone and placed is not None:
            placements = placements.with_placed(request.result, placed)
        elif request.what == "edit" and request.settings is not None:
            if undone and in_file is not None:
                back = placements.edit_undone(request.key, request.settings, in_file)
                went_back, placements = back is not None, back or placements
            elif not undone and now is not None and not differences(now, request.settings):
                placements = placements.without(request.key)  # up to rounding, the file has it now
        elif request.what == "remove":
            if not undone and placed is not None:
                self._removed[request.key] = placed
            elif undone and request.key in self._removed:
                placements = placements.with_placed(request.key, self._removed.pop(request.key))
        self._cameras.placements = placements
        if not undone and request.what in ("add", "duplicate", "rename"):
            self._cameras.selected = request.result
        return went_back

    def failed_to_load(self) -> None:
        """A version failed to load."""
        if self._copied is not None:
            why = f"{self._copied} was made, but does not load: fix or delete it."
            self.view = EditState("refused", self.view.request, message=why)
        edit, undone = self.view.edit, self.view.stage == "undone"
        if self.view.loading and edit is not None:
            hint = "it has the change; revert it if that is the reason"
            if undone:
                hint = "the camera's change was reverted"
            does = "does" if len(edit.changes) == 1 else "do"
            self._set_state(f"{edit.names} {does} not load: {hint}.", self.view.stage, loading=not undone)

    def _set_state(self, message: str, stage: EditStage, loading: bool = False) -> None:
        self.view = replace(self.view, stage=stage, message=message, snippet="", loading=loading)

    def close(self) -> None:
        """Wait for a running edit. Called on another thread than the loop."""
        self._close()
        self._aside.close()

    @on_loop
    def _close(self) -> None:
        self._closing = True
        self.stop()
        self._drawings.close()

    def _begin(self, work: Coroutine[Any, Any, None]) -> None:
        """Run `work` after the edits that were begun before it."""
        self._drawings.stop()
        begin(self._in_turn(work))

    async def _in_turn(self, work: Coroutine[Any, Any, None]) -> None:
        async with self._turn:
            if self._closing:
                work.close()
                return
            try:
                await work
            except Exception as error:
                report_failure("An edit of the task's file failed", error)
                self._cameras.problem = (
                    f"The workbench itself failed at this, and nothing was done: {error!r}"
                )
                self._notify()
