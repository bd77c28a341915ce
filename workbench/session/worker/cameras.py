"""The cameras of the worker's envs: looked through, placed by hand, asked about, and drawn as of the past.

All of it draws the one scene with the one renderer, which works on threads of its own. So before anything else draws or
changes the scene, the picture under way is finished and the cameras that wait to be placed are (`settle`).

Pictures of the cameras on screen are made beside the simulation and never in its way. A picture takes 25 to 90 ms on a
software renderer; made in one go between two steps it would halve the rate of the player. So a picture is begun, steps go
on, and it is fetched when it should be ready, by what the last ones took (see `begin_pictures`). Sensors come before
human cameras, since the two see different objects and cannot be drawn at once, and are handed over as soon as they are
there. No more than 15 rounds a second are made, and after each there is a pause in proportion, so that the browser on the
same machine gets its share. But a camera that is being dragged somebody follows with the hand: its picture is made next
and alone, without a pause, and the others when it rests.
"""

from __future__ import annotations

import pickle
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

from workbench.authoring.problem import problem_from_exception
from workbench.core.camera_data import CameraKey, Picture
from workbench.core.cameras.place import PlacedCameras
from workbench.core.cameras.render import (
    KINDS,
    PendingPictures,
    begin_pictures,
    list_cameras,
    recorded_pictures,
    step_pictures,
    take_pictures,
)
from workbench.core.capture.state_columns import read_state_columns
from workbench.core.env.hot_swap import keep_observation_space
from workbench.core.env.task_env import TaskEnv
from workbench.jobs.open_task import OpenedTask, blamed
from workbench.jobs.pool import CannotAnswer
from workbench.session.protocol.messages import (
    CameraRequest,
    DrawPast,
    PastPictures,
    Pictures,
    PlaceCamera,
    Placed,
)
from workbench.session.protocol.questions import CameraQuestion, Captured, CaptureMoment
from workbench.session.worker.camera_answers import answer
from workbench.session.worker.guarded_task import GuardedTask

_PERIOD = 1 / 15
_PAUSE_SHARE = 0.3
"""Of the time a round took."""


@dataclass(frozen=True)
class _Begun:
    """Pictures of one kind that the renderer is at work on."""

    pictures: PendingPictures
    asked: tuple[CameraRequest, ...]
    number: int
    """Of the moment that they show."""
    at: float
    ready_at: float
    """What they should be ready at, in seconds of `time.monotonic` as `at`."""


