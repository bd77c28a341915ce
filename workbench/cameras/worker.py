"""Draws, places and measures the cameras of the worker's envs, and answers questions about them."""

from __future__ import annotations

import ast
import os
import pickle
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

from workbench.cameras.edit.hook_cameras import HookCameras
from workbench.cameras.edit.run_hooks import run_hooks
from workbench.cameras.questions import CameraQuestion, DrawCamera, MeasureCamera, RunCameras
from workbench.envs import maniskill_private
from workbench.envs.camera_data import CameraKey, CameraSettings, Picture, PictureDegree
from workbench.envs.cpu_scene import BatchedCpuScene
from workbench.envs.hot_swap import keep_observation_space, put_class, undone
from workbench.envs.rendering.drawing import CannotDraw
from workbench.envs.rendering.fast_shapes import unknown_meshes
from workbench.envs.scene.mesh_levels import levels_of
from workbench.envs.scene.shapes import Mesh
from workbench.envs.state_columns import read_state_columns
from workbench.envs.task_env import TaskEnv
from workbench.live.messages import (
    CameraFailed,
    CameraRequest,
    CannotAnswer,
    DrawPast,
    PastPictures,
    Pictures,
    PlaceCamera,
    Placed,
)
from workbench.live.worker.guarded_task import GuardedTask
from workbench.live.worker.pacing import throttled
from workbench.pictures.camera_report import CameraReport
from workbench.pictures.camera_search import suggest_cameras
from workbench.pictures.placed_cameras import PlacedCameras
from workbench.pictures.render import (
    KINDS,
    PendingPictures,
    begin_pictures,
    list_cameras,
    recorded_pictures,
    step_pictures,
    take_pictures,
)
from workbench.pictures.visibility import Placement, measure_placement, picture_of, placement_of, small_size
from workbench.record.questions import Captured, CaptureMoment
from workbench.source.definitions import Project
from workbench.source.parsed import plain_line_ends
from workbench.source.read_values import classes_of, module_of
from workbench.task.blame import blamed
from workbench.task.description import ShownPictures
from workbench.task.load import LoadedTask, load_task, undo_load
from workbench.task.open import OpenedTask
from workbench.task.problem import problem_from_exception
from workbench.task.reference import reference_to_class

_PERIOD_SECONDS = 1 / 15
_PAUSE_SHARE = 0.3
"""Length of the pause after a round, as a share of the round's time."""
SIMPLIFYING = "simplified meshes"
"""Name of the thread that makes simplified meshes."""
_EXACT_DELAY_SECONDS = 0.3
"""Time after the last fast picture until an exact one is drawn, if nothing moves."""


@dataclass(frozen=True)
class _Begun:
    """Pictures of one kind that the renderer is drawing."""

    pictures: PendingPictures
    requested: tuple[CameraRequest, ...]
    number: int
    """Number of the moment that the pictures show."""
    at: float
    ready_at: float
    """Time at which the pictures should be ready. `at` is the time at which they were begun; both are in
    seconds of `time.monotonic`."""


