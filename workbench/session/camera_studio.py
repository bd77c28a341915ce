"""The camera studio: cameras placed by hand, judged over the batch, and written into the author's file.

The page calls the methods here, on any thread; each returns at once. What comes of them is in `StudioView`.

A placement is known in three places: here (with its undo), in the worker's live cameras, and in the end in the
author's file. What is here counts: after every version that comes in the worker is told again, so that neither a
reload nor the end of a worker moves a camera. What is in the file counts more, when the author changed it there.

Here is how a camera comes to stand somewhere, and what is asked about it there; the way into the file is `file`.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal

from workbench.core.camera_frames import Convention, Direction, with_pose
from workbench.core.camera_settings import (
    CameraKey,
    CameraSettings,
    differences,
    why_no_camera,
)
from workbench.core.step import StepResult
from workbench.session.askers import Asker, Background
from workbench.session.camera_judging import CameraJudging
from workbench.session.messages import PlaceCamera, Placed, ReloadLevel, Request, TaskDescription
from workbench.session.placements import Step
from workbench.session.preview import IN_A_QUICK_LOOK, Preview, Sight
from workbench.session.studio_cameras import StudioCameras, exported, imported
from workbench.session.studio_file import StudioFile
from workbench.session.studio_view import StudioCamera, StudioView, Wish
from workbench.session.timeline import TimeTravel
from workbench.session.versions import Versions

MOST_SEEDS = 1000
MOST_STEPS = 1000
_LARGEST = 256
"""Pixels of the shorter side of a new camera's picture, before it is written."""


