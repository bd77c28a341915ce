"""Jobs that measure, compare, suggest and probe cameras."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from workbench.commands.cameras import MOST_MEASURED
from workbench.core.camera_data import CameraInfo, CameraSettings, Picture, why_no_camera
from workbench.core.cameras.conventions import compose
from workbench.core.cameras.report import CameraReport, OfferedPlacement, SearchSpace, join_reports
from workbench.session.cameras.selection import StudioCameras
from workbench.session.cameras.view import MeasuredMoment, PickedPixel, StudioCamera, StudioResults
from workbench.session.history.history import ShownMoment
from workbench.session.loop import on_loop
from workbench.session.process.askers import Asker, Background
from workbench.session.process.jobs import Job, JobFailed, JobProgress, Jobs
from workbench.session.protocol.messages import Load, Reset
from workbench.session.protocol.questions import DrawCamera, MeasureCamera, SuggestCameras
from workbench.session.run.run import Run

FIRST_SEED = 10_000
"""First seed of every report, so that two reports can be compared; far from the seeds that people start with."""
MOST_ENVS = 16
"""Most envs of a job in the background process; for more seeds these envs are reset again."""
_REPORT_EVERY = 8
"""Steps between two partial reports."""


Triple = tuple[float, float, float]
Case = tuple[int, NDArray[np.float32] | None, MeasuredMoment | None]
"""What a camera is measured on: the env; the poses (B, 7) of its bodies, None for now; the moment of the history."""


class CameraReports:
    """Jobs about the selected camera, of several questions to a worker each. Methods return at once.

    The shown moment is asked of the worker that plays, one env at a time, so that it continues playing; fresh episodes
    of the background process. Each of the two has one job at a time; a new one replaces it.
    """

    def __init__(
        self,
        cameras: StudioCameras,
        asker: Asker,
        background: Background,
        on_change: Callable[[], None],
        run: Callable[[], Run],
    ) -> None:
        """
        Args:
            asker, background: ask the worker that plays, and the background process.
            on_change: called, on any thread, when `results` or `progress` has changed.
            run: returns the present run.
        """
        self._cameras, self._run, self._on_change = cameras, run, on_change
        self.results = StudioResults()
        self._live, self._background = asker, background
        self._live_jobs = Jobs(on_change, self._failed)
        self._background_jobs = Jobs(on_change, self._failed)

    @property
    def progress(self) -> JobProgress | None:
        return self._background_jobs.progress or self._live_jobs.progress

    # --- jobs ------------------------------------------------------------------------------------------

    @on_loop
    def measure(self, seeds: int = 0) -> None:
        """Measure the selected camera, as placed, over all envs.

        Args:
            seeds: 0 for the envs at the shown moment; else that many freshly reset ones, in the background, with partial
                reports.
        """
        camera = self._selected_camera()
        if camera is not None and seeds <= 0:
            moment = self._run().shown_moment()
            cases: list[Case] = [(env, moment.of(env), None) for env in range(moment.num_envs)]
            self._measure_live("in all envs", camera, cases, len(cases))
        elif camera is not None and (load := self._run().running_load()) is not None:
            self._measure_seeds(camera, load, min(seeds, MOST_MEASURED))

    @on_loop
    def measure_steps(self, most: int = MOST_MEASURED) -> None:
        """Measure the selected camera, as placed, over steps of the selected env's episode, with partial reports.

        Args:
            most: at most so many steps, evenly spread.
        """
        camera = self._selected_camera()
        moments = self._run().episode_moments(min(max(1, most), MOST_MEASURED))
        if camera is not None and moments:
            cases: list[Case] = [
                (env, step.poses[env], MeasuredMoment(moment.serial, env, int(step.elapsed_steps[env])))
                for moment, env in moments
                for step in [moment.step]
            ]
            self._measure_live(f"over {len(moments)} steps", camera, cases, _REPORT_EVERY)

    def _measure_live(self, over: str, camera: StudioCamera, cases: Sequence[Case], every: int) -> None:
        async def work(job: Job) -> None:
            with self._measuring():
                question = MeasureCamera(camera.key, None, 0)
                await self._measure(job, self._live, question, camera.now, [], cases, len(cases), every)

        self._live_jobs.start(f"measuring {camera.key[1]} {over}", work)

    def _measure_seeds(self, camera: StudioCamera, load: Load, seeds: int) -> None:
        question = MeasureCamera(camera.key, camera.now if camera.moved else None, 0)

        async def work(job: Job) -> None:
            reports: list[CameraReport] = []

            async def measure() -> None:
                """Continue with the first seed without a report: a job of higher rank may have interrupted this one."""
                num_envs = await self._background.ensure(job, _for_measuring(load))

                for seed in range(begun := len(reports), seeds):
                    if (env := seed % num_envs) == 0 or seed == begun:
                        await self._background.ask(Reset(None, FIRST_SEED + seed - env))
                    case = [(env, None, None)]
                    await self._measure(
                        job,
                        self._background,
                        question,
                        camera.now,
                        reports,
                        case,
                        seeds,
                        num_envs,
                        fresh=True,
                    )

            with self._measuring():
                await self._background.in_turns(job, measure)

        self._background_jobs.start(f"measuring {camera.key[1]} over {seeds} seeds", work)

    async def _measure(
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
            question: without env and poses.
            now: the camera's settings.
            reports: of earlier cases; those of `cases` are appended.
            every: cases between two partial reports.
            fresh: the cases are fresh episodes.
        """
        moments: list[MeasuredMoment] = []
        for env, poses, moment in cases:
            job.report(len(reports), total)
            reports.append(await asker.ask(replace(question, env=env, poses=poses)))
            moments += [] if moment is None else [moment]
            if len(reports) % every == 0 or len(reports) == total:
                self._update(
                    report=join_reports(reports),
                    report_of=question.key,
                    report_settings=now,
                    report_seeds=len(reports) if fresh else 0,
                    report_moments=tuple(moments),
                    outdated=False,
                    measuring=False,
                )

    @on_loop
    def suggest(self, objects: Sequence[str], low: Triple, high: Triple, seeds: int) -> None:
        """Search placements of the selected camera that see these objects in fresh episodes.

        Args:
            objects: names of objects, or of single links of them (``TaskDescription.objects``).
            low, high: corners of the box for the eye; metres, in the frame of the camera's mount, or the env's.
            seeds: number of episodes, at most one an env.
        """
        camera, load = self._selected_camera(), self._run().running_load()
        if camera is not None and camera.now is None:
            self._set_problem(f"{camera.key[1]} cannot be placed: {camera.refused}.")
        if camera is None or camera.now is None or load is None:
            return
        key = camera.key
        space = SearchSpace(tuple(objects), low, high, camera.now, key[0], mount=camera.info.mount)
        what = f"searching placements for {key[1]}"

        async def work(job: Job) -> None:
            async def search() -> tuple[OfferedPlacement, ...]:
                num_envs = await self._background.ensure(job, _for_measuring(load))
                await self._background.ask(Reset(None, FIRST_SEED))
                envs = tuple(range(min(max(1, seeds), num_envs)))
                job.report(0, 0, what)
                return await self._background.ask(
                    SuggestCameras(space, envs), lambda done, total, part: job.report(done, total, what)
                )

            self._update(suggestions=(), suggestions_of=key)
            found = await self._background.in_turns(job, search)
            problem = "" if found else f"no placement in that box sees {' and '.join(objects)} in any env."
            self._update(suggestions=found, problem=problem)

        self._background_jobs.start(what, work)

    @on_loop
    def compare(self, other: CameraSettings) -> None:
        """Draw the shown env with the selected camera as placed, and with other settings."""
        camera = self._selected_camera()
        if camera is None:
            return
        key, moment, why_not = camera.key, self._run().shown_moment(), camera.refused or why_no_camera(other)

        async def work(job: Job) -> None:
            now = await self._draw(moment, DrawCamera(key, None, moment.env))
            then = await self._draw(moment, DrawCamera(key, other, moment.env))
            self._update(compared=(now, then))

        if why_not:
            self._set_problem(f"{key[1]} is not compared: {why_not}.")
        else:
            self._live_jobs.start(f"comparing two placements of {key[1]}", work)

    @on_loop
    def make_sheet(self) -> None:
        """Draw the selected camera's pictures of all envs, one by one; worst first if there is a report over them."""
        camera = self._selected_camera()
        if camera is None:
            return
        key = camera.key
        moment, report = self._run().shown_moment(), self.results.report_over_envs(key)
        order = list(range(moment.num_envs))
        if report is not None:
            measured = [report.envs[i] for i in report.worst_first()]
            order = measured if sorted(measured) == order else order

        async def work(job: Job) -> None:
            self._update(sheet=())
            for done, env in enumerate(order):
                job.report(done, len(order))
                picture = await self._draw(moment, DrawCamera(key, None, env))
                self._update(sheet=(*self.results.sheet, picture))

        self._live_jobs.start(f"taking pictures of all envs with {key[1]}", work)

    @on_loop
    def pick(self, u: float, v: float) -> None:
        """Probe a pixel of the selected camera: 0, 0 is the upper left corner of the picture, 1, 1 the lower right one."""
        camera, task, moment = self._selected_camera(), self._cameras.task, self._run().shown_moment()
        if camera is None or task is None:
            return

        async def work(job: Job) -> None:
            question = DrawCamera(camera.key, None, moment.env, ("depth", "segmentation"))
            picture = await self._draw(moment, question)
            self._update(picked=pick_pixel(camera.info, picture, u, v, task.segmentation))

        self._live_jobs.start("refining", work)

    @on_loop
    def stop(self) -> None:
        """Cancel all jobs; results so far stay."""
        self._live_jobs.stop()
        self._background_jobs.stop()
        self._on_change()

    @on_loop
    def mark_outdated(self) -> None:
        """Mark the results as those of an earlier version, and cancel all jobs. Does not call `on_change`."""
        self._live_jobs.stop()
        self._background_jobs.stop()
        self.results = replace(self.results, outdated=True, compared=None, picked=None, sheet=())

    @on_loop
    def close(self) -> None:
        """Cancel all jobs, and begin no more."""
        self._live_jobs.close()
        self._background_jobs.close()

    # --- helpers -----------------------------------------------------------------------------------------

    def _selected_camera(self) -> StudioCamera | None:
        camera = self._cameras.selected_camera()
        self._on_change()
        return camera

    def _set_problem(self, problem: str) -> None:
        self._cameras.problem = problem
        self._on_change()

    async def _draw(self, moment: ShownMoment, question: DrawCamera) -> Picture:
        return await self._live.ask(replace(question, poses=moment.of(question.env)))

    @contextmanager
    def _measuring(self) -> Iterator[None]:
        """Mark the report as an old one until a new one comes or the work ends."""
        self._update(measuring=True)
        try:
            yield
        finally:
            self._update(measuring=False)

    def _update(self, **values: object) -> None:
        self.results = replace(self.results, **{"problem": "", **values})  # type: ignore[arg-type]
        self._on_change()

    def _failed(self, failure: JobFailed) -> None:
        why = str(failure)
        self._update(problem=f"{why[:1].upper()}{why[1:]}" + ("" if why.endswith(".") else "."))


def _for_measuring(load: Load) -> Load:
    options = load.options
    kwargs = dict(options.env_kwargs)
    if kwargs.get("obs_mode", "state") not in ("state", "state_dict", "none"):
        kwargs["obs_mode"] = "state"  # else every reset renders all cameras of all envs
    envs = min(options.num_envs, MOST_ENVS)
    return replace(load, options=replace(options, num_envs=envs, env_kwargs=kwargs))


def pick_pixel(info: CameraInfo, picture: Picture, u: float, v: float, names: dict[int, str]) -> PickedPixel:
    """What a pixel shows; `u` and `v` are from 0 to 1, from the picture's upper left corner."""
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
        # The pixel's centre in the camera's frame: x forward, y left, z up.
        left = -(column + 0.5 - k[0, 2]) / k[0, 0] * depth
        up = -(row + 0.5 - k[1, 2]) / k[1, 1] * depth
        x, y, z = compose(picture.pose, [depth, left, up, 1, 0, 0, 0])[:3]
        point = (float(x), float(y), float(z))
    return PickedPixel(info.key, picture.env, float(u), float(v), (column, row), body, depth, point)