class WorkerCameras:
    """The cameras of the open task: pictures for the page, placements, and questions.

    All pictures share one scene and one renderer, which has its own threads. So before anything else draws or changes the
    scene, `settle` finishes the current picture and places the waiting cameras.

    A picture takes 25 to 90 ms on a software renderer; drawn synchronously between two steps it would halve the step rate.
    So a picture is started (see `begin_pictures`), steps continue, and the picture is fetched when it should
    be ready, as estimated from the last pictures. Sensors and human cameras see different objects and so
    cannot be drawn together: the sensors come first, and the pictures of each kind are sent as soon as they
    are ready. A round draws all watched cameras once. To leave CPU time for a browser on the same machine,
    there are at most 15 rounds a second, each followed by a pause in proportion to its length. A camera that
    is being dragged is drawn next, alone and without a pause.
    """

    def __init__(self, task: GuardedTask, on_first: Callable[[bool], None]) -> None:
        """
        Args:
            on_first: called with False before the first picture of the process, and with True when it is ready.
        """
        self._task, self._on_first = task, on_first
        self._watched: tuple[int, tuple[CameraRequest, ...]] = 0, ()
        """The env and the cameras that the page shows."""
        self._there: tuple[CameraRequest, ...] = ()
        """The watched cameras that the loaded version has."""
        self._wanted = False
        """Whether the pictures of the watched cameras are out of date."""
        self._hurried: set[CameraKey] = set()
        """Watched cameras that were just placed: the next round draws only these, without a pause."""
        self._left: list[tuple[CameraRequest, ...]] = []
        """Groups of cameras, one per kind, that this round has not begun to draw."""
        self._begun: _Begun | None = None
        self._expected: dict[tuple[CameraRequest, ...], float] = {}
        """Expected render time of pictures, in seconds."""
        self._round_began = self._next_round = 0.0
        self._round_degree: PictureDegree = "exact"
        self._may_block = False
        """Whether the loop may block until a picture is ready, because no step is due."""
        self._degree: ShownPictures = "exact"
        self._exact_at: float | None = None
        """Time at which the shown fast pictures are redrawn exactly; None if no exact pictures are due."""
        self._fast_scene: Any = None
        """Scene for which `_simplifying` makes, or has made, the missing simplified meshes. Until they are
        made, pictures are exact."""
        self._may_be_fast = False
        self._simplifying = threading.Thread()
        self._placed = PlacedCameras()
        self._to_place: dict[CameraKey, PlaceCamera] = {}
        self._renderer_ready = False

    # --- requests ------------------------------------------------------------------------------------

    def watch(self, env: int, cameras: tuple[CameraRequest, ...], degree: ShownPictures = "exact") -> None:
        # Called for every `Settings` message, whether or not it changes the cameras.
        before, of_degree = self._watched, self._degree
        self._watched, self._degree = (env, cameras), degree
        # On a change from exact to auto, finished and pending pictures stay valid: if they were redrawn, the
        # page would show fast pictures for a moment.
        stay = degree == of_degree or (of_degree == "exact" and degree == "auto")
        if before != (env, cameras) or not stay:
            self.update_watched()

    def place(self, request: PlaceCamera) -> None:
        # Not placed at once: if each placement interrupted the current picture, a drag that is faster than
        # the renderer would never show a picture.
        self._to_place.pop(request.key, None)
        self._to_place[request.key] = request

    def place_now(self, opened: OpenedTask, request: PlaceCamera) -> Placed:
        self.settle()
        return self._place(opened, request)

    def answer(
        self, opened: OpenedTask, question: CameraQuestion, on_progress: Callable[[int, int], None]
    ) -> object:
        self.settle()
        self._task.heartbeat.begin("drawing")
        try:
            return answer_question(opened, self._placed, question, on_progress, self._task.line.waits)
        except (ValueError, IndexError, RuntimeError) as error:
            raise CannotAnswer(str(error)) from error
        finally:
            self._task.heartbeat.begin("idle")

    def draw_past(self, request: DrawPast) -> None:
        opened = self._task.opened
        if opened is None:
            return
        self.settle()  # the same scene is about to be drawn
        try:
            pictures = take_pictures(opened.env.env, request.env, request.cameras, request.poses)
        except CannotDraw as error:
            self.failed(error)
            return
        except (RuntimeError, ValueError, IndexError) as error:
            self._task.fail(problem_from_exception(error, "pictures", opened.loaded.source_files))
            return
        self._task.line.send(PastPictures(request.origin, pictures))

    def capture(self, opened: OpenedTask, request: CaptureMoment) -> Captured:
        """Restore the envs to a past moment and read data that the history lacks: env states, observations and pictures.

        Raises:
            TaskError: one of the author's hooks raised.
        """
        self.settle()  # the same scene is about to be drawn
        with blamed("restore", opened.loaded, opened.env):
            # Restore all envs: restoring a few would leave out the task's batch-wide state and the process's
            # random generators. No step follows, so the physics needs no fresh scene.
            opened.env.restore(pickle.loads(request.snapshot), fresh_physics=False)
            columns = read_state_columns(opened.env)
        wanted = recorded_pictures(opened.description.cameras) if request.pictures else ()
        drawn: list[Picture] = []
        for env in request.env_idx:
            if self._task.line.waits():
                raise CannotAnswer("it was cancelled")
            try:
                drawn += step_pictures(opened.env, [env], wanted)
            except CannotDraw as error:
                raise CannotAnswer(str(error)) from error
        return Captured(columns, tuple(drawn))

    # --- changes of the scene ------------------------------------------------------------------------

    def update_watched(self) -> None:
        """Watch the requested cameras that the version has; call it when the request or the version may have
        changed."""
        self.settle()
        opened = self._task.opened
        if opened is None:
            return
        known = {camera.key for camera in opened.description.cameras}
        self._watch(tuple(camera for camera in self._watched[1] if camera.key in known))

    def _watch(self, cameras: tuple[CameraRequest, ...]) -> None:
        self._there, self._wanted = cameras, bool(cameras)
        self._exact_at = None
        self._hurried.clear()
        self._expected.clear()
        self._next_round = 0.0  # the user waits for these

    def scene_changed(self) -> None:
        """Mark the pictures as out of date."""
        self._wanted = bool(self._there)

    def settle(self) -> None:
        """Finish the current picture and place the waiting cameras; call it before anything else draws the scene."""
        self.finish_picture()
        self.place_waiting()

    def finish_picture(self) -> None:
        """Finish and discard the current picture; it is drawn again later. Call this before the envs move."""
        begun, self._begun = self._begun, None
        if begun is not None:
            self._left, self._wanted = [], bool(self._there)
            try:
                begun.pictures.finish()
            except CannotDraw as error:
                self.failed(error)

    def failed(self, error: CannotDraw) -> None:
        """Stop watching a camera that cannot be drawn, and report it."""
        self._begun, self._left = None, []
        self._there = tuple(camera for camera in self._there if camera.key != error.key)
        self._hurried.discard(error.key)
        self._wanted = bool(self._there)
        self._task.line.send(CameraFailed(error.key, str(error)))

    def put_back(self) -> None:
        """Place the placed cameras again; call it when the scene's cameras may have been rebuilt."""
        if self._task.opened is not None:
            self._placed.put_back(self._task.opened.env.env)

    @property
    def placed(self) -> dict[CameraKey, CameraSettings]:
        """Settings of each camera that was placed by hand."""
        return self._placed.all

    def forget_placed(self) -> None:
        """Drop all placements, because the cameras belong to another version."""
        self._placed.forget()

    # --- called by the loop --------------------------------------------------------------------------

    def wait(self, now: float) -> float | None:
        """Seconds until `make` has something to do; None if there is nothing to draw."""
        if self._task.opened is None:
            return None
        if self._begun is not None:
            return 0.0 if self._may_block else max(0.0, self._begun.ready_at - now)
        if self._hurried:
            return 0.0
        if self._wanted:
            return max(0.0, self._next_round - now)
        return None if self._exact_at is None else max(0.0, self._exact_at - now)

    @property
    def placing_due(self) -> bool:
        return bool(self._to_place) and self._begun is None

    def place_waiting(self) -> None:
        """Place the waiting cameras. No picture may be in progress."""
        wanted, self._to_place = self._to_place, {}
        for request in wanted.values():
            if self._task.opened is not None:
                self._task.line.send(self._place(self._task.opened, request))

    def make(self, may_block: bool) -> None:
        """Fetch a picture that is ready and start the next."""
        self._may_block = may_block
        opened, wait = self._task.opened, self.wait(time.monotonic())
        if opened is None or wait is None or wait > 0:
            return
        if not self._renderer_ready and self._begun is None:
            # The first picture of a process takes longer, since its shaders are compiled.
            self._on_first(False)
        self._task.heartbeat.begin("drawing")
        try:
            made = None if self._begun is None else self._fetch(self._begun)
            if made is None:
                self._begin_round(opened.env)
            self._begin(opened.env)
        except CannotDraw as error:
            self.failed(error)
            return
        except RuntimeError as error:
            self._watch(())  # until other cameras are requested, or another version is loaded
            self._task.fail(problem_from_exception(error, "pictures", opened.loaded.source_files))
            return
        if made is None:
            return
        self._task.line.send(made)
        if not self._renderer_ready:
            self._renderer_ready = True
            self._on_first(True)

    # --- private -------------------------------------------------------------------------------------

    def _begin_round(self, env: TaskEnv) -> None:
        self._round_degree = self._degree_of_round(env)
        chosen = tuple(camera for camera in self._there if camera.key in self._hurried) or self._there
        self._wanted = self._wanted and bool(self._hurried)
        self._hurried.clear()
        groups = (tuple(camera for camera in chosen if camera.kind == kind) for kind in KINDS)
        self._left, self._round_began = [group for group in groups if group], time.monotonic()

    def _degree_of_round(self, env: TaskEnv) -> PictureDegree:
        moves = self._wanted or bool(self._hurried)
        self._exact_at = None
        if self._degree == "exact" or (self._degree == "auto" and not moves):
            return "exact"
        return "fast" if self._has_fast(env.env.scene) else "exact"

    def _has_fast(self, scene: Any) -> bool:
        """Whether fast pictures can be drawn now. If the scene is new, starts to make its missing simplified
        meshes on a thread."""
        if scene is not self._fast_scene:
            self._fast_scene, meshes = scene, list[Mesh]()
            # A GPU draws exact pictures just as fast.
            self._may_be_fast = (
                isinstance(scene, BatchedCpuScene) and not scene.sub_scenes[0].render_system.device.is_cuda()
            )
            if self._may_be_fast:
                meshes = unknown_meshes(scene.sub_scenes)
            self._simplifying = threading.Thread(
                target=_simplify, args=(meshes,), name=SIMPLIFYING, daemon=True
            )
            self._simplifying.start()
        return self._may_be_fast and not self._simplifying.is_alive()

    def _fetch(self, begun: _Begun) -> Pictures:
        self._begun, asked_at = None, time.monotonic()
        made = begun.pictures.finish()
        done = time.monotonic()
        # If we waited, the render time is known; if not, the picture was ready earlier, so the estimate shrinks.
        took, waited = done - begun.at, done - asked_at > 0.004
        self._expected[begun.requested] = (
            min(took, 1.0) if waited else 0.9 * self._expected.get(begun.requested, 0.0)
        )
        if not self._left:
            if self._round_degree == "fast" and self._degree == "auto":
                self._exact_at = done + _EXACT_DELAY_SECONDS
            pause = _PAUSE_SHARE * (done - self._round_began)
            self._next_round = max(self._round_began + _PERIOD_SECONDS, done + pause)
        stood_still = begun.number == self._task.steps.number
        return Pictures(made, 1000 * took if stood_still else None, begun.number)

    def _begin(self, env: TaskEnv) -> None:
        """Start the next group of the round, if there is one."""
        if self._left:
            requested = self._left.pop(0)
            selected = min(self._watched[0], env.num_envs - 1)
            pictures = begin_pictures(env.env, selected, requested, degree=self._round_degree)
            at = time.monotonic()
            ready_at = at + self._expected.get(requested, 0.0)
            self._begun = _Begun(pictures, requested, self._task.steps.number, at, ready_at)

    def _place(self, opened: OpenedTask, request: PlaceCamera) -> Placed:
        key, env = request.key, opened.env.env
        try:
            with self._task.interrupts.shielded():
                reshaped = self._placed.place(env, key, request.settings)
        except (ValueError, RuntimeError) as error:
            return Placed(key, request.settings, None, why_not=str(error))
        described = {c.key: c for c in opened.description.cameras}
        infos = tuple(
            replace(info, settings=before.settings, varies=before.varies, site=before.site)
            for info in list_cameras(env)
            if (before := described.get(info.key)) is not None
        )
        self._task.opened = replace(opened, description=replace(opened.description, cameras=infos))
        self.scene_changed()
        if reshaped and isinstance(env.scene, BatchedCpuScene):
            env.scene.forget_fast_shapes()  # the simplified shapes are for pictures of another size
        # The user moves this camera: if it is watched, its picture comes first.
        self._hurried |= {key} & {camera.key for camera in self._there}
        if reshaped and key[0] == "sensor" and opened.env.observes_pictures:
            self._task.guarded(_observe_again)
        info = next((info for info in infos if info.key == key), None)
        return Placed(key, request.settings, info, reshaped)


