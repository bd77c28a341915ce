"""What the page asks of the author's file: show what a change would be, make it, take it back.

What takes long (the disk, the worker that runs the hooks) is done on a thread of its own, one thing after the other;
what came of it is in `view`. What a change means for the placements is settled when the version with it comes in: none
is to be lost by it.
"""

from __future__ import annotations

import threading
import time
import traceback
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

from workbench.authoring.camera_source.cameras import HookCameras
from workbench.authoring.camera_source.disk import SourceEdit, apply, revert
from workbench.authoring.source.text import RefusedEdit, plain_line_ends
from workbench.core.camera_data import CameraKey, CameraSettings, differences
from workbench.jobs.task import TaskDescription
from workbench.session.cameras.edit_state import DONE, LEFT, copy, mismatch, plan, said, was_before
from workbench.session.cameras.selection import StudioCameras
from workbench.session.cameras.view import Wish, Writing, WritingStage
from workbench.session.history.history import ShownMoment
from workbench.session.process.askers import Asker
from workbench.session.process.job_lane import JobFailed, Stopped
from workbench.session.protocol.messages import Load
from workbench.session.protocol.questions import DrawCamera, RunCameras

MADE: tuple[WritingStage, ...] = ("written", "checked", "mismatch")
"""Stages in which the change is in the file."""
_LARGEST = 256
"""Pixels of the shorter side of a new camera's picture, before it is written."""


