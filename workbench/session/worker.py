"""The worker process: it imports the author's file, owns the env, and is the only one that steps it.

It is a process of its own because SAPIEN holds the interpreter lock while it steps and renders, and
because the author's code may loop for ever or crash: the page must go on. One loop does everything, so
nothing ever touches the env while it steps: take the requests that have come, take a step if one is
due, make pictures if somebody looks, sleep until the next of these.

The server starts it through `worker_start`, with one end of a socket pair. Whatever the loop does is noted in
shared memory (`pulse`), and while it is the author's code it can be left by hand (`interrupts`).

What is here is the loop, and what each request does to the env. How a version comes in is in `reload`, what the
envs do next in `acting`, what is told of each step in `step_events`, and when pictures are made in `picture_maker`.
"""

from __future__ import annotations

import gc
import pickle
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import torch

from workbench.authoring.problem import Problem, TaskError, problem_from_exception
from workbench.core.camera_configs import note_camera_sites
from workbench.core.camera_settings import CameraKey
from workbench.core.exchange import keep_observation_space
from workbench.core.inspect_env import inspect_env
from workbench.core.place_camera import PlacedCameras
from workbench.core.snapshot import restore_snapshot
from workbench.core.step import StepResult
from workbench.core.take_pictures import Request as PictureRequest
from workbench.core.take_pictures import list_cameras, take_pictures
from workbench.session import rescore_run
from workbench.session.acting import Acting
from workbench.session.camera_answers import answer
from workbench.session.camera_messages import (
    CameraQuestion,
    CameraQuestionFailed,
    DrawCamera,
    JudgeCamera,
    SuggestCameras,
)
from workbench.session.capture_moments import capture_moments
from workbench.session.interrupts import Interrupted, Interrupts
from workbench.session.judge_moments import judge_moments
from workbench.session.messages import (
    SCENE_KEPT,
    CaptureMoments,
    DrawPast,
    EpisodeEnd,
    Event,
    Failed,
    Inspect,
    JudgeMoments,
    Load,
    Loaded,
    Loading,
    PastPictures,
    Pictures,
    PlaceCamera,
    Placed,
    Play,
    Quit,
    ReloadReport,
    Request,
    Reset,
    Restore,
    Restored,
    SetActionSource,
    SetCapture,
    SetEpisodeEnd,
    SetSliders,
    SetSpeed,
    SingleStep,
    Status,
    StepBack,
    WarmedUp,
    WarmUp,
    WatchCameras,
    is_a_step,
)
from workbench.session.open_task import OpenedTask, blamed, reset_checked, restore_checked, step_checked
from workbench.session.pacing import Pacer, Rate
from workbench.session.picture_maker import PictureMaker
from workbench.session.pulse import Doing, PulseWriter
from workbench.session.reload import Running, load_version
from workbench.session.rescore_messages import Rescore
from workbench.session.step_back_run import going_there, step_back
from workbench.session.step_events import StepEvents
from workbench.session.warm_up import warm_up

_STATUS_PERIOD = 0.25
_IDLE = 0.5
"""Seconds to sleep when nothing is due; a request ends the sleep at once."""


