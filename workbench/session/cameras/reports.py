"""Cameras looked at with more than one pair of eyes: over all envs, over many seeds, side by side, pixel by pixel.

Every question here is a small job of several requests to a worker (see `questions`). What concerns the moment
on the screen is asked of the worker that plays, one env at a time, so that it goes on playing; what needs fresh
episodes, of another in the background. There is one job of each kind at a time, and a new one takes its place.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from workbench.core.camera_data import CameraInfo, CameraSettings, Picture, why_no_camera
from workbench.core.cameras.conventions import compose
from workbench.core.cameras.report import CameraReport, OfferedPlacement, SearchSpace, join_reports
from workbench.session.cameras.selection import StudioCameras
from workbench.session.cameras.view import Looked, MeasuredMoment, Picked, StudioCamera
from workbench.session.history.history import Shown, ShownMoment
from workbench.session.process.askers import Asker, Background
from workbench.session.process.job_lane import Job, JobFailed, JobLane, JobProgress
from workbench.session.protocol.messages import Load, Reset
from workbench.session.protocol.questions import DrawCamera, MeasureCamera, SuggestCameras

FIRST_SEED = 10_000
"""The same seeds for every judgement, so that two can be compared; others than people begin with."""
MOST_ENVS = 16
"""In the background: more are made of these by resetting them again."""
MOST_SEEDS = 1000
MOST_STEPS = 1000
_TELL_EVERY = 8
"""Steps after which what is known so far is shown."""


Triple = tuple[float, float, float]
Case = tuple[int, NDArray[np.float32] | None, MeasuredMoment | None]
"""Where a camera is judged: the env; (B, 7) its bodies, None for now; which moment of the past that is."""


class CameraReports:
    """Thread-safe; every method returns at once."""

    def __init__(
        self,
        cameras: StudioCameras,
        asker: Asker,
        background: Background,
        on_change: Callable[[], None],
        past: Shown,
        load: Callable[[], Load | None],
    ) -> None:
        """
        Args:
            asker, background: ask the worker that plays, and the one in the background.
            on_change: called, on any thread, when there is something new.
            past: says which moment the page shows.
            load: how another worker gets the version that runs; None before there is one.
        """
        self._cameras, self._past, self._load, self._on_change = cameras, past, load, on_change
        self._lock = threading.Lock()
        self._looked = Looked()
        self._live, self._background = asker, background
        self._live_lane = JobLane("studio-live", on_change, self._failed)
        self._background_lane = JobLane("studio-background", on_change, self._failed)

    # --- what is known -------------------------------------------------------------------------------

    @property
    def looked(self) -> Looked:
        with self._lock:
            return self._looked

    @property
    def progress(self) -> JobProgress | None:
        return self._background_lane.progress or self._live_lane.progress

    # --- jobs ------------------------------------------------------------------------------------------

    def measure(self, seeds: int = 0) -> None:
        """Judge the selected camera as it is placed over all envs.

        Args:
            seeds: 0 for the envs at the shown moment; else over so many freshly reset ones, in the background; what is
                known so far can be seen all the while.
        """
        camera = self._asked_for()
        if camera is not None and seeds <= 0:
            moment = self._past.shown_moment()
            cases: list[Case] = [(env, moment.of(env), None) for env in range(moment.num_envs)]
            self._measure_live("in all envs", camera, cases, len(cases))
        elif camera is not None and (load := self._load()) is not None:
            self._measure_seeds(camera, load, min(seeds, MOST_SEEDS))

    def measure_steps(self, most: int = MOST_STEPS) -> None:
        """Judge the selected camera as it is placed over the steps of the episode that the selected env is in; what is
        known so far can be seen all the while.

        Args:
            most: how many of them, evenly spread.
        """
        camera = self._asked_for()
        moments = self._past.episode_moments(min(max(1, most), MOST_STEPS))
        if camera is not None and moments:
            cases: list[Case] = [
                (env, step.poses[env], MeasuredMoment(moment.serial, env, int(step.elapsed_steps[env])))
                for moment, env in moments
                for step in [moment.step]
            ]
            self._measure_live(f"over {len(moments)} steps", camera, cases, _TELL_EVERY)

    def _measure_live(self, over: str, camera: StudioCamera, cases: Sequence[Case], every: int) -> None:
        def work(job: Job) -> None:
            with self._measuring():
                question = MeasureCamera(camera.key, None, 0)
                self._measure(job, self._live, question, camera.now, [], cases, len(cases), every)

        self._live_lane.start(f"judging {camera.key[1]} {over}", work)

    def _measure_seeds(self, camera: StudioCamera, load: Load, seeds: int) -> None:
        question = MeasureCamera(camera.key, camera.now if camera.moved else None, 0)

        def work(job: Job) -> None:
            reports: list[CameraReport] = []

            def measure() -> None:
                """From where it gave way."""
                num_envs = self._background.ensure(job, _for_measuring(load))

                def cases() -> Iterator[Case]:
                    for seed in range(begun := len(reports), seeds):
                        if (env := seed % num_envs) == 0 or seed == begun:
                            self._background.ask(job.check, Reset(None, FIRST_SEED + seed - env))
                        yield env, None, None

                self._measure(
                    job, self._background, question, camera.now, reports, cases(), seeds, num_envs, fresh=True
                )

            with self._measuring():
                self._background.in_turns(job, measure)

        self._background_lane.start(f"judging {camera.key[1]} over {seeds} seeds", work)

    def _measure(
        self,
        job: Job,
        asker: Asker,
        question: MeasureCamera,
        now: CameraSettings | None,
        reports: list[CameraReport],
        cases: Iterable[Case],
        total: int,
        every: int,
        fresh: bool = False,
    ) -> None:
        """
        Args:
            question: but for where.
            now: how the camera stands.
            reports: of the cases before; gets those of `cases`.
            every: cases after which what is known so far is shown.
            fresh: the cases are fresh episodes.
        """
        moments: list[MeasuredMoment] = []
        for env, poses, moment in cases:
            job.report(len(reports), total)
            reports.append(asker.ask(job.check, replace(question, env=env, poses=poses)))
            moments += [] if moment is None else [moment]
            if len(reports) % every == 0 or len(reports) == total:
                self._know(
                    report=join_reports(reports),
                    report_of=question.key,
                    report_settings=now,
                    report_seeds=len(reports) if fresh else 0,
                    report_moments=tuple(moments),
                    outdated=False,
                    measuring=False,
                )

    def suggest(self, objects: Sequence[str], low: Triple, high: Triple, seeds: int) -> None:
        """Search placements of the selected camera that see these objects over so many fresh episodes, or as many as
        there are envs.

        Args:
            objects: names of objects, or of single links of them (``TaskDescription.objects``).
            low, high: corners of the box for the eye; metres, in the frame of the camera's mount, or the env's.
        """
        camera, load = self._asked_for(), self._load()
        if camera is not None and camera.now is None:
            self._say(f"{camera.key[1]} cannot be placed: {camera.refused}.")
        if camera is None or camera.now is None or load is None:
            return
        key = camera.key
        space = SearchSpace(tuple(objects), low, high, camera.now, key[0], mount=camera.info.mount)
        what = f"searching places for {key[1]}"

        def work(job: Job) -> None:
            def search() -> tuple[OfferedPlacement, ...]:
                num_envs = self._background.ensure(job, _for_measuring(load))
                self._background.ask(job.check, Reset(None, FIRST_SEED))
                envs = tuple(range(min(max(1, seeds), num_envs)))
                job.report(0, 0, what)
                return self._background.ask(
                    job.check,
                    SuggestCameras(space, envs),
                    lambda done, total, part: job.report(done, total, what),
                )

            self._know(suggestions=(), suggestions_of=key)
            found = self._background.in_turns(job, search)
            problem = "" if found else f"no place in that box sees {' and '.join(objects)} in any env."
            self._know(suggestions=found, problem=problem)

        self._background_lane.start(what, work)

    def compare(self, other: CameraSettings) -> None:
        """Two pictures of the shown env: the selected camera as it is placed, and as it would be with other settings."""
        camera = self._asked_for()
        if camera is None:
            return
        key, moment, why_not = camera.key, self._past.shown_moment(), camera.refused or why_no_camera(other)

        def work(job: Job) -> None:
            now, then = (
                self._draw(job, moment, DrawCamera(key, settings, moment.env)) for settings in (None, other)
            )
            self._know(compared=(now, then))

        if why_not:
            self._say(f"{key[1]} is not compared: {why_not}.")
        else:
            self._live_lane.start(f"comparing two placements of {key[1]}", work)

    def make_sheet(self) -> None:
        """The selected camera's pictures of all envs, as they come; worst first if it was judged over them."""
        camera = self._asked_for()
        if camera is None:
            return
        key = camera.key
        moment, report = self._past.shown_moment(), self.looked.report_over_envs(key)
        order = list(range(moment.num_envs))
        if report is not None:
            measured = [report.envs[i] for i in report.worst_first()]
            order = measured if sorted(measured) == order else order

        def work(job: Job) -> None:
            self._know(sheet=())
            for done, env in enumerate(order):
                job.report(done, len(order))
                picture = self._draw(job, moment, DrawCamera(key, None, env))
                self._know(sheet=(*self.looked.sheet, picture))

        self._live_lane.start(f"taking pictures by {key[1]} of all envs", work)

    def pick(self, u: float, v: float) -> None:
        """What is seen at a place of its picture: 0, 0 is the upper left corner, 1, 1 the lower right one."""
        camera, task, moment = self._asked_for(), self._cameras.task, self._past.shown_moment()
        if camera is None or task is None:
            return

        def work(job: Job) -> None:
            question = DrawCamera(camera.key, None, moment.env, ("depth", "segmentation"))
            picture = self._draw(job, moment, question)
            self._know(picked=picked(camera.info, picture, u, v, task.segmentation))

        self._live_lane.start("looking closely", work)

    def stop(self) -> None:
        """Stop all that is under way; what is known stays."""
        self._live_lane.stop()
        self._background_lane.stop()
        self._on_change()

    def outdate(self) -> None:
        """Another version runs: what was seen is of the one before. Calls nobody."""
        self._live_lane.stop()
        self._background_lane.stop()
        with self._lock:
            self._looked = replace(self._looked, outdated=True, compared=None, picked=None, sheet=())

    def close(self) -> None:
        """End the process in the background."""
        self._live_lane.close()
        self._background_lane.close()

    # --- small things ------------------------------------------------------------------------------------

    def _asked_for(self) -> StudioCamera | None:
        with self._cameras.lock:
            camera = self._cameras.asked_for()
        self._on_change()
        return camera

    def _say(self, problem: str) -> None:
        with self._cameras.lock:
            self._cameras.problem = problem
        self._on_change()

    def _draw(self, job: Job, moment: ShownMoment, question: DrawCamera) -> Picture:
        return self._live.ask(job.check, replace(question, poses=moment.of(question.env)))

    @contextmanager
    def _measuring(self) -> Iterator[None]:
        """What is known from before is said to be that, until there is something new or the work ends."""
        self._know(measuring=True)
        try:
            yield
        finally:
            self._know(measuring=False)

    def _know(self, **values: object) -> None:
        with self._lock:
            self._looked = replace(self._looked, **{"problem": "", **values})  # type: ignore[arg-type]
        self._on_change()

    def _failed(self, job: Job, failure: JobFailed) -> None:
        why = str(failure)
        self._know(problem=f"{why[:1].upper()}{why[1:]}" + ("" if why.endswith(".") else "."))