class StudioFile:
    """Thread-safe; every method returns at once.

    Args:
        on_change: called, on any thread, when there is something new.
        open_copy: open this class of this file, in a folder of the user's, in place of the task.
        asker: asks the worker that plays.
        load: how the version that runs was loaded; None before there is one.
        shown: which moment the page shows.
        patience: seconds in which the worker must have run the hooks: one of them may not end.
    """

    def __init__(
        self,
        cameras: StudioCameras,
        on_change: Callable[[], None],
        open_copy: Callable[[Path, str], None],
        asker: Asker,
        load: Callable[[], Load | None],
        shown: Callable[[], ShownMoment],
        patience: float = 60.0,
    ) -> None:
        self._cameras, self._note, self._open_copy = cameras, on_change, open_copy
        self.folder = Path.cwd()
        """Where a copy of a task goes: where the program was started."""
        self._asker, self._load, self._shown, self._patience = asker, load, shown, patience
        self._stopped = threading.Event()
        """Nobody waits any more for what is being asked."""
        self.view = Writing()
        self._copied: Path | None = None
        """The copy of the task, which is being opened."""
        self._just_copied = ""
        """What is said first of the plan in it."""
        self._made: list[Writing] = []
        """What is in the file and can be taken back, the last one last."""
        self._removed: dict[CameraKey, CameraSettings] = {}
        """Where cameras were placed, otherwise than the file said, that were taken out of it."""
        self._thread = ThreadPoolExecutor(1, "studio")
        self._closing = False

    def plan(self, wish: Wish) -> None:
        """Find the edit that fulfils a wish; it becomes `StudioView.writing`."""
        if wish.settings is None:
            with self._cameras.lock:
                wish = replace(wish, settings=self._cameras.placements.now(wish.key))
        self._later(self._find_plan, wish)

    def _find_plan(self, wish: Wish) -> None:
        with self._cameras.lock:
            task, info = self._cameras.task, self._cameras.info(wish.key)
            if task is None:
                return
            before = self.view.wish if self.view.stage == "planned" else None
            # Nobody takes what was said of another wish for the answer to this one; but a version may be awaited.
            self.view = self.view if self.view.loading else Writing(wish=wish)
        self._note()
        writing = plan(task, info, wish, self._run)
        with self._cameras.lock:
            first, self._just_copied = self._just_copied, ""
            if before is not None and (before.what, before.key) != (wish.what, wish.key):
                first = said(before, LEFT)
            self.view = replace(writing, message=f"{first} {writing.message}".strip())
        self._note()
        if writing.stage == "planned" and wish.what == "add" and wish.settings is not None:
            self._look(wish, wish.settings)

    def _look(self, wish: Wish, settings: CameraSettings) -> None:
        """What a camera would see that is to be added; not looked for any more when something else is asked for."""
        moment, smaller = self._shown(), _LARGEST / min(settings.width, settings.height)
        poses = moment.of(moment.env)
        question = DrawCamera(wish.key, settings, moment.env, poses=poses, scale=min(1.0, smaller))

        def check() -> None:
            if self._stopped.is_set() or not self._last.running():
                raise Stopped

        try:
            picture = self._asker.ask(check, question)
        except Stopped:
            return
        except JobFailed as failure:
            self._cameras.problem = f"There is no picture of the new camera: {failure}."
        else:
            with self._cameras.lock:
                if self.view.wish is wish:
                    self.view = replace(self.view, picture=picture)
        self._note()

    def _run(self, texts: Mapping[str, str]) -> HookCameras:
        stopped = self._stopped = threading.Event()
        load, deadline = self._load(), time.monotonic() + self._patience
        if load is None or self._closing:
            raise RefusedEdit("no task is loaded")

        def check() -> None:
            if stopped.is_set() or time.monotonic() > deadline:
                raise Stopped

        try:
            return self._asker.ask(check, RunCameras(load.task, texts))
        except Stopped:
            raise RefusedEdit(
                "the task did not answer, or another version came meanwhile; ask again"
            ) from None
        except JobFailed as failure:
            raise RefusedEdit(str(failure)) from failure

    def stop(self) -> None:
        """The worker is gone, or another version comes: what is under way is not answered any more."""
        self._stopped.set()

    def write(self) -> None:
        """Make the planned edit; the file is reloaded, and the new camera compared with what was written."""
        message = "Written to {file}, being loaded now."
        self._later(self._exchange, ("planned",), apply, "written", message)

    def undo_write(self) -> None:
        """Take the edit that was made last out of the file again."""
        message = "{file} {was} before, being loaded now."
        self._later(self._exchange, MADE, revert, "undone", message)

    def _exchange(
        self,
        needs: tuple[WritingStage, ...],
        do: Callable[[SourceEdit], None],
        stage: WritingStage,
        message: str,
    ) -> None:
        with self._cameras.lock:  # the version with it must not come in before it is known to be awaited
            view = self.view
            if view.edit is None or view.stage not in needs:
                return
            try:
                do(view.edit)
            except RefusedEdit as refused:
                kept = "refused" if stage == "written" else view.stage
                self.view = replace(view, stage=kept, message=f"Not done: {refused.reason}.")
            else:
                told = message.format(file=view.edit.names, was=was_before(view.edit))
                self._say(told, stage, loading=True)
                if stage == "undone":
                    del self._made[-1:]
                else:
                    self._made.append(self.view)
        self._note()

    def copy_task(self) -> None:
        """Copy the task's file into `folder` and open the copy; what was refused before is planned in it then.

        Does nothing unless ``StudioView.writing.can_copy``. Nothing is written over.
        """
        self._later(self._copy)

    def _copy(self) -> None:
        with self._cameras.lock:
            task, can = self._cameras.task, self.view.can_copy
        if task is None or not can:
            return
        file, view = copy(task, self.folder)
        with self._cameras.lock:
            # The wish waits until the copy is there.
            self._copied, self.view = file, replace(view, wish=self.view.wish)
            self._just_copied = "" if file is None else f"This is your copy of the task, {file}."
            if file is not None:
                self._made.clear()  # of another file
        self._note()
        if file is not None:
            self._open_copy(file, task.class_name)

    def drop_plan(self) -> None:
        """Forget the plan: the change before, which can be taken back, is spoken of again. Or forget that one."""
        with self._cameras.lock:
            if self.view.stage in MADE:
                self._made.clear()
            self.view = self._made[-1] if self._made else Writing()
            self._copied, self._just_copied = None, ""
            if self._cameras.task is not None:
                self.loaded(self._cameras.task)  # what is spoken of again may have come in meanwhile
        self._note()

    # --- what the studio tells -------------------------------------------------------------------------

    def loaded(self, task: TaskDescription) -> frozenset[CameraKey]:
        """A version runs, and what was written is compared with it; the lock is held.

        Returns:
            the cameras that were changed here, if this is the version with that change.
        """
        wish, edit = self.view.wish, self.view.edit
        if wish is None or edit is None or not self._is_in(task, edit):
            return frozenset()
        infos = {info.key: info for info in task.cameras}
        had = infos.get(wish.key)
        went_back = self._follow_the_file(wish, None if had is None else had.settings)
        if self.view.stage == "undone":
            back = f" {wish.key[1]} stands as it says; Undo puts it where you placed it." if went_back else ""
            self._say(f"{edit.names} {was_before(edit)} before.{back}", "undone")
        elif wrong := mismatch(wish, infos, edit.settings):
            more = "Take the change back, or look at what else in the task places this camera."
            self._say(f"{wrong} {more}", "mismatch")
        else:
            self._say(said(wish, DONE, edit.names), "checked")
        if self.view.stage != "undone":
            self._made[-1:] = [self.view]
        return frozenset({wish.key, wish.result})

    def _is_in(self, task: TaskDescription, edit: SourceEdit) -> bool:
        """Whether this version is the one with the edit, or without it, that is awaited."""
        written = self.view.stage == "written"
        return self.view.loading and all(
            task.source.get(change.file) == plain_line_ends(change.new_text if written else change.old_text)
            for change in edit.changes
        )

    def plan_in_copy(self, task: TaskDescription) -> None:
        """What was refused before is planned in the copy of the task, if this is that; the lock is held."""
        if self._copied is None or task.file != str(self._copied):
            return
        self._copied = None
        if self.view.wish is not None and not self._closing:
            self._submit(self._find_plan, self.view.wish)

    def _follow_the_file(self, wish: Wish, said: CameraSettings | None) -> bool:
        """What an edit, or its being taken back, means for the placements: none is to be lost by it.

        Args:
            said: what the version that came in says of the camera; None where it has none.

        Returns:
            whether the camera went back from where it was placed to where the file says.
        """
        went_back = False
        placements, undone = self._cameras.placements, self.view.stage == "undone"
        now, placed = placements.now(wish.key), placements.placed.get(wish.key)
        if wish.what == "rename":
            pair = (wish.result, wish.key) if undone else (wish.key, wish.result)
            placements.rename(*pair)
        elif wish.what == "duplicate" and not undone and placed is not None:
            placements.placed[wish.result] = placed
        elif wish.what == "edit" and wish.settings is not None:
            if undone and said is not None:
                went_back = placements.taken_back(wish.key, wish.settings, said)
            elif not undone and now is not None and not differences(now, wish.settings):
                placements.placed.pop(wish.key, None)  # but for what was rounded
        elif wish.what == "remove":
            if not undone and placed is not None:
                self._removed[wish.key] = placed
            elif undone and wish.key in self._removed:
                placements.placed[wish.key] = self._removed.pop(wish.key)
        if not undone and wish.what in ("add", "duplicate", "rename"):
            self._cameras.selected = wish.result
        return went_back

    def failed_to_load(self) -> None:
        """A version does not load; the lock is held."""
        if self._copied is not None:
            why = f"{self._copied} was made, but does not load: mend or delete it."
            self.view = Writing("refused", self.view.wish, message=why)
        edit, undone = self.view.edit, self.view.stage == "undone"
        if self.view.loading and edit is not None:
            told = "the change is in it; take it back if that is the reason"
            if undone:
                told = "the camera's change is out of it"
            does = "does" if len(edit.changes) == 1 else "do"
            self._say(f"{edit.names} {does} not load: {told}.", self.view.stage, loading=not undone)

    def _say(self, message: str, stage: WritingStage, loading: bool = False) -> None:
        self.view = replace(self.view, stage=stage, message=message, snippet="", loading=loading)

    def close(self) -> None:
        """Wait for what is being written."""
        with self._cameras.lock:
            self._closing = True
        self.stop()
        self._thread.shutdown(wait=True, cancel_futures=True)

    # --- the thread ------------------------------------------------------------------------------------

    def _later(self, work: Callable[..., None], *args: object) -> None:
        with self._cameras.lock:
            if not self._closing:
                self._submit(work, *args)

    def _submit(self, work: Callable[..., None], *args: object) -> None:
        self._last = self._thread.submit(work, *args)
        self._last.add_done_callback(self._worked)

    def _worked(self, future: Future[None]) -> None:
        error = None if future.cancelled() else future.exception()
        if error is None:
            return
        traceback.print_exception(error)
        with self._cameras.lock:
            self._cameras.problem = f"The workbench itself failed at this, and nothing was done: {error!r}"
        self._note()
