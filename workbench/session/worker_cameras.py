"""The cameras of the worker's envs: looked through, placed by hand, asked about, and drawn as of the past.

All of it draws the one scene with the one renderer, which works on threads of its own. So before anything else draws or
changes the scene, the picture under way is finished and the cameras that wait to be placed are (`settle`).
"""

from __future__ import annotations

import pickle
import time
from collections.abc import Callable
from dataclasses import replace

from workbench.authoring.problem import problem_from_exception
from workbench.core.camera_settings import CameraKey
from workbench.core.exchange import keep_observation_space
from workbench.core.place_camera import PlacedCameras
from workbench.core.state_columns import read_state_columns
from workbench.core.take_pictures import list_cameras, step_pictures, take_pictures
from workbench.session.calls import CannotAnswer
from workbench.session.camera_answers import answer
from workbench.session.held_task import HeldTask
from workbench.session.messages import (
    CameraRequest,
    DrawPast,
    PastPictures,
    Pictures,
    PlaceCamera,
    Placed,
)
from workbench.session.open_task import OpenedTask, blamed
from workbench.session.picture_maker import PictureMaker
from workbench.session.questions import CameraQuestion, Captured, CaptureMoment
from workbench.session.recorded_pictures import recorded_pictures


class WorkerCameras:
    """See the module's text."""

    def __init__(self, held: HeldTask, on_first: Callable[[bool], None]) -> None:
        """
        Args:
            on_first: called with False before the first picture of the process is begun, and with True when it is there.
        """
        self._held, self._on_first = held, on_first
        self._watched: tuple[int, tuple[CameraRequest, ...]] = 0, ()
        """The env, and its cameras, whose pictures are kept being made."""
        self._pictures = PictureMaker()
        self._placed = PlacedCameras()
        self._to_place: dict[CameraKey, PlaceCamera] = {}
        self._renderer_ready = False

    # --- what is asked -------------------------------------------------------------------------------

    def watch(self, env: int, cameras: tuple[CameraRequest, ...]) -> None:
        # It is said with every setting, also when the first picture is under way already.
        if (env, cameras) != self._watched:
            self._watched = env, cameras
            self.look_again()

    def place(self, request: PlaceCamera) -> None:
        # Not at once: the picture under way is finished first, or a drag faster than the renderer would see none.
        self._to_place.pop(request.key, None)
        self._to_place[request.key] = request

    def place_now(self, opened: OpenedTask, request: PlaceCamera) -> Placed:
        self.settle()
        return self._place(opened, request)

    def answer(
        self, opened: OpenedTask, question: CameraQuestion, tell: Callable[[int, int], None]
    ) -> object:
        self.settle()
        self._held.pulse.begin("drawing")
        try:
            return answer(opened, self._placed, question, tell, self._held.line.waits)
        except (ValueError, IndexError, RuntimeError) as error:
            raise CannotAnswer(str(error)) from error
        finally:
            self._held.pulse.begin("idle")

    def draw_past(self, request: DrawPast) -> None:
        opened = self._held.opened
        if opened is None:
            return
        self.settle()  # its cameras and bodies are about to be drawn elsewhere
        try:
            pictures = take_pictures(opened.env.env, request.env, request.cameras, request.poses)
        except (RuntimeError, ValueError, IndexError) as error:
            self._held.fail(problem_from_exception(error, "pictures", opened.loaded.source_files))
            return
        self._held.line.send(PastPictures(request.origin, pictures))

    def capture(self, opened: OpenedTask, request: CaptureMoment) -> Captured:
        """What the server's history has not: env states, observations and pictures, of envs that are put back.

        Raises:
            TaskError: a hook of the author's raised.
        """
        self.settle()  # the same scene is about to be drawn
        with blamed("restore", opened.loaded, opened.env):
            # All of them: what the task keeps for the batch, and the process's generators, go back with all only. They
            # make no step, so their physics needs no fresh scene.
            opened.env.restore(pickle.loads(request.snapshot), fresh_physics=False)
            columns = read_state_columns(opened.env)
        wanted = recorded_pictures(opened.description.cameras) if request.pictures else ()
        drawn = step_pictures(opened.env, request.env_idx, wanted)
        return Captured(columns, tuple(drawn))

    # --- what the worker does to the scene -----------------------------------------------------------

    def look_again(self) -> None:
        """The cameras may be others than before: watch those that are wanted and there are."""
        self.settle()
        opened = self._held.opened
        if opened is None:
            return
        known = {(camera.name, camera.kind) for camera in opened.description.cameras}
        env, cameras = self._watched
        wanted = [camera for camera in cameras if (camera.name, camera.kind) in known]
        self._pictures.watch(min(env, opened.env.num_envs - 1), wanted)

    def scene_changed(self) -> None:
        """What was drawn is old."""
        self._pictures.scene_changed(self._held.steps.number)

    def settle(self) -> None:
        """The scene is about to be drawn or built otherwise: what is under way ends, and cameras stand as asked."""
        self.finish_picture()
        self.place_waiting()

    def finish_picture(self) -> None:
        """The envs are about to be moved: what is under way ends."""
        self._pictures.settle()

    def put_back(self) -> None:
        """The scene's cameras may be new ones: those that were placed stand there again."""
        if self._held.opened is not None:
            self._placed.put_back(self._held.opened.env.env)

    def forget_placed(self) -> None:
        """The cameras are those of another version: nothing is placed."""
        self._placed.forget()

    # --- the loop's turns ----------------------------------------------------------------------------

    def wait(self, now: float) -> float | None:
        """Seconds until `make` has something to do; None while nobody looks."""
        return None if self._held.opened is None else self._pictures.wait(now)

    @property
    def placing_due(self) -> bool:
        return bool(self._to_place) and self._pictures.idle

    def place_waiting(self) -> None:
        """Those that wait. No picture may be under way."""
        wanted, self._to_place = self._to_place, {}
        for request in wanted.values():
            if self._held.opened is not None:
                self._held.line.send(self._place(self._held.opened, request))

    def make(self, nothing_else_to_do: bool) -> None:
        """Move the pictures on that somebody looks at."""
        opened = self._held.opened
        if opened is None or self._pictures.wait(time.monotonic()) is None:
            return
        if not self._renderer_ready and self._pictures.idle:
            # The first picture of a process compiles the shaders: 5 to 19 s on a software renderer.
            self._on_first(False)
        self._held.pulse.begin("drawing")
        self._pictures.nothing_else_to_do = nothing_else_to_do
        try:
            made = self._pictures.poll(opened.env, time.monotonic())
        except RuntimeError as error:
            self._pictures.watch(0, ())  # until others are asked for, or another version is loaded
            self._held.fail(problem_from_exception(error, "pictures", opened.loaded.source_files))
            return
        if made is None:
            return
        pictures, seconds = made
        self._held.line.send(Pictures(pictures, 1000 * seconds, tuple(self._pictures.moments)))
        if not self._renderer_ready:
            self._renderer_ready = True
            self._on_first(True)

    # --- the inside ----------------------------------------------------------------------------------

    def _place(self, opened: OpenedTask, request: PlaceCamera) -> Placed:
        key, env = request.key, opened.env.env
        try:
            with self._held.interrupts.shielded():
                reshaped = self._placed.place(env, key, request.settings)
        except (ValueError, RuntimeError) as error:
            return Placed(key, request.settings, None, why_not=str(error))
        said = {c.key: c for c in opened.description.cameras}
        infos = tuple(
            replace(info, settings=before.settings, varies=before.varies, site=before.site)
            for info in list_cameras(env)
            if (before := said.get(info.key)) is not None
        )
        self._held.opened = replace(opened, description=replace(opened.description, cameras=infos))
        self.scene_changed()
        self._pictures.hurry(key)
        if reshaped and key[0] == "sensor" and opened.env.observes_pictures:
            self._held.guarded(_observe_again)
        info = next((info for info in infos if info.key == key), None)
        return Placed(key, request.settings, info, reshaped)


def _observe_again(opened: OpenedTask) -> None:
    """A policy must not be given pictures of the size that was."""
    with blamed("step", opened.loaded, opened.env):
        opened.env.judge()
    keep_observation_space(opened.env.env, opened.env.obs)