class Worker:
    """The state of the loop; see the module's text."""

    def __init__(self, connection: Connection, pulse: PulseWriter) -> None:
        self._connection = connection
        self._pulse = pulse
        self._interrupts = Interrupts()
        self._opened: OpenedTask | None = None
        self._loaded_by: Load | None = None
        self._last: StepResult | None = None
        self._playing = False
        self._acting = Acting()
        self._episode_end: EpisodeEnd = "reset"
        self._pacer = Pacer(0.05)
        self._rate = Rate()
        self._watch = WatchCameras(0, ())
        self._pictures = PictureMaker()
        self._placed = PlacedCameras()
        self._to_place: dict[CameraKey, PlaceCamera] = {}
        self._renderer_ready = False
        self._steps = StepEvents()
        self._status_sent = 0.0
        self._quit = False
        self._queue: deque[Request] = deque()
        """What has come and was not carried out."""
        self._handlers: dict[type, Callable[[Any], None]] = {
            Load: self._load,
            Play: self._play,
            SingleStep: lambda request: self._control_step(),
            Reset: self._reset,
            SetSpeed: self._set_speed,
            SetEpisodeEnd: self._set_episode_end,
            SetActionSource: self._set_action_source,
            SetSliders: self._set_sliders,
            WatchCameras: self._watch_cameras,
            PlaceCamera: self._place_camera,
            DrawCamera: self._answer_about_camera,
            JudgeCamera: self._answer_about_camera,
            SuggestCameras: self._answer_about_camera,
            SetCapture: self._set_capture,
            Restore: self._restore,
            StepBack: self._step_back,
            DrawPast: self._draw_past,
            WarmUp: self._warm_up,
            Inspect: self._inspect,
            JudgeMoments: self._judge_moments,
            Rescore: self._rescore,
            CaptureMoments: self._capture_moments,
            Quit: self._stop,
        }

    def run(self) -> None:
        """Until the server says so or hangs up."""
        self._interrupts.install()
        while not self._quit:
            self._pulse.begin("idle")
            self._queue.extend(self._requests(self._sleep()))
            while self._queue:
                request = self._queue.popleft()
                self._at_work(_DOING.get(type(request)), partial(self._handlers[type(request)], request))
            now = time.monotonic()
            if self._playing and self._pacer.due(now):
                self._pacer.spend()
                self._at_work("stepping", self._control_step)
            if self._to_place and self._pictures.idle:
                self._at_work("stepping", self._place_cameras)
            self._make_pictures()
            self._send_status(time.monotonic())

    def _at_work(self, doing: Doing | None, work: Callable[[], None]) -> None:
        """Do `work`; if the author's code is at work in it, it can be left."""
        if doing is None:
            work()
            return
        self._pulse.begin(doing)
        try:
            self._interrupts.run(work)
        except Interrupted as error:
            # Outside of what knows its task: between two hooks, or in the workbench's own code.
            self._drop_steps()
            known = () if self._opened is None else self._opened.loaded.source_files
            self._fail(problem_from_exception(error, _STAGE.get(doing, "step"), known))
            self._back_to_the_moment()
        finally:
            self._pulse.begin("idle")

    def _back_to_the_moment(self) -> None:
        """After a step was left half done: the batch stands again where the last one ended."""
        if self._opened is None or self._steps.moment is None:
            return
        try:
            # Not `TaskEnv.restore`: that calls `evaluate`, which may be what would not end.
            restore_snapshot(self._opened.env.env, self._steps.moment)
        except (RuntimeError, ValueError, TypeError) as error:
            self._fail(problem_from_exception(error, "reset", self._opened.loaded.source_files))

    # --- requests ----------------------------------------------------------------------------------

    def _sleep(self) -> float:
        waits = [_IDLE]
        if self._playing:
            waits.append(self._pacer.wait())
        picture = self._pictures.wait(time.monotonic())
        if picture is not None and self._opened is not None:
            waits.append(picture)
        return min(waits)

    def _requests(self, timeout: float) -> list[Request]:
        """What has come; of several loads only the last, since each replaces the one before."""
        requests: list[Request] = []
        try:
            while self._connection.poll(timeout if not requests else 0):
                requests.append(self._connection.recv())
        except (EOFError, OSError):
            self._quit = True
        loads = [request for request in requests if isinstance(request, Load)]
        return [request for request in requests if not isinstance(request, Load) or request is loads[-1]]

    def _drop_steps(self) -> None:
        """What was pressed while a hook hung is not to make it hang again. Before the page is told of the
        interrupt: what is pressed after that is meant."""
        with self._interrupts.shielded():
            waiting = [*self._queue, *self._requests(0.0)]
            self._queue = deque(request for request in waiting if not is_a_step(request))

    def _send(self, event: Event) -> None:
        try:
            with self._interrupts.shielded():
                self._connection.send(event)
        except (BrokenPipeError, OSError):
            self._quit = True

    def _load(self, request: Load) -> None:
        self._settle()
        running = None
        if self._opened is not None and self._loaded_by is not None and self._last is not None:
            running = Running(self._loaded_by, self._opened, self._last)
        try:
            opened, report = load_version(
                request, running, on_activity=lambda activity: self._send(Loading(activity))
            )
        except TaskError as error:
            if self._opened is not None:
                self._placed.put_back(self._opened.env.env)  # trying new cameras took the old ones away
            if isinstance(error.__cause__, Interrupted):
                self._drop_steps()
            self._send(Failed(error.problem, kept=self._opened is not None))
            return
        # From here on it is one thing: an interrupt in the middle would leave the page with another task than ours.
        with self._interrupts.shielded():
            self._take_over(opened, report, request)

    def _take_over(self, opened: OpenedTask, report: ReloadReport | None, request: Load) -> None:
        before, self._opened = self._opened, opened
        self._loaded_by, self._last = request, opened.first
        if report is None or report.level not in ("same", "patched"):
            self._placed.forget()
        if report is not None and report.level in SCENE_KEPT:
            self._look_through(self._watch)
            self._pictures.scene_changed(self._steps.number)
            # The meshes are 9 MB for a Panda, and the server has them: 0.2 s on a reload's way to the page.
            unchanged = replace(opened.description.geometry, visuals=())
            description = replace(opened.description, geometry=unchanged)
            self._send(Loaded(description, opened.first, opened.milliseconds, report))
            return
        self._pacer = Pacer(opened.env.control_dt, self._pacer.speed)
        if report is None or not report.carried:
            self._acting.seed(request.options.seed)
        self._rate.clear()
        self._acting.sliders = ()
        self._look_through(self._watch)
        self._steps.new_scene()
        self._send(Loaded(opened.description, opened.first, opened.milliseconds, report))
        # The past begins with the reset, and what a first step is taken back to is this.
        self._send_step(opened.first, np.ones(opened.env.num_envs, bool), opened.env.episode_seeds)
        if before is not None:
            before.env.close()

    def _warm_up(self, request: WarmUp) -> None:
        began = time.monotonic()
        warm_up(request.options, lambda: not self._connection.poll(0))
        self._send(WarmedUp(time.monotonic() - began))

    def _play(self, request: Play) -> None:
        self._playing = request.playing and self._opened is not None
        self._pacer.start(time.monotonic())
        self._rate.clear()
        self._send_status(None)

    def _reset(self, request: Reset) -> None:
        if self._opened is None:
            return
        # The random actions start again with the seed, or "reset" would not repeat an episode.
        if request.seed is not None:
            self._acting.seed(request.seed)
        count = 0 if request.env_idx is None else len(request.env_idx)
        seed = self._acting.fresh_seeds(count) if request.seed is None and count else request.seed
        self._guarded(lambda opened: self._reset_envs(opened, request.env_idx, seed))

    def _set_speed(self, request: SetSpeed) -> None:
        self._pacer.speed = request.speed
        self._pacer.start(time.monotonic())

    def _set_episode_end(self, request: SetEpisodeEnd) -> None:
        self._episode_end = request.rule

    def _set_action_source(self, request: SetActionSource) -> None:
        try:
            beside = None if request.beside is None else Path(request.beside)
            self._acting.use(request.source, request.policy, beside)
        except TaskError as error:
            if isinstance(error.__cause__, Interrupted):
                self._drop_steps()
            # Before a task is loaded it would pass for a failure of the load; the first step says it.
            if self._opened is not None:
                self._fail(error.problem)

    def _set_sliders(self, request: SetSliders) -> None:
        self._acting.sliders = request.action

    def _watch_cameras(self, request: WatchCameras) -> None:
        # The server says it again after every load, when the first picture is under way already.
        if request != self._watch:
            self._look_through(request)

    def _look_through(self, request: WatchCameras) -> None:
        self._watch = request
        self._settle()
        if self._opened is None:
            return
        known = {(camera.name, camera.kind) for camera in self._opened.description.cameras}
        wanted: list[PictureRequest] = [
            (c.name, c.kind, c.modalities) for c in request.cameras if (c.name, c.kind) in known
        ]
        self._pictures.watch(min(request.env, self._opened.env.num_envs - 1), wanted)

    def _answer_about_camera(self, question: CameraQuestion) -> None:
        if self._opened is None:
            self._send(CameraQuestionFailed(question.number, "no task is loaded"))
            return
        self._settle()
        self._pulse.begin("drawing")
        told = answer(
            self._opened, self._placed, question, self._send, lambda: bool(self._connection.poll(0))
        )
        self._pulse.begin("idle")
        self._send(told)

    def _place_camera(self, request: PlaceCamera) -> None:
        # Not at once: the picture under way is finished first, or a drag faster than the renderer would see none.
        self._to_place.pop(request.key, None)
        self._to_place[request.key] = request

    def _place_cameras(self) -> None:
        """Those that wait. No picture may be under way."""
        wanted, self._to_place = self._to_place, {}
        for request in wanted.values():
            if self._opened is not None:
                self._send(self._placed_as(self._opened, request))

    def _placed_as(self, opened: OpenedTask, request: PlaceCamera) -> Placed:
        key, env = request.key, opened.env.env
        try:
            with self._interrupts.shielded():
                reshaped = self._placed.place(env, key, request.settings)
        except (ValueError, RuntimeError) as error:
            return Placed(key, request.settings, None, why_not=str(error))
        said = {c.key: c for c in opened.description.cameras}
        infos = tuple(
            replace(info, settings=before.settings, varies=before.varies, site=before.site)
            for info in list_cameras(env, opened.env.table)
            if (before := said.get(info.key)) is not None
        )
        self._opened = replace(opened, description=replace(opened.description, cameras=infos))
        self._pictures.scene_changed(self._steps.number)
        self._pictures.hurry(key)
        if reshaped and key[0] == "sensor" and opened.env.observes_pictures:
            self._guarded(self._observe_again)
        info = next((info for info in infos if info.key == key), None)
        return Placed(key, request.settings, info, reshaped)

    def _observe_again(self, opened: OpenedTask) -> None:
        """A policy must not be given pictures of the size that was."""
        with blamed("step", opened.loaded, opened.env):
            opened.env.judge()
        keep_observation_space(opened.env.env, opened.env.obs)

    def _settle(self) -> None:
        """The scene is about to be drawn or built otherwise: what is under way ends, and cameras stand as asked."""
        self._pictures.settle()
        self._place_cameras()

    def _set_capture(self, request: SetCapture) -> None:
        self._steps.capture(request.env_idx, request.from_reset)

    def _restore(self, request: Restore) -> None:
        self._guarded(lambda opened: self._restore_envs(opened, request))

    def _step_back(self, request: StepBack) -> None:
        self._guarded(lambda opened: self._into_recording(opened, request))

    def _draw_past(self, request: DrawPast) -> None:
        if self._opened is None:
            return
        self._settle()  # its cameras and bodies are about to be drawn elsewhere
        wanted: list[PictureRequest] = [(c.name, c.kind, c.modalities) for c in request.cameras]
        try:
            pictures = take_pictures(self._opened.env.env, request.env, wanted, request.poses)
        except (RuntimeError, ValueError, IndexError) as error:
            self._fail(problem_from_exception(error, "pictures", self._opened.loaded.source_files))
            return
        self._send(PastPictures(request.origin, pictures))

    def _inspect(self, request: Inspect) -> None:
        # The page asked while another version, with fewer envs, was on its way.
        if self._opened is not None and request.env < self._opened.env.num_envs:
            self._send(inspect_env(self._opened.env, request.env, request.sections))

    def _judge_moments(self, request: JudgeMoments) -> None:
        if self._opened is not None:
            self._send(judge_moments(self._opened, request))

    def _rescore(self, request: Rescore) -> None:
        if self._opened is not None:
            rescore_run.answer(self._opened, request, self._send)

    def _capture_moments(self, request: CaptureMoments) -> None:
        def capture(opened: OpenedTask) -> None:
            self._settle()  # the same scene is about to be drawn
            self._send(capture_moments(opened, request))

        self._guarded(capture)

    def _stop(self, request: Quit) -> None:
        self._quit = True

    # --- stepping ----------------------------------------------------------------------------------

    def _control_step(self) -> None:
        self._guarded(self._step_once)

    def _guarded(self, do: Callable[[OpenedTask], None]) -> None:
        if self._opened is None:
            return
        try:
            do(self._opened)
        except TaskError as error:
            left = isinstance(error.__cause__, Interrupted)
            if left:
                self._drop_steps()
            self._fail(error.problem)
            if left:
                self._back_to_the_moment()

    def _fail(self, problem: Problem) -> None:
        self._playing = False
        self._send(Failed(problem, kept=self._opened is not None))
        self._send_status(None)

    def _step_once(self, opened: OpenedTask) -> None:
        if opened.env.observes_pictures:
            self._settle()  # the observation is about to draw the same scene
        step = step_checked(opened.env, opened.loaded, self._acting.next_action(opened.env))
        self._rate.tick(time.monotonic())
        self._send_step(step, np.zeros(opened.env.num_envs, bool))
        ended = np.flatnonzero(step.terminated | step.truncated)
        if len(ended) == 0:
            return
        if self._episode_end == "reset":
            self._reset_envs(opened, tuple(int(i) for i in ended), self._acting.fresh_seeds(len(ended)))
        elif self._episode_end == "pause":
            self._playing = False
            self._send_status(None)

    def _reset_envs(
        self, opened: OpenedTask, env_idx: tuple[int, ...] | None, seed: int | list[int] | None
    ) -> None:
        self._pictures.settle()  # a reset may build the scene anew
        step = reset_checked(opened.env, opened.loaded, seed, env_idx)
        self._placed.put_back(opened.env.env)
        mask = np.ones(opened.env.num_envs, bool)
        if env_idx is not None:
            mask[:] = False
            mask[list(env_idx)] = True
        self._send_step(step, mask, seeds=opened.env.episode_seeds)

    def _restore_envs(self, opened: OpenedTask, request: Restore) -> None:
        self._pictures.settle()  # the envs get new scenes, with the same entities
        snapshot = pickle.loads(request.snapshot)
        step, report = restore_checked(opened.env, opened.loaded, snapshot, request.env_idx, request.source)
        mask = np.zeros(opened.env.num_envs, bool)
        mask[list(request.env_idx)] = True
        did = Restored(request.env_idx, request.source, request.origin, request.undoes, report.not_carried)
        self._send_step(step, mask, opened.env.episode_seeds, did)

    def _into_recording(self, opened: OpenedTask, request: StepBack) -> None:
        self._settle()
        told = time.monotonic()

        def tell(done: int) -> None:
            nonlocal told
            if time.monotonic() - told > _STATUS_PERIOD:
                told = time.monotonic()
                self._send_status(None, going_there(request, done))

        try:
            step, restored = step_back(opened, request, tell)
        except TaskError:
            self._back_to_the_moment()
            raise
        finally:
            self._placed.put_back(opened.env.env)
        mask = np.zeros(opened.env.num_envs, bool)
        mask[list(request.env_idx)] = True
        self._send_step(step, mask, opened.env.episode_seeds, restored)
        self._send_status(None)

    def _send_step(
        self,
        step: StepResult,
        reset_mask: np.ndarray,
        seeds: np.ndarray | None = None,
        restored: Restored | None = None,
    ) -> None:
        assert self._opened is not None
        self._last = step
        if self._steps.pictures_due(step, reset_mask):
            self._settle()  # the same scene is about to be drawn
        event = self._steps.event(self._opened, step, reset_mask, seeds, restored)
        self._pictures.scene_changed(event.number)
        self._send(event)

    # --- pictures and status -----------------------------------------------------------------------

    def _make_pictures(self) -> None:
        if self._opened is None or self._pictures.wait(time.monotonic()) is None:
            return
        if not self._renderer_ready and self._pictures.idle:
            # The first picture of a process compiles the shaders: 5 to 19 s on a software renderer.
            self._send_status(None, "compiling the renderer's shaders, once")
        self._pulse.begin("drawing")
        self._pictures.nothing_else_to_do = not self._playing
        try:
            made = self._pictures.poll(self._opened.env, time.monotonic())
        except RuntimeError as error:
            self._watch = WatchCameras(0, ())
            self._pictures.watch(0, ())
            self._fail(problem_from_exception(error, "pictures", self._opened.loaded.source_files))
            return
        if made is None:
            return
        pictures, seconds = made
        self._send(Pictures(pictures, 1000 * seconds, tuple(self._pictures.moments)))
        if not self._renderer_ready:
            self._renderer_ready = True
            self._pacer.start(time.monotonic())
            self._send_status(None)

    def _send_status(self, now: float | None, activity: str = "") -> None:
        """Every quarter of a second while playing, or at once when `now` is None."""
        moment = time.monotonic()
        if now is not None and (not self._playing or now - self._status_sent < _STATUS_PERIOD):
            return
        self._status_sent = moment
        steps = self._rate.per_second(moment) if self._playing else 0.0
        self._send(Status(self._playing, steps, steps * self._pacer.control_dt, activity))


_DOING: dict[type, Doing] = {
    Load: "loading",
    SingleStep: "stepping",
    Reset: "resetting",
    Restore: "resetting",
    StepBack: "resetting",
    SetActionSource: "importing the policy",
    WarmUp: "warming up",
}
"""The requests that may run the author's code, or take long for other reasons."""
_STAGE: dict[Doing, str] = {"loading": "build", "stepping": "step", "resetting": "reset"}


def work(connection: int, pulse: PulseWriter) -> None:
    """The life of the process; `connection` is the file descriptor of its end of the socket pair."""
    # The tensors hold a few thousand numbers: threads over them only wait for each other (measured:
    # 16 PickCube envs ran 2.8 times faster with one thread than with two).
    torch.set_num_threads(1)
    # BaseEnv collects garbage at every build and close, and would look through torch's and ManiSkill's modules
    # each time: 0.25 s, most of a reload of 16 envs.
    gc.collect()
    gc.freeze()
    note_camera_sites()
    Worker(Connection(connection), pulse).run()
