"""The camera studio: places cameras, and holds their reports and file edits."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

from workbench.authoring.camera_source import calibration_files
from workbench.core.camera_data import CameraKey, CameraSettings, Picture, differences, why_no_camera
from workbench.core.cameras.conventions import Convention, Direction, relative_to, with_pose
from workbench.core.env.step_result import StepResult
from workbench.jobs.task import TaskDescription
from workbench.session.cameras.file_edits import FileEdits
from workbench.session.cameras.reports import CameraReports
from workbench.session.cameras.selection import (
    KeptPlacements,
    PlacementChange,
    Placements,
    StudioCameras,
    shown_step,
)
from workbench.session.cameras.view import StudioView
from workbench.session.loop import do, on_loop
from workbench.session.process.askers import Asker, Background
from workbench.session.process.jobs import Job, JobFailed, Jobs
from workbench.session.protocol.messages import PlaceCamera, Placed, ReloadLevel, Request
from workbench.session.protocol.questions import DrawCamera
from workbench.session.run.run import Run

PREVIEW_MODALITIES = ("rgb", "depth", "segmentation")
Previewed = tuple[StepResult | None, DrawCamera]
"""A step and the question that draws it."""


class CameraStudio:
    """Places cameras and previews them. All methods return at once and may be called on any thread; `view` has the results.

    A placement is here (with undo), in the worker's live cameras, and at last in the author's file. This one is
    authoritative: after each load it is sent to the worker again, so that neither a reload nor a crash moves a camera. If
    the author changed the camera in the file, the file counts.

    A preview is drawn by a temporary camera with the same lens (`core.cameras.temporary`): 1280 x 720 takes long without a
    GPU, 64 x 64 shows little, and another size of the env's camera would change the observation.
    """

    def __init__(
        self,
        send: Callable[[Request], None],
        asker: Asker,
        background: Background,
        on_change: Callable[[], None],
        run: Callable[[], Run],
        open_file: Callable[[Path, str], None],
        kept: KeptPlacements | None = None,
    ) -> None:
        """
        Args:
            send, asker: send requests to, and ask the worker that plays.
            background: asks the background process.
            on_change: called, on any thread, when `view` has changed.
            run: returns the present run.
            open_file: opens a class of another file.
            kept: placements of an earlier session of the task.
        """
        self._send, self._on_change = send, on_change
        self._run = run
        self._cameras = StudioCameras(run, kept)
        self._asker = asker
        self.file = FileEdits(self._cameras, self._notify, open_file, asker, run)
        self._serial = 0
        self.reports = CameraReports(self._cameras, asker, background, self._notify, run)
        self._previews = Jobs(self._notify, self._preview_failed)
        self._preview_scale = 1.0
        self._preview: Picture | None = None
        self._preview_problem = ""
        self._previewed: Previewed | None = None
        """The last preview."""

    # --- placing -------------------------------------------------------------------------------------

    @on_loop
    def select(self, key: CameraKey | None) -> None:
        """Select the camera that the page works on."""
        self._cameras.was_chosen = True
        self._cameras.selected = (
            key if key is None or self._cameras.info(key) is not None else self._cameras.selected
        )
        self._notify()

    @on_loop
    def place(
        self, key: CameraKey, settings: CameraSettings, control: object = None, pause: float = math.inf
    ) -> None:
        """Place a camera, live. If placements come faster than the worker takes them, only the newest is made.

        Args:
            control: id of the control; successive calls with the same one are one step of undo (a drag).
            pause: seconds without a call after which a new step begins.
        """
        why_not = self._cameras.refusal(key) or why_no_camera(settings)
        self._cameras.problem = f"{key[1]} is left where it is: {why_not}." if why_not else ""
        if not why_not:
            self._place(key, settings, control, pause)
        self._notify()

    def _place(
        self,
        key: CameraKey,
        settings: CameraSettings,
        control: object = None,
        pause: float = math.inf,
        label: str = "",
    ) -> None:
        before = self._cameras.placements
        self._cameras.placements = before.place(key, settings, time.monotonic(), control, pause, label)
        if self._cameras.placements.placed.get(key) != before.placed.get(key):
            self.send_placements([key])

    @on_loop
    def undo(self) -> None:
        """Undo the last step."""
        before = self._cameras.placements
        self._step(before.done[-1:], before.undo())

    @on_loop
    def redo(self) -> None:
        """Redo the step that was undone last."""
        before = self._cameras.placements
        self._step(before.undone[-1:], before.redo())

    def _step(self, steps: Sequence[PlacementChange], after: Placements) -> None:
        self._cameras.placements, self._cameras.problem = after, ""
        self.send_placements([step.key for step in steps])

    @on_loop
    def back_to_file(self, key: CameraKey) -> None:
        """Place a camera as in the file."""
        file = self._cameras.placements.in_file.get(key)
        if file is not None:
            self._place(key, file, label=f"put {key[1]} back to the file")
        self._notify()

    @on_loop
    def take_suggestion(self, index: int) -> None:
        """Place the camera as in a suggestion."""
        results = self.reports.results
        key = results.suggestions_of
        if key is None or not 0 <= index < len(results.suggestions):
            return
        found = results.suggestions[index].settings
        now = self._cameras.placements.now(key)
        if now is not None:
            self.place(key, replace(now, position=found.position, quaternion=found.quaternion))

    @on_loop
    def set_preview_scale(self, scale: float) -> None:
        """Show the selected camera at this factor of its own size; 1 for its own picture. Never written to the file."""
        self._preview_scale, self._preview, self._previewed = scale, None, None
        self._notify()

    @on_loop
    def draw_preview(self) -> None:
        """Draw another preview, if something changed since the last and none is being drawn."""
        run, key = self._run(), self._cameras.selected
        step, env = shown_step(run), run.env
        now = None if key is None else self._cameras.placements.now(key)
        if self._preview_scale == 1.0 or key is None or now is None or self._cameras.refusal(key):
            return
        question = DrawCamera(key, now, env, PREVIEW_MODALITIES, scale=self._preview_scale)
        seen = self._previewed is not None and self._previewed[0] is step and self._previewed[1] == question
        if seen or self._previews.progress is not None:
            return
        self._previewed, self._preview_problem = (step, question), ""

        question = replace(question, poses=run.shown_moment().of(env))

        async def work(job: Job) -> None:
            self._preview = await self._asker.ask(question)

        self._previews.start("a preview", work)

    def _preview_failed(self, failure: JobFailed) -> None:
        """The last preview stays; the next change draws again."""
        self._preview_problem = f"The preview failed: {failure}."

    # --- calibration files -----------------------------------------------------------------------------

    @on_loop
    def export(self, keys: Sequence[CameraKey], form: Literal["json", "opencv", "ros"]) -> str:
        """The text of a calibration file: cameras as placed, at the shown moment of the selected env.

        ROS's format has one camera a file; several become YAML documents in one text.

        Raises:
            ValueError: a camera is missing or cannot be exported; the message is for the reader.
        """
        cameras = [self._cameras.to_export(key) for key in keys]
        if form == "ros":
            return "---\n".join(calibration_files.camera_as_ros_yaml(camera) for camera in cameras)
        write = (
            calibration_files.cameras_as_json if form == "json" else calibration_files.cameras_as_opencv_yaml
        )
        return write(cameras)

    @on_loop
    def import_pose(
        self,
        key: CameraKey,
        text: str,
        direction: Direction | None,
        convention: Convention | None,
        metres_per_unit: float = 1.0,
    ) -> None:
        """Place a camera by a calibration: a pose in the env's frame, or in its mount's if it is mounted.

        Our own JSON contains direction and convention; for all else they are arguments.

        Raises:
            ValueError: with a message for the reader.
        """
        info, now = self._cameras.info(key), self._cameras.placements.now(key)
        mount = None if info is None else self._cameras.mount_pose(info)
        if now is None or info is None:
            raise ValueError(f"there is no {key[0]} camera {key[1]} that can be placed")
        found = calibration_files.find_poses(text)
        chosen = [pose for pose in found if info.name in pose.label] or list(found)
        if len(chosen) > 1:
            labels = ", ".join(pose.label for pose in chosen)
            raise ValueError(f"it holds several poses ({labels}): paste only the one you mean")
        pose = calibration_files.camera_pose(chosen[0], convention, direction, metres_per_unit)
        if chosen[0].stated is not None and info.mount is not None:
            if mount is None:
                raise ValueError(
                    f"the pose of {info.mount}, on which {info.name} is mounted, is not known yet"
                )
            pose = relative_to(mount, pose)  # ours is of the env's frame
        self.place(key, with_pose(now, pose))

    # --- reading ---------------------------------------------------------------------------------------

    def view(self) -> StudioView:
        """The studio's part of `SessionView`, at the shown moment."""
        results, progress = self.reports.results, self.reports.progress
        preview = self._preview
        measured = None if results.report_of is None else self._cameras.placements.now(results.report_of)
        was = results.report_settings
        # Rounding when it was written does not count.
        moved = measured is None or was is None or bool(differences(measured, was, close=3e-4))
        return StudioView(
            cameras=self._cameras.all_cameras(),
            results=results,
            report_stale=results.report is not None and (moved or results.outdated),
            preview_scale=self._preview_scale,
            preview=preview
            if preview and (preview.key, preview.env) == (self._cameras.selected, self._run().env)
            else None,
            progress=progress,
            selected=self._cameras.selected,
            was_chosen=self._cameras.was_chosen,
            undo=self._cameras.placements.undo_label,
            redo=self._cameras.placements.redo_label,
            edit_state=self.file.view,
            problem=self._cameras.problem or results.problem or self._preview_problem,
            serial=self._serial,
        )

    # --- events, from the session ----------------------------------------------------------------------

    def loaded(self, task: TaskDescription, level: ReloadLevel | None) -> tuple[CameraKey, ...]:
        """A version runs: update cameras and placements, and compare it with a written edit. Sends
        nothing.

        Args:
            level: of its reload; None for the first version.

        Returns:
            The cameras whose placement has to be sent to the worker, by `send_placements`.
        """
        own = self.file.loaded(task)
        in_file = self._cameras.in_file()
        self._cameras.placements, dropped = self._cameras.placements.loaded(in_file, own)
        self.file.plan_in_copy(task)
        self._cameras.problem = ""
        if dropped:
            names = " and ".join(key[1] for key in dropped)
            one = len(dropped) == 1
            self._cameras.problem = (
                f"{names} {'was' if one else 'were'} changed in the file and now {'follows' if one else 'follow'} "
                "it; Undo restores your placement."
            )
        self._cameras.select_again()
        self._serial += 1
        if level not in ("same", "cameras"):
            self.reports.mark_outdated()
        # Dropped ones too: their placement may have been on its way during the load. And edited ones: after an edit
        # was taken out again the version may count as the same, so the worker's camera would stay where it was.
        to_send = (*self._cameras.placements.placed, *dropped, *(own & in_file.keys()))
        return tuple(dict.fromkeys(to_send))

    @on_loop
    def interrupted(self) -> None:
        """Cancel all jobs: the file was saved, or the worker is gone."""
        self.reports.stop()
        self._previews.stop()
        self._previewed = None
        self.file.stop()

    def failed_to_load(self) -> None:
        """A version failed to load; the one before continues."""
        self.file.failed_to_load()
        self._notify()

    @on_loop
    def placed_cameras(self) -> tuple[PlaceCamera, ...]:
        """All placements, as requests to another worker."""
        return tuple(PlaceCamera(key, settings) for key, settings in self._cameras.placements.placed.items())

    @on_loop
    def kept_placements(self) -> KeptPlacements:
        """Placements, steps of undo and the selected camera, for a later session of this task."""
        return self._cameras.kept()

    def placed(self, event: Placed) -> None:
        """The worker's answer to a placement."""
        again = False
        if event.why_not:
            self._cameras.problem = f"{event.key[1]} could not be placed: {event.why_not}."
            self._cameras.placements = self._cameras.placements.refused(event.key)
            again = event.settings is not None
        self.send_placements([event.key] if again else [])

    def close(self) -> None:
        """Cancel all jobs, and wait for a running edit. Called on another thread than the loop."""
        self.reports.close()
        do(self._previews.close)
        self.file.close()

    # --- sending ---------------------------------------------------------------------------------------

    def send_placements(self, keys: Sequence[CameraKey]) -> None:
        """Send the present placements of these cameras to the worker."""
        for key in keys:
            self._send(PlaceCamera(key, self._cameras.placements.placed.get(key)))
        self._notify()

    def _notify(self) -> None:
        self._serial += 1
        self._on_change()