class WorkerCameras:
    """See the module's text."""

    def __init__(self, held: GuardedTask, on_first: Callable[[bool], None]) -> None:
        """
        Args:
            on_first: called with False before the first picture of the process is begun, and with True when it is there.
        """
        self._held, self._on_first = held, on_first
        self._watched: tuple[int, tuple[CameraRequest, ...]] = 0, ()
        """The env, and its cameras, whose pictures are kept being made."""
        self._there: tuple[CameraRequest, ...] = ()
        """Those of them that the version has."""
        self._wanted = False
        """Their pictures are not of the moment that is."""
        self._hurried: set[CameraKey] = set()
        self._left: list[tuple[CameraRequest, ...]] = []
        """What of a round is not begun, kind by kind."""
        self._begun: _Begun | None = None
        self._expected: dict[tuple[CameraRequest, ...], float] = {}
        """Seconds that pictures take."""
        self._round_began = self._next_round = 0.0
        self._nothing_else_to_do = False
        """No step is due: a picture is waited for where it is not ready, since guessing when it will be takes longer."""
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
        self._held.heartbeat.begin("drawing")
        try:
            return answer(opened, self._placed, question, tell, self._held.line.waits)
        except (ValueError, IndexError, RuntimeError) as error:
            raise CannotAnswer(str(error)) from error
        finally:
            self._held.heartbeat.begin("idle")

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
        drawn: list[Picture] = []
        for env in request.env_idx:
            if self._held.line.waits():
                raise CannotAnswer("nobody waits for it any more")
            drawn += step_pictures(opened.env, [env], wanted)
        return Captured(columns, tuple(drawn))

    # --- what the worker does to the scene -----------------------------------------------------------

    def look_again(self) -> None:
        """The cameras may be others than before: watch those that are wanted and there are."""
        self.settle()
        opened = self._held.opened
        if opened is None:
            return
        known = {camera.key for camera in opened.description.cameras}
        self._watch(tuple(camera for camera in self._watched[1] if camera.key in known))

    def _watch(self, cameras: tuple[CameraRequest, ...]) -> None:
        self._there, self._wanted = cameras, bool(cameras)
        self._hurried.clear()
        self._expected.clear()
        self._next_round = 0.0  # somebody waits for these

    def scene_changed(self) -> None:
        """What was drawn is old."""
        self._wanted = bool(self._there)

    def settle(self) -> None:
        """The scene is about to be drawn or built otherwise: what is under way ends, and cameras stand as asked."""
        self.finish_picture()
        self.place_waiting()

    def finish_picture(self) -> None:
        """The envs are about to be moved: what is under way ends."""
        if self._begun is not None:
            self._begun.pictures.finish()
            self._begun, self._left = None, []
            self._wanted = bool(self._there)

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
        if self._held.opened is None:
            return None
        if self._begun is not None:
            return 0.0 if self._nothing_else_to_do else max(0.0, self._begun.ready_at - now)
        if self._hurried:
            return 0.0
        return max(0.0, self._next_round - now) if self._wanted else None

    @property
    def placing_due(self) -> bool:
        return bool(self._to_place) and self._begun is None

    def place_waiting(self) -> None:
        """Those that wait. No picture may be under way."""
        wanted, self._to_place = self._to_place, {}
        for request in wanted.values():
            if self._held.opened is not None:
                self._held.line.send(self._place(self._held.opened, request))

    def make(self, nothing_else_to_do: bool) -> None:
        """Move the pictures on that somebody looks at."""
        self._nothing_else_to_do = nothing_else_to_do
        opened, wait = self._held.opened, self.wait(time.monotonic())
        if opened is None or wait is None or wait > 0:
            return
        if not self._renderer_ready and self._begun is None:
            # The first picture of a process compiles the shaders: 5 to 19 s on a software renderer.
            self._on_first(False)
        self._held.heartbeat.begin("drawing")
        try:
            made = None if self._begun is None else self._fetch(self._begun)
            if made is None:
                self._begin_round()
            self._begin(opened.env)
        except RuntimeError as error:
            self._watch(())  # until others are asked for, or another version is loaded
            self._held.fail(problem_from_exception(error, "pictures", opened.loaded.source_files))
            return
        if made is None:
            return
        self._held.line.send(made)
        if not self._renderer_ready:
            self._renderer_ready = True
            self._on_first(True)

    # --- the inside ----------------------------------------------------------------------------------

    def _begin_round(self) -> None:
        chosen = tuple(camera for camera in self._there if camera.key in self._hurried) or self._there
        self._wanted = self._wanted and bool(self._hurried)
        self._hurried.clear()
        groups = (tuple(camera for camera in chosen if camera.kind == kind) for kind in KINDS)
        self._left, self._round_began = [group for group in groups if group], time.monotonic()

    def _fetch(self, begun: _Begun) -> Pictures:
        self._begun, asked_at = None, time.monotonic()
        made = begun.pictures.finish()
        done = time.monotonic()
        # Fetched too early, the wait tells how long it takes; otherwise it may take less than expected.
        took, waited = done - begun.at, done - asked_at > 0.004
        self._expected[begun.asked] = min(took, 1.0) if waited else 0.9 * self._expected.get(begun.asked, 0.0)
        if not self._left:
            pause = _PAUSE_SHARE * (done - self._round_began)
            self._next_round = max(self._round_began + _PERIOD, done + pause)
        return Pictures(made, 1000 * took, begun.number)

    def _begin(self, env: TaskEnv) -> None:
        """What is next of the round, if anything is left of it."""
        if self._left:
            asked = self._left.pop(0)
            pictures = begin_pictures(env.env, min(self._watched[0], env.num_envs - 1), asked)
            at = time.monotonic()
            ready_at = at + self._expected.get(asked, 0.0)
            self._begun = _Begun(pictures, asked, self._held.steps.number, at, ready_at)

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
        # Somebody moves this camera: if it is watched, its picture comes first.
        self._hurried |= {key} & {camera.key for camera in self._there}
        if reshaped and key[0] == "sensor" and opened.env.observes_pictures:
            self._held.guarded(_observe_again)
        info = next((info for info in infos if info.key == key), None)
        return Placed(key, request.settings, info, reshaped)


def _observe_again(opened: OpenedTask) -> None:
    """A policy must not be given pictures of the size that was."""
    with blamed("step", opened.loaded, opened.env):
        opened.env.rescore()
    keep_observation_space(opened.env.env, opened.env.obs)