def _for_measuring(load: Load) -> Load:
    options = load.options
    kwargs = dict(options.env_kwargs)
    if kwargs.get("obs_mode", "state") not in ("state", "state_dict", "none"):
        kwargs["obs_mode"] = "state"  # else every reset draws all cameras of all envs
    envs = min(options.num_envs, MOST_ENVS)
    return replace(load, options=replace(options, num_envs=envs, env_kwargs=kwargs))


def picked(info: CameraInfo, picture: Picture, u: float, v: float, names: dict[int, str]) -> Picked:
    """What a place of a picture shows; `u` and `v` from 0 to 1, from its upper left corner."""
    shape = next(a.shape for a in (picture.depth, picture.segmentation, picture.rgb) if a is not None)
    height, width = shape[:2]
    column = int(np.clip(np.floor(u * width), 0, width - 1))
    row = int(np.clip(np.floor(v * height), 0, height - 1))
    body, depth, point = None, None, None
    if picture.segmentation is not None:
        body = names.get(int(picture.segmentation[row, column]))
    if picture.depth is not None and picture.depth[row, column] > 0:
        depth = float(picture.depth[row, column])
        k = info.intrinsic
        # The middle of the pixel, in the camera's frame: x forward, y left, z up.
        left = -(column + 0.5 - k[0, 2]) / k[0, 0] * depth
        up = -(row + 0.5 - k[1, 2]) / k[1, 1] * depth
        x, y, z = compose(picture.pose, [depth, left, up, 1, 0, 0, 0])[:3]
        point = (float(x), float(y), float(z))
    return Picked(info.key, picture.env, float(u), float(v), (column, row), body, depth, point)
