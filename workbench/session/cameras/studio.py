"""The camera studio: cameras placed by hand, judged over the batch, and written into the author's file.

The page calls the methods here, on any thread; each returns at once. What comes of them is in `StudioView`.

A placement is known in three places: here (with its undo), in the worker's live cameras, and in the end in the
author's file. What is here counts: after every version that comes in the worker is told again, so that neither a
reload nor the end of a worker moves a camera. What is in the file counts more, when the author changed it there.

A camera's picture may also be taken for a look only, by a camera beside the env's with the same lens
(`core.cameras.temporary`): one of 1280 x 720 takes long to draw where there is no GPU, one of 64 x 64 shows a person
little, and giving the env's camera another size would change the observation that the task and a policy get. And one that
is about to be added is not there yet, while whether it stands well is seen in its picture alone.

Here is how a camera comes to stand somewhere; what is asked about it there is `reports`, the way into the file `file`.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

from workbench.authoring.camera_source import calibration_files
from workbench.core.camera_data import CameraKey, CameraSettings, Picture, differences, why_no_camera
from workbench.core.cameras.conventions import Convention, Direction, relative_to, with_pose
from workbench.core.env.step_result import StepResult
from workbench.jobs.task import TaskDescription
from workbench.session.cameras.file_edits import StudioFile
from workbench.session.cameras.reports import CameraReports
from workbench.session.cameras.selection import Step, StudioCameras
from workbench.session.cameras.view import StudioView
from workbench.session.history.history import Shown
from workbench.session.process.askers import Asker, Background
from workbench.session.process.job_lane import Job, JobFailed, JobLane
from workbench.session.protocol.messages import Load, PlaceCamera, Placed, ReloadLevel, Request
from workbench.session.protocol.questions import DrawCamera

IN_A_QUICK_LOOK = ("rgb", "depth", "segmentation")
Sight = tuple[StepResult | None, DrawCamera]
"""A moment, and what of it is looked at."""


class CameraStudio:
    """See the module's text."""

    def __init__(
        self,
        send: Callable[[Request], None],
        asker: Asker,
        background: Background,
        on_change: Callable[[], None],
        past: Shown,
        load: Callable[[], Load | None],
        open_file: Callable[[Path, str], None],
    ) -> None:
        """
        Args:
            send, asker: tell and ask the worker that plays.
            background: asks the other.
            on_change: called, on any thread, when `view` has something new.
            past: says which moment the page shows.
            load: how another worker gets the version that runs; None while there is none.
            open_file: opens a class of another file.
        """
        self._send, self._on_change = send, on_change
        self._shown = past.shown_moment
        self._cameras = StudioCameras()
        self._lock = self._cameras.lock
        self._asker = asker
        self.file = StudioFile(self._cameras, self._note, open_file, asker, load, self._shown)
        self._asking = threading.Lock()
        """Held while placements are sent; taken before `_lock`."""
        self._serial = 0
        self.reports = CameraReports(self._cameras, asker, background, self._note, past, load)
        self._looking = JobLane("studio-quick-look", self._note, self._look_failed)
        self._quick_scale = 1.0
        self._quick: Picture | None = None
        self._quick_problem = ""
        self._looked: Sight | None = None
        """What was looked at last."""

    # --- placing -------------------------------------------------------------------------------------

    def select(self, key: CameraKey | None) -> None:
        """Choose the camera that the page works on."""
        with self._lock:
            self._cameras.selected = (
                key if key is None or self._cameras.info(key) is not None else self._cameras.selected
            )
        self._note()

    def place(
        self, key: CameraKey, settings: CameraSettings, hand: object = None, pause: float = math.inf
    ) -> None:
        """Place a camera, live. Of placements faster than the worker only the newest is made.

        Args:
            hand: what places it; calls by the same one, one behind the other, are one step of undo (a drag).
            pause: seconds after the last of them from which on it is another step.
        """
        with self._lock:
            why_not = self._cameras.refusal(key) or why_no_camera(settings)
            self._cameras.problem = f"{key[1]} is left where it is: {why_not}." if why_not else ""
            moved = not why_not and self._cameras.placements.place(key, settings, hand, pause)
        self.ask_for([key] if moved else [])

    def undo(self) -> None:
        """Take the last step back."""
        self._step(self._cameras.placements.undo)

    def redo(self) -> None:
        """Make the step again that was taken back last."""
        self._step(self._cameras.placements.redo)

    def _step(self, move: Callable[[], Step | None]) -> None:
        with self._lock:
            step = move()
            self._cameras.problem = ""
        self.ask_for([] if step is None else [step.key])

    def back_to_file(self, key: CameraKey) -> None:
        """Place a camera as the file says."""
        with self._lock:
            file = self._cameras.placements.said.get(key)
            moved = file is not None and self._cameras.placements.place(
                key, file, words=f"put {key[1]} back to the file"
            )
        self.ask_for([key] if moved else [])

    def take_suggestion(self, index: int) -> None:
        """Place the camera as suggested."""
        looked = self.reports.looked
        key = looked.suggestions_of
        if key is None or not 0 <= index < len(looked.suggestions):
            return
        found = looked.suggestions[index].settings
        with self._lock:
            now = self._cameras.placements.now(key)
        if now is not None:
            self.place(key, replace(now, position=found.position, quaternion=found.quaternion))

    def set_quick_scale(self, scale: float) -> None:
        """Look through the chosen camera in a picture of so much of its own size; 1 for that itself. Never written."""
        with self._lock:
            self._quick_scale, self._quick, self._looked = scale, None, None
        self._note()

    def look(self) -> None:
        """Take another quick look, if there is something new to be looked at and none is being taken."""
        with self._lock:
            key, (step, env) = self._cameras.selected, self._cameras.drawn
            now = None if key is None else self._cameras.placements.now(key)
            if self._quick_scale == 1.0 or key is None or now is None or self._cameras.refusal(key):
                return
            question = DrawCamera(key, now, env, IN_A_QUICK_LOOK, scale=self._quick_scale)
            seen = self._looked is not None and self._looked[0] is step and self._looked[1] == question
            if seen or self._looking.progress is not None:
                return
            self._looked, self._quick_problem = (step, question), ""

        question = replace(question, poses=self._shown().of(env))

        def work(job: Job) -> None:
            picture = self._asker.ask(job.check, question)
            with self._lock:
                self._quick = picture

        self._looking.start("a quick look", work)

    def _look_failed(self, job: Job, failure: JobFailed) -> None:
        """The last picture stays; the next change looks again."""
        with self._lock:
            self._quick_problem = f"The quick look failed: {failure}."

    # --- in other words --------------------------------------------------------------------------------

    def export(self, keys: Sequence[CameraKey], form: Literal["json", "opencv", "ros"]) -> str:
        """The cameras as they are placed, at the shown moment of the selected env, as the text of a file.

        ROS's form is one file a camera: of several, one document after the other.

        Raises:
            ValueError: one of them is not there, or cannot be said; a sentence for the reader.
        """
        with self._lock:
            cameras = [self._cameras.to_export(key) for key in keys]
        if form == "ros":
            return "---\n".join(calibration_files.camera_as_ros_yaml(camera) for camera in cameras)
        write = (
            calibration_files.cameras_as_json if form == "json" else calibration_files.cameras_as_opencv_yaml
        )
        return write(cameras)

    def import_pose(
        self,
        key: CameraKey,
        text: str,
        direction: Direction | None,
        convention: Convention | None,
        metres_per_unit: float = 1.0,
    ) -> None:
        """Place a camera as a calibration says: in the env's frame, or in its mount's if it is mounted.

        Our own JSON says itself which pose is which; of anything else the person says it.

        Raises:
            ValueError: with a sentence for the reader.
        """
        with self._lock:
            info, now = self._cameras.info(key), self._cameras.placements.now(key)
            mount = None if info is None else self._cameras.mount_pose(info)
        if now is None or info is None:
            raise ValueError(f"there is no {key[0]} camera {key[1]} that can be placed")
        found = calibration_files.find_poses(text)
        chosen = [pose for pose in found if info.name in pose.label] or list(found)
        if len(chosen) > 1:
            labels = ", ".join(pose.label for pose in chosen)
            raise ValueError(f"there are several poses in it ({labels}): paste the one that is meant")
        pose = calibration_files.camera_pose(chosen[0], convention, direction, metres_per_unit)
        if chosen[0].stated is not None and info.mount is not None:
            if mount is None:
                raise ValueError(f"where {info.mount} is, on which {info.name} rides, is not known yet")
            pose = relative_to(mount, pose)  # ours is of the env's frame
        self.place(key, with_pose(now, pose))

    # --- what the page reads ---------------------------------------------------------------------------

    def view(self, step: StepResult | None, env: int) -> StudioView:
        """
        Args:
            step: of the shown moment.
            env: the selected one.
        """
        looked, progress = self.reports.looked, self.reports.progress
        with self._lock:
            self._cameras.drawn = step, env
            quick = self._quick
            measured = None if looked.report_of is None else self._cameras.placements.now(looked.report_of)
            was = looked.report_settings
            # Not what is rounded away when it is written.
            moved = measured is None or was is None or bool(differences(measured, was, close=3e-4))
            return StudioView(
                cameras=self._cameras.all_as_shown(),
                looked=looked,
                report_stale=looked.report is not None and (moved or looked.outdated),
                quick_scale=self._quick_scale,
                quick=quick if quick and (quick.key, quick.env) == (self._cameras.selected, env) else None,
                progress=progress,
                selected=self._cameras.selected,
                undo=self._cameras.placements.undo_words,
                redo=self._cameras.placements.redo_words,
                writing=self.file.view,
                problem=self._cameras.problem or looked.problem or self._quick_problem,
                serial=self._serial,
            )

    # --- what the session tells ------------------------------------------------------------------------

    def loaded(self, task: TaskDescription, level: ReloadLevel | None) -> tuple[CameraKey, ...]:
        """A version runs, and what was written is compared with it. To be told under the session's lock: calls nobody.

        Args:
            level: how it came in; None for the first.

        Returns:
            the cameras to `ask_for` then, so that the worker's stand where they are placed.
        """
        with self._lock:
            self._cameras.task = task
            said = {c.key: c.settings for c in task.cameras if c.settings is not None}
            own = self.file.loaded(task)
            dropped = self._cameras.placements.loaded(said, own)
            self.file.plan_in_copy(task)
            self._cameras.problem = ""
            if dropped:
                names = " and ".join(key[1] for key in dropped)
                one = len(dropped) == 1
                self._cameras.problem = (
                    f"{names} {'was' if one else 'were'} changed in the file, so {'it stands' if one else 'they stand'} "
                    "where the file says; Undo brings your placement back."
                )
            if self._cameras.selected is not None and self._cameras.info(self._cameras.selected) is None:
                self._cameras.selected = None
            self._serial += 1
            if level not in ("same", "cameras"):
                self.reports.outdate()
            # The dropped ones too: their placement may have been on its way while the version came in. And those that
            # were changed here: taken back, one stands as the file says, which a version that is the same does not tell.
            asked = (*self._cameras.placements.placed, *dropped, *(own & said.keys()))
            return tuple(dict.fromkeys(asked))

    def interrupted(self) -> None:
        """The file was saved, or the worker is gone: what is under way is about what there was before."""
        self.reports.stop()
        self._looking.stop()
        self._looked = None
        self.file.stop()

    def failed_to_load(self) -> None:
        """A version does not load; the one before goes on."""
        with self._lock:
            self.file.failed_to_load()
        self._note()

    def placed_cameras(self) -> tuple[PlaceCamera, ...]:
        """What is to be asked of another worker, so that its cameras stand where they are placed."""
        with self._lock:
            return tuple(
                PlaceCamera(key, settings) for key, settings in self._cameras.placements.placed.items()
            )

    def placed(self, event: Placed, task: TaskDescription | None) -> None:
        """The worker's answer to a placement.

        Args:
            task: with the camera as it is now.
        """
        again = False
        with self._lock:
            if event.why_not:
                self._cameras.problem = f"{event.key[1]} could not be placed: {event.why_not}."
                self._cameras.placements.refused(event.key)
                again = event.settings is not None
            else:
                self._cameras.task = task
        self.ask_for([event.key] if again else [])

    def close(self) -> None:
        """Wait for what is being written."""
        self.reports.close()
        self._looking.close()
        self.file.close()

    # --- small things ----------------------------------------------------------------------------------

    def ask_for(self, keys: Sequence[CameraKey]) -> None:
        """Ask the worker to place these cameras as they are placed now."""
        # What is asked for is read and sent in one go, or of two threads the one that read first might send last.
        with self._asking:
            with self._lock:
                requests = [PlaceCamera(key, self._cameras.placements.placed.get(key)) for key in keys]
            for request in requests:
                self._send(request)
        self._note()

    def _note(self) -> None:
        with self._lock:
            self._serial += 1
        self._on_change()