def _simplify(meshes: Sequence[Mesh]) -> None:
    """Simplify meshes. Runs on a thread of its own, whose low priority leaves the cores to the simulation."""
    os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 15)
    for mesh in meshes:
        levels_of(mesh)


def _observe_again(opened: OpenedTask) -> None:
    """Recompute the observation; without this, a policy would get pictures of the old size."""
    with blamed("step", opened.loaded, opened.env):
        opened.env.rescore()
    keep_observation_space(opened.env.env, opened.env.obs)


# --- answers to questions; they leave the env unchanged ---------------------------------------------


REPORT_PIXELS = 128
"""Maximum length of the shorter side of a measured picture: what vanishes at this size is hardly visible
anyway."""
MAX_SCALE = 4.0
_PROGRESS_PERIOD_SECONDS = 0.2


def answer_question(
    opened: OpenedTask,
    placed: PlacedCameras,
    question: CameraQuestion,
    on_progress: Callable[[int, int], None],
    cancelled: Callable[[], bool],
) -> object:
    """Answer one question. No picture may be in progress.

    Args:
        on_progress: called with done and total during a long search.
        cancelled: returns whether to end a search early.

    Raises:
        ValueError, IndexError, RuntimeError, TaskError: there is no answer.
    """
    if isinstance(question, DrawCamera):
        return _draw(opened, placed, question)
    if isinstance(question, MeasureCamera):
        return _measure(opened, question)
    if isinstance(question, RunCameras):
        return run_cameras(opened, question)
    progress = throttled(on_progress, _PROGRESS_PERIOD_SECONDS)
    return suggest_cameras(
        opened.env.env, question.space, question.envs, progress=progress, cancelled=cancelled
    )