class CameraStudio:
    """See the module's text."""

    def __init__(
        self,
        send: Callable[[Request], None],
        asker: Asker,
        background: Background,
        on_change: Callable[[], None],
        past: TimeTravel,
        versions: Versions,
    ) -> None:
        """
        Args:
            send, asker: tell and ask the worker that plays.
            background: asks the other.
            on_change: called, on any thread, when `view` has something new.
            past: says which moment the page shows.
            versions: say how another worker gets the version that runs, and open another file.
        """
        self._send, self._on_change = send, on_change
        self._shown, self._episode, self._load = past.shown_moment, past.episode_moments, versions.same_again
        self._cameras = StudioCameras()
        self._lock = self._cameras.lock
        self.file = StudioFile(self._cameras, self._note, versions.open_file, asker, self._load)
        self._asking = threading.Lock()
        """Held while placements are sent; taken before `_lock`."""
        self._serial = 0
        self._judging = CameraJudging(asker, background, self._note)
        self._quick = Preview(asker, self._note, "The quick look failed", IN_A_QUICK_LOOK)
        self._quick_scale = 1.0
        self._first = Preview(asker, self._note, "There is no picture of the new camera")

    # --- placing -------------------------------------------------------------------------------------

    def select(self, key: CameraKey | None) -> None:
        """Choose the camera that the page works on."""
        with self._lock:
            self._cameras.selected = (
                key if key is None or self._cameras.info(key) is not None else self._cameras.selected
            )
        self._note()

    def place(self, key: CameraKey, settings: CameraSettings, gesture: int | None = None) -> None:
        """Place a camera, live. Of placements faster than the worker only the newest is made.

        Args:
            gesture: calls with the same number, one behind the other, are one step of undo (a drag).
        """
        with self._lock:
            why_not = self._cameras.refusal(key) or why_no_camera(settings)
            self._cameras.problem = f"{key[1]} is left where it is: {why_not}." if why_not else ""
            moved = not why_not and self._cameras.placements.place(key, settings, gesture)
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
            file = self._cameras.placements.file(key)
            moved = file is not None and self._cameras.placements.place(
                key, file, words=f"put {key[1]} back to the file"
            )
        self.ask_for([key] if moved else [])

    def plan(self, wish: Wish) -> None:
        """Find the edit that fulfils a wish; what a new camera would see is `StudioView.first_sight`."""
        self.file.plan(wish)
        if wish.what == "add" and wish.settings is not None:
            moment, smaller = self._shown(), _LARGEST / min(wish.settings.width, wish.settings.height)
            sight = Sight(wish.key, wish.settings, moment.env, None, min(1.0, smaller))
            self._first.forget()
            self._first.look(sight, moment.of(moment.env))

    # --- judged ----------------------------------------------------------------------------------------

    def judge(self, key: CameraKey, seeds: int = 0) -> None:
        """Judge a camera as it is placed over all envs.

        Args:
            seeds: 0 for the envs at the shown moment; else over so many freshly reset ones, in the background.
        """
        camera = self._asked_for(key)
        if camera is not None and seeds <= 0:
            self._judging.judge(key, camera.now, self._shown())
        elif camera is not None and (load := self._load()) is not None:
            self._judging.judge_seeds(key, camera.now, camera.moved, load, min(seeds, MOST_SEEDS))

    def _asked_for(self, key: CameraKey) -> StudioCamera | None:
        with self._lock:
            camera = self._cameras.asked_for(key)
        self._note()
        return camera

    def judge_steps(self, key: CameraKey, most: int = MOST_STEPS) -> None:
        """Judge a camera as it is placed over the steps of the episode that the selected env is in.

        Args:
            most: how many of them, evenly spread.
        """
        camera = self._asked_for(key)
        if camera is not None and (moments := self._episode(min(max(1, most), MOST_STEPS))):
            self._judging.judge_steps(key, camera.now, moments)

    def suggest(
        self,
        key: CameraKey,
        objects: Sequence[str],
        low: tuple[float, float, float],
        high: tuple[float, float, float],
        seeds: int,
    ) -> None:
        """Search placements that see these objects over so many seeds, with the eye between two corners.

        Args:
            objects: names of objects, or of single links of them (``TaskDescription.objects``).
            low, high: metres, in the frame of the camera's mount, or the env's if it has none.
        """
        camera = self._asked_for(key)
        if camera is None:
            return
        if camera.now is None:
            with self._lock:
                self._cameras.problem = f"{key[1]} cannot be placed: {camera.refused}."
            self._note()
        elif (load := self._load()) is not None:
            self._judging.suggest(key, camera.now, tuple(objects), low, high, load, seeds)

    def take_suggestion(self, index: int) -> None:
        """Place the camera as suggested."""
        looked = self._judging.looked
        key = looked.suggestions_of
        if key is None or not 0 <= index < len(looked.suggestions):
            return
        found = looked.suggestions[index].settings
        with self._lock:
            now = self._cameras.placements.now(key)
        if now is not None:
            self.place(key, replace(now, position=found.position, quaternion=found.quaternion))

    def stop(self) -> None:
        """Stop whatever runs in the background; what is known stays."""
        self._judging.stop()

    def compare(self, key: CameraKey, other: CameraSettings) -> None:
        """Two pictures of the shown env: the camera as it is placed, and as it would be with other settings."""
        with self._lock:
            why_not = self._cameras.refusal(key) or why_no_camera(other)
            self._cameras.problem = f"{key[1]} is not compared: {why_not}." if why_not else ""
        if not why_not:
            self._judging.compare(key, other, self._shown())
        self._note()

    def make_sheet(self, key: CameraKey) -> None:
        """The pictures of all envs by one camera, worst first if it was judged over them."""
        if self._asked_for(key) is not None:
            self._judging.make_sheet(key, self._shown())

    def set_quick_scale(self, scale: float) -> None:
        """Look through the chosen camera in a picture of so much of its own size; 1 for that itself. Never written."""
        with self._lock:
            self._quick_scale = scale
        self._quick.forget()
        self._note()

    def look(self) -> None:
        """Take the quick look that `StudioView.wants_quick` tells of."""
        with self._lock:
            sight = self._sight()
        if sight is not None and self._quick.wants(sight):
            self._quick.look(sight, self._shown().of(sight.env))

    def _sight(self) -> Sight | None:
        key = self._cameras.selected
        now = None if key is None else self._cameras.placements.now(key)
        if self._quick_scale == 1.0 or key is None or now is None or self._cameras.refusal(key) is not None:
            return None
        step, env = self._cameras.drawn
        return Sight(key, now, env, step, self._quick_scale)

    def pick(self, key: CameraKey, u: float, v: float) -> None:
        """What is seen at a place of the picture: 0, 0 is its upper left corner, 1, 1 its lower right one."""
        with self._lock:
            info, task = self._cameras.info(key), self._cameras.task
        if info is not None and task is not None:
            self._judging.pick(info, u, v, self._shown(), task.segmentation)

    # --- in other words --------------------------------------------------------------------------------

    def export(self, keys: Sequence[CameraKey], form: Literal["json", "opencv", "ros"]) -> str:
        """The cameras as they are placed, at the shown moment of the selected env, as the text of a file.

        ROS's form is one file a camera: of several, one document after the other.

        Raises:
            ValueError: one of them is not there, or cannot be said; a sentence for the reader.
        """
        with self._lock:
            cameras = [self._cameras.to_export(key) for key in keys]
        return exported(cameras, form)

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
        pose = imported(info, mount, text, direction, convention, metres_per_unit)
        self.place(key, with_pose(now, pose))

    # --- what the page reads ---------------------------------------------------------------------------

    def view(self, step: StepResult | None, env: int) -> StudioView:
        """
        Args:
            step: of the shown moment.
            env: the selected one.
        """
        looked, progress = self._judging.looked, self._judging.progress
        with self._lock:
            self._cameras.drawn = step, env
            sight = self._sight()
            judged = None if looked.report_of is None else self._cameras.placements.now(looked.report_of)
            was = looked.report_settings
            # Not what is rounded away when it is written.
            moved = judged is None or was is None or bool(differences(judged, was, close=3e-4))
            return StudioView(
                cameras=self._cameras.all_as_shown(),
                looked=looked,
                report_stale=looked.report is not None and (moved or looked.outdated),
                quick_scale=self._quick_scale,
                quick=self._quick.picture(self._cameras.selected, env),
                wants_quick=sight is not None and self._quick.wants(sight),
                progress=progress,
                selected=self._cameras.selected,
                undo=self._cameras.placements.undo_words,
                redo=self._cameras.placements.redo_words,
                writing=(writing := self.file.view),
                first_sight=self._first.picture(writing.key if writing.stage == "planned" else None),
                problem=self._cameras.problem or looked.problem or self._quick.problem or self._first.problem,
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
                self._judging.outdate()
            # The dropped ones too: their placement may have been on its way while the version came in. And those that
            # were changed here: taken back, one stands as the file says, which a version that is the same does not tell.
            asked = (*self._cameras.placements.all_moved, *dropped, *(own & said.keys()))
            return tuple(dict.fromkeys(asked))

    def interrupted(self) -> None:
        """The file was saved, or the worker is gone: what is under way is about what there was before."""
        self._judging.stop()
        self._quick.stop()
        self._first.stop()
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
                PlaceCamera(key, settings) for key, settings in self._cameras.placements.all_moved.items()
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
        self._judging.close()
        self._quick.close()
        self._first.close()
        self.file.close()

    # --- small things ----------------------------------------------------------------------------------

    def ask_for(self, keys: Sequence[CameraKey]) -> None:
        """Ask the worker to place these cameras as they are placed now."""
        # What is asked for is read and sent in one go, or of two threads the one that read first might send last.
        with self._asking:
            with self._lock:
                now = self._cameras.placements
                requests = [PlaceCamera(key, now.now(key) if now.moved(key) else None) for key in keys]
            for request in requests:
                self._send(request)
        self._note()

    def _note(self) -> None:
        with self._lock:
            self._serial += 1
        self._on_change()
