"""Cameras looked at with more than one pair of eyes: over all envs, over many seeds, side by side, pixel by pixel.

Every question here is a small job of several requests to a worker (see `questions`). What concerns the moment
on the screen is asked of the worker that plays, one env at a time, so that it goes on playing; what needs fresh
episodes, of another in the background. There is one job of each kind at a time, and a new one takes its place.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from workbench.core.camera_frames import compose
from workbench.core.camera_report import CameraReport, join_reports
from workbench.core.camera_settings import CameraKey, CameraSettings
from workbench.core.pictures import CameraInfo, Picture
from workbench.session.askers import Asker, Background
from workbench.session.history import Lived
from workbench.session.lane import Job, JobFailed, Lane
from workbench.session.messages import Load, Reset
from workbench.session.questions import DrawCamera, JudgeCamera, SuggestCameras
from workbench.session.studio_view import JudgedMoment, Looked, Picked, Progress

FIRST_SEED = 10_000
"""The same seeds for every judgement, so that two can be compared; others than people begin with."""
MOST_ENVS = 16
"""In the background: more are made of these by resetting them again."""
_TELL_EVERY = 8
"""Steps after which what is known so far is shown."""


@dataclass(frozen=True)
class ShownMoment:
    """What the page shows."""

    env: int
    """The selected one."""
    num_envs: int
    poses: NDArray[np.float32] | None
    """(N, B, 7) of a moment of the past; None for now."""

    def of(self, env: int) -> NDArray[np.float32] | None:
        """(B, 7) of one env."""
        return None if self.poses is None else self.poses[env]


Case = tuple[int, NDArray[np.float32] | None, JudgedMoment | None]
"""Where a camera is judged: the env; (B, 7) its bodies, None for now; which moment of the past that is."""


class CameraJudging:
    """Thread-safe; every method returns at once."""

    def __init__(self, asker: Asker, background: Background, on_change: Callable[[], None]) -> None:
        """
        Args:
            asker, background: ask the worker that plays, and the one in the background.
            on_change: called, on any thread, when there is something new.
        """
        self._on_change = on_change
        self._lock = threading.Lock()
        self._looked = Looked()
        self._live, self._background = asker, background
        self._live_lane = Lane("studio-live", on_change, self._failed)
        self._background_lane = Lane("studio-background", on_change, self._failed)

    # --- what is known -------------------------------------------------------------------------------

    @property
    def looked(self) -> Looked:
        with self._lock:
            return self._looked

    @property
    def progress(self) -> Progress | None:
        return self._background_lane.progress or self._live_lane.progress

    # --- jobs ------------------------------------------------------------------------------------------

    def judge(self, key: CameraKey, now: CameraSettings | None, moment: ShownMoment) -> None:
        """Judge a camera as it stands, in all envs, at the shown moment."""
        cases: list[Case] = [(env, moment.of(env), None) for env in range(moment.num_envs)]
        self._judge_live(f"judging {key[1]} in all envs", key, now, cases, len(cases))

    def judge_steps(self, key: CameraKey, now: CameraSettings | None, moments: Sequence[Lived]) -> None:
        """Judge a camera as it stands at moments of the past; what is known so far can be seen all the while."""
        cases: list[Case] = [
            (env, step.poses[env], JudgedMoment(moment.serial, env, int(step.elapsed_steps[env])))
            for moment, env in moments
            for step in [moment.step]
        ]
        self._judge_live(f"judging {key[1]} over {len(moments)} steps", key, now, cases, _TELL_EVERY)

    def _judge_live(
        self, what: str, key: CameraKey, now: CameraSettings | None, cases: Sequence[Case], every: int
    ) -> None:
        def work(job: Job) -> None:
            with self._judging_anew():
                self._judge(job, self._live, JudgeCamera(key, None, 0), now, cases, len(cases), every)

        self._live_lane.start(what, work)

    def judge_seeds(
        self, key: CameraKey, now: CameraSettings | None, moved: bool, load: Load, seeds: int
    ) -> None:
        """Judge a camera over so many fresh episodes; what is known so far can be seen all the while."""

        def work(job: Job) -> None:
            with self._judging_anew(), self._background.turn(job):
                num_envs = self._background.ensure(job, _for_judging(load))

                def cases() -> Iterator[Case]:
                    for seed in range(seeds):
                        if seed % num_envs == 0:
                            self._background.ask(job.check, Reset(None, FIRST_SEED + seed))
                        yield seed % num_envs, None, None

                question = JudgeCamera(key, now if moved else None, 0)
                self._judge(job, self._background, question, now, cases(), seeds, num_envs, fresh=True)

        self._background_lane.start(f"judging {key[1]} over {seeds} seeds", work)

    def _judge(
        self,
        job: Job,
        asker: Asker,
        question: JudgeCamera,
        now: CameraSettings | None,
        cases: Iterable[Case],
        total: int,
        every: int,
        fresh: bool = False,
    ) -> None:
        """
        Args:
            question: but for where.
            now: how the camera stands.
            every: cases after which what is known so far is shown.
            fresh: the cases are fresh episodes.
        """
        reports: list[CameraReport] = []
        moments: list[JudgedMoment] = []
        for env, poses, moment in cases:
            job.tell(len(reports), total)
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
                    judging=False,
                )

    def suggest(
        self,
        key: CameraKey,
        lens: CameraSettings,
        objects: tuple[str, ...],
        low: tuple[float, float, float],
        high: tuple[float, float, float],
        load: Load,
        seeds: int,
    ) -> None:
        """Search placements over so many fresh episodes, or as many as there are envs."""

        def work(job: Job) -> None:
            self._know(suggestions=(), suggestions_of=key)
            with self._background.turn(job):
                num_envs = self._background.ensure(job, _for_judging(load))
                self._background.ask(job.check, Reset(None, FIRST_SEED))
                envs = tuple(range(min(max(1, seeds), num_envs)))
                what = f"searching places for {key[1]}"
                job.tell(0, 0, what)
                question = SuggestCameras(key, lens, objects, low, high, envs)
                found = self._background.ask(
                    job.check, question, lambda done, total, part: job.tell(done, total, what)
                )
            problem = "" if found else f"no place in that box sees {' and '.join(objects)} in any env."
            self._know(suggestions=found, problem=problem)

        self._background_lane.start(f"searching places for {key[1]}", work)

    def compare(self, key: CameraKey, other: CameraSettings, moment: ShownMoment) -> None:
        """Two pictures of the shown moment."""

        def work(job: Job) -> None:
            pair = [self._draw(job, key, settings, moment.env, moment) for settings in (None, other)]
            self._know(compared=(pair[0], pair[1]))

        self._live_lane.start(f"comparing two placements of {key[1]}", work)

    def make_sheet(self, key: CameraKey, moment: ShownMoment) -> None:
        """A picture of every env, as they come."""
        looked = self.looked
        order: tuple[int, ...] = tuple(range(moment.num_envs))
        known = (looked.report_of, looked.report_seeds, looked.report_moments)
        if looked.report is not None and known == (key, 0, ()):
            judged = [looked.report.envs[i] for i in looked.report.worst_first()]
            if sorted(judged) == list(order):
                order = tuple(judged)

        def work(job: Job) -> None:
            self._know(sheet=())
            for done, env in enumerate(order):
                job.tell(done, len(order))
                picture = self._draw(job, key, None, env, moment)
                self._know(sheet=(*self.looked.sheet, picture))

        self._live_lane.start(f"taking pictures by {key[1]} of all envs", work)

    def pick(self, info: CameraInfo, u: float, v: float, moment: ShownMoment, names: dict[int, str]) -> None:
        """What is at a place of the picture."""

        def work(job: Job) -> None:
            picture = self._draw(job, info.key, None, moment.env, moment, ("depth", "segmentation"))
            self._know(picked=picked(info, picture, u, v, names))

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

    def _draw(
        self,
        job: Job,
        key: CameraKey,
        settings: CameraSettings | None,
        env: int,
        moment: ShownMoment,
        modalities: tuple[str, ...] = ("rgb",),
    ) -> Picture:
        return self._live.ask(job.check, DrawCamera(key, settings, env, modalities, moment.of(env)))

    @contextmanager
    def _judging_anew(self) -> Iterator[None]:
        """What is known from before is said to be that, until there is something new or the work ends."""
        self._know(judging=True)
        try:
            yield
        finally:
            self._know(judging=False)

    def _know(self, **values: object) -> None:
        with self._lock:
            self._looked = replace(self._looked, **{"problem": "", **values})  # type: ignore[arg-type]
        self._on_change()

    def _failed(self, job: Job, failure: JobFailed) -> None:
        why = str(failure)
        self._know(problem=f"{why[:1].upper()}{why[1:]}" + ("" if why.endswith(".") else "."))


def _for_judging(load: Load) -> Load:
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