def _draw_temporary(opened: OpenedTask, placed: PlacedCameras, question: DrawCamera) -> Picture:
    """A picture at another size than the camera's, or of a camera that the env does not have."""
    settings, scale = question.settings, question.scale
    if settings is None or not 0 < scale <= MAX_SCALE:
        raise ValueError(f"a scaled picture needs settings and a scale of at most {MAX_SCALE}, not {scale}")
    size = (max(1, round(settings.width * scale)), max(1, round(settings.height * scale)))
    info = opened.description.camera(question.key)
    placement = Placement(settings, question.key[0], None if info is None else info.mount)
    if (
        info is not None
        and placed.settings(info.key) is None
        and settings == info.settings
        and not info.varies
    ):
        # Take the camera's exact pose from the env: its quaternion may not be of unit length.
        placement = placement_of(opened.env.env, info.key, question.env)
    picture = picture_of(opened.env.env, question.env, placement, question.poses, size)
    wanted = question.modalities
    return replace(
        picture,
        camera=question.key[1],
        depth=picture.depth if "depth" in wanted else None,
        segmentation=picture.segmentation if "segmentation" in wanted else None,
    )


def _draw(opened: OpenedTask, placed: PlacedCameras, question: DrawCamera) -> Picture:
    env, key = opened.env.env, question.key
    if question.scale != 1.0 or opened.description.camera(key) is None:
        return _draw_temporary(opened, placed, question)
    before = placed.settings(key)
    if question.settings is not None:
        placed.place(env, key, question.settings)
    try:
        info = opened.description.camera(key)
        gives = question.modalities if info is None else info.modalities
        wanted = tuple(m for m in question.modalities if m in gives)
        return take_pictures(env, question.env, [(key[1], key[0], wanted)], question.poses)[0]
    finally:
        if question.settings is not None:
            placed.place(env, key, before)


