"""Measures, compares, suggests and probes cameras."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from workbench.cameras.events import (
    Case,
    Compare,
    DrawEnvs,
    MeasureLive,
    MeasureSeeds,
    Measuring,
    Pick,
    PicturesCompared,
    PixelPicked,
    ReportMade,
    SheetPictureDrawn,
    StudioEvent,
    Suggest,
    SuggestionsFound,
)
from workbench.cameras.questions import DrawCamera, SuggestCameras
from workbench.cameras.view import MeasuredMoment, PickedPixel
from workbench.envs.camera_data import CameraInfo, Picture
from workbench.live.history.moments import ShownMoment
from workbench.live.messages import Load, Reset
from workbench.live.process.ask import Background, QuestionClient
from workbench.live.process.background_jobs import Job
from workbench.pictures.camera_conventions import compose
from workbench.pictures.camera_report import CameraReport, OfferedPlacement, join_reports

FIRST_SEED = 10_000
"""First seed of every report, so that two reports can be compared; far from the seeds that users usually start with."""
MAX_ENVS = 16
"""Maximum number of envs of a job in the background process; for more seeds these envs are reset again."""


class CameraReports:
    """Asks the questions for reports. Its methods are called on the loop."""

    def __init__(
        self, asker: QuestionClient, background: Background, dispatch: Callable[[StudioEvent], object]
    ) -> None:
        """
        Args:
            asker, background: the first asks the worker that plays, the second the background process.
            dispatch: handles the resulting events.
        """
        self._live, self._background, self._dispatch = asker, background, dispatch

    async def measure_live(self, job: Job, wanted: MeasureLive) -> None:
        with self._measuring():
            await self._measure(job, self._live, wanted, [], wanted.cases, len(wanted.cases), wanted.every)

    async def measure_seeds(self, job: Job, wanted: MeasureSeeds) -> None:
        reports: list[CameraReport] = []

        async def measure() -> None:
            """Measure the seeds that have no report yet; some have a report if a job of higher rank
            interrupted this job."""
            num_envs = await self._background.ensure(job, _for_measuring(wanted.load))

            for seed in range(begun := len(reports), wanted.seeds):
                if (env := seed % num_envs) == 0 or seed == begun:
                    await self._background.ask(Reset(None, FIRST_SEED + seed - env))
                cases: list[Case] = [(env, None, None)]
                await self._measure(job, self._background, wanted, reports, cases, wanted.seeds, num_envs)

        with self._measuring():
            await self._background.in_turns(job, measure)

    @contextmanager
    def _measuring(self) -> Iterator[None]:
        """Mark the report as old until a new one arrives or the job ends."""
        self._dispatch(Measuring(True))
        try:
            yield
        finally:
            self._dispatch(Measuring(False))

    async def _measure(
        self,
        job: Job,
        asker: QuestionClient,
        wanted: MeasureLive | MeasureSeeds,
        reports: list[CameraReport],
        cases: Iterable[Case],
        total: int,
        every: int,
    ) -> None:
        """
        Args:
            reports: reports of earlier cases; those of `cases` are appended.
            every: number of cases between two partial reports.
        """
        moments: list[MeasuredMoment] = []
        for env, poses, moment in cases:
            job.report(len(reports), total)
            reports.append(await asker.ask(replace(wanted.question, env=env, poses=poses)))
            moments += [] if moment is None else [moment]
            if len(reports) % every == 0 or len(reports) == total:
                seeds = len(reports) if isinstance(wanted, MeasureSeeds) else 0
                report, of = join_reports(reports), wanted.question.key
                self._dispatch(ReportMade(report, of, wanted.settings, seeds, tuple(moments)))

    async def suggest(self, job: Job, wanted: Suggest) -> None:
        async def search() -> tuple[OfferedPlacement, ...]:
            num_envs = await self._background.ensure(job, _for_measuring(wanted.load))
            await self._background.ask(Reset(None, FIRST_SEED))
            envs = tuple(range(min(max(1, wanted.seeds), num_envs)))
            job.report(0, 0, wanted.what)
            return await self._background.ask(
                SuggestCameras(wanted.space, envs),
                lambda done, total, part: job.report(done, total, wanted.what),
            )

        found = await self._background.in_turns(job, search)
        self._dispatch(SuggestionsFound(found, wanted.space.objects))

    async def compare(self, job: Job, wanted: Compare) -> None:
        moment = wanted.moment
        now = await self._draw(moment, DrawCamera(wanted.key, None, moment.env))
        other = await self._draw(moment, DrawCamera(wanted.key, wanted.other, moment.env))
        self._dispatch(PicturesCompared(now, other))

    async def draw_envs(self, job: Job, wanted: DrawEnvs) -> None:
        for done, env in enumerate(wanted.env_idx):
            job.report(done, len(wanted.env_idx))
            self._dispatch(
                SheetPictureDrawn(await self._draw(wanted.moment, DrawCamera(wanted.key, None, env)))
            )

    async def pick(self, job: Job, wanted: Pick) -> None:
        question = DrawCamera(wanted.info.key, None, wanted.moment.env, ("depth", "segmentation"))
        picture = await self._draw(wanted.moment, question)
        picked = pick_pixel(wanted.info, picture, wanted.u, wanted.v, wanted.segmentation)
        self._dispatch(PixelPicked(picked))

    async def _draw(self, moment: ShownMoment, question: DrawCamera) -> Picture:
        return await self._live.ask(replace(question, poses=moment.of(question.env)))


def _for_measuring(load: Load) -> Load:
    options = load.options
    kwargs = dict(options.env_kwargs)
    if kwargs.get("obs_mode", "state") not in ("state", "state_dict", "none"):
        kwargs["obs_mode"] = "state"  # with pictures, every reset would render all cameras of all envs
    envs = min(options.num_envs, MAX_ENVS)
    return replace(load, options=replace(options, num_envs=envs, env_kwargs=kwargs))


def pick_pixel(info: CameraInfo, picture: Picture, u: float, v: float, names: dict[int, str]) -> PickedPixel:
    """Probe a pixel.

    Args:
        u, v: 0 to 1 from the picture's upper left corner, to the right and down.
        names: body names by id in the segmentation.
    """
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
