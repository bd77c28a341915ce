"""The cameras of the worker's envs: looked through, placed by hand, asked about, and drawn as of the past.

All of it draws the one scene with the one renderer, which works on threads of its own. So before anything else draws or
changes the scene, the picture under way is finished and the cameras that wait to be placed are (`settle`).

Pictures of the cameras on screen are made beside the simulation and never in its way. A picture takes 25 to 90 ms on a
software renderer; made in one go between two steps it would halve the rate of the player. So a picture is begun, steps go
on, and it is fetched when it should be ready, by what the last ones took (see `begin_pictures`). Sensors come before
human cameras, since the two see different objects and cannot be drawn at once, and are handed over as soon as they are
there. No more than 15 rounds a second are made, and after each there is a pause in proportion, so that the browser on the
same machine gets its share. But a camera that is being dragged somebody follows with the hand: its picture is made next
and alone (`hurry`), without a pause, and the others when it rests.
"""

from __future__ import annotations

import pickle
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

from workbench.authoring.problem import problem_from_exception
from workbench.core.camera_settings import CameraKey
from workbench.core.exchange import keep_observation_space
from workbench.core.pictures import CameraKind, Picture
from workbench.core.place_camera import PlacedCameras
from workbench.core.state_columns import read_state_columns
from workbench.core.take_pictures import (
    KINDS,
    BegunPictures,
    Request,
    begin_pictures,
    list_cameras,
    recorded_pictures,
    step_pictures,
    take_pictures,
)
from workbench.core.task_env import TaskEnv
from workbench.jobs.wire import CannotAnswer
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
from workbench.session.questions import CameraQuestion, Captured, CaptureMoment

_PERIOD = 1 / 15
_PAUSE_SHARE = 0.3
"""Of the time a round took."""


class PictureMaker:
    """Rounds of pictures of what `watch` named; `poll` moves the present one on."""

    def __init__(self) -> None:
        self._env_index = 0
        self._requests: tuple[Request, ...] = ()
        self._wanted = False
        self._hurried: set[CameraKey] = set()
        self._next_round = 0.0
        self._round: tuple[Request, ...] = ()
        self._begun: BegunPictures | None = None
        self._begun_at = 0.0
        self._ready_at = 0.0
        self._kinds_left: list[CameraKind] = []
        self._round_began = 0.0
        self._expected: dict[tuple[CameraKey, ...], float] = {}
        self._drawn: tuple[CameraKey, ...] = ()
        self.nothing_else_to_do = False
        """No step is due: a picture is waited for where it is not ready, since guessing when it will be takes longer."""
        self._moment = 0
        self._begun_of = 0
        self.shown = 0
        """Which moment (as `scene_changed` was told) the pictures that were fetched last show."""

    def watch(self, env_index: int, requests: Sequence[Request]) -> None:
        """From now on these cameras of this env."""
        self._env_index, self._requests = env_index, tuple(requests)
        self._wanted = bool(requests)
        self._hurried.clear()
        self._expected.clear()
        self._next_round = 0.0  # somebody waits for these

    def scene_changed(self, moment: int) -> None:
        """What was drawn is old; the scene is now that of `moment`, a number of the caller's."""
        self._wanted, self._moment = bool(self._requests), moment

    def hurry(self, key: CameraKey) -> None:
        """Somebody moves this camera: if it is watched, its picture comes first."""
        if any((kind, name) == key for name, kind, _ in self._requests):
            self._hurried.add(key)

    @property
    def idle(self) -> bool:
        """Whether the renderer is at work on nothing of ours."""
        return self._begun is None

    def wait(self, now: float) -> float | None:
        """Seconds until `poll` has something to do; None while nobody looks."""
        if self._begun is not None:
            return 0.0 if self.nothing_else_to_do else max(0.0, self._ready_at - now)
        if self._hurried:
            return 0.0
        return max(0.0, self._next_round - now) if self._wanted else None

    def poll(self, env: TaskEnv, now: float) -> tuple[tuple[Picture, ...], float] | None:
        """Begin or fetch what is due; the pictures of a kind and their seconds when they are complete."""
        if self._begun is None:
            if not self._hurried and (not self._wanted or now < self._next_round):
                return None
            if self._hurried:
                self._round = tuple(r for r in self._requests if (r[1], r[0]) in self._hurried)
                self._hurried.clear()
            else:
                self._round, self._wanted = self._requests, False
            self._round_began = now
            self._kinds_left = [kind for kind in KINDS if any(r[1] == kind for r in self._round)]
            self._begin_next(env)
            return None
        if now < self._ready_at and not self.nothing_else_to_do:
            return None
        made, seconds = self._fetch()
        if self._kinds_left:
            self._begin_next(env)
        else:
            done = time.monotonic()
            pause = _PAUSE_SHARE * (done - self._round_began)
            self._next_round = max(self._round_began + _PERIOD, done + pause)
        return made, seconds

    def settle(self) -> None:
        """Wait for the renderer and give up the round: the scene is about to be closed or drawn anew."""
        if self._begun is not None:
            self._begun.finish()
            self._begun = None
            self._wanted = bool(self._requests)

    def _begin_next(self, env: TaskEnv) -> None:
        kind = self._kinds_left.pop(0)
        chosen = [request for request in self._round if request[1] == kind]
        self._begun = begin_pictures(env.env, self._env_index, chosen)
        self._drawn = tuple((kind, name) for name, kind, _ in chosen)
        self._begun_of = self._moment
        self._begun_at = time.monotonic()
        self._ready_at = self._begun_at + self._expected.get(self._drawn, 0.0)

    def _fetch(self) -> tuple[tuple[Picture, ...], float]:
        begun, self._begun = self._begun, None
        assert begun is not None
        asked = time.monotonic()
        made = tuple(begun.finish())
        self.shown = self._begun_of
        done = time.monotonic()
        waited = done - asked > 0.004
        # Fetched too early, the wait tells how long it takes; otherwise it may take less than expected.
        took = done - self._begun_at
        self._expected[self._drawn] = min(took, 1.0) if waited else 0.9 * self._expected.get(self._drawn, 0.0)
        return made, took


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
        self._held.line.send(Pictures(pictures, 1000 * seconds, self._pictures.shown))
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