def _measure(opened: OpenedTask, question: MeasureCamera) -> CameraReport:
    env = opened.env.env
    placement = placement_of(env, question.key, question.env, question.settings)
    size = small_size(placement.settings.width, placement.settings.height, REPORT_PIXELS)
    return measure_placement(env, question.env, placement, question.poses, size)


# --- hooks with another text -----------------------------------------------------------------------


def run_cameras(opened: OpenedTask, question: RunCameras) -> HookCameras:
    """Call the camera hooks on the live env, which temporarily gets the new text's classes.

    Raises:
        TaskError: the text does not load, or a hook fails.
    """
    file, env, found = opened.loaded.file, opened.env.env, list[HookCameras]()
    if file is None:
        raise ValueError("the task has no file")
    loaded = load_task(reference_to_class(question.task, file, opened.loaded.chosen), source=question.texts)
    try:
        with (
            blamed("build", loaded, opened.env),
            _with_classes_of(env, opened.loaded, loaded, question.texts),
        ):
            undone(env, lambda: found.append(run_hooks(env, question.texts)))
    finally:
        undo_load(loaded)
    return found[0]


@contextmanager
def _with_classes_of(
    env: Any, before: LoadedTask, after: LoadedTask, texts: Mapping[str, str]
) -> Iterator[None]:
    """Context in which the env and its robots have the classes of the new texts, and the new values of the
    attributes that the new texts change."""
    agents = [] if env.agent is None else getattr(env.agent, "agents", [env.agent])
    classes = [(agent, type(agent)) for agent in agents]
    task, kept = maniskill_private.task_class(env), [(owner, dict(vars(owner))) for owner in (env, *agents)]
    try:
        put_class(env, after.cls)
        for agent, cls in classes:
            module = sys.modules.get(cls.__module__)
            if getattr(module, "__file__", None) in texts:
                agent.__class__ = getattr(module, cls.__qualname__, cls)
        for owner, _ in kept:
            for name, value in _changed_attributes(before.source, texts, owner).items():
                vars(owner)[name] = value
        yield
    finally:
        put_class(env, task)
        for agent, cls in classes:
            agent.__class__ = cls
        for owner, names in kept:
            vars(owner).clear()
            vars(owner).update(names)


def _changed_attributes(before: Mapping[str, str], after: Mapping[str, str], owner: Any) -> dict[str, Any]:
    """The attributes of `owner` that the new text sets to another value, with the new values.

    A live env has the attributes that the old text set, and a camera's pose may depend on one of them.
    """
    old, new = Project(before), Project(after)
    edited = [path for path, text in after.items() if before.get(path) != plain_line_ends(text)]
    named = {n.attr for path in edited for n in new.file(path).nodes if isinstance(n, ast.Attribute)}
    found: dict[str, Any] = {}
    for name in named & vars(owner).keys():
        was, stores = (project.attribute_stores(name, classes_of(type(owner))) for project in (old, new))
        if len(was) != 1 or len(stores) != 1 or was[0].value is None or stores[0].value is None:
            continue
        if ast.dump(was[0].value) != ast.dump(stores[0].value):
            path = stores[0].file.path
            code = compile(ast.Expression(stores[0].value), path, "eval")
            found[name] = eval(code, vars(module_of(path)), {"self": owner})
    return found
