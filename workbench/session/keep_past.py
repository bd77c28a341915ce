"""Keep what I just saw: an episode of the past becomes a recording after the fact.

Nobody presses Record before the run that is worth keeping. But the history has it all: of every moment the poses, the
action, the reward and what ``evaluate`` returned, as they were said then; and a snapshot. What a recording holds
beyond that (env states, observations, pictures of every camera) is read off the envs when they are put back to
the snapshot. That happens in a process of its own, so playing goes on, and the result is the file that recording it
live would have given. It takes some seconds for the process to start, and then about as long as its pictures take.

If the file was edited since, env states, observations and pictures are those that today's code gives for that state; the
rest is as it was said then.
"""

from __future__ import annotations

import pickle
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from workbench.recording.columns import BatchPacker
from workbench.recording.episode_writer import EpisodeWriter
from workbench.recording.landing import RecordingError
from workbench.session.background import BackgroundProcess
from workbench.session.episode_files import EpisodeFinisher
from workbench.session.episodes import GatheredEpisode, episode_info
from workbench.session.keep_status import KeepStatus
from workbench.session.lane import Job, JobFailed, Lane, Stopped
from workbench.session.messages import (
    Failed,
    Load,
    Loaded,
    PlaceCamera,
    Placed,
    Request,
    Reset,
    Stepped,
)
from workbench.session.moment_messages import Captured, CaptureMoments, MomentToCapture
from workbench.session.past_episodes import PastEpisode, WhatToKeep, moments_of

_IDLE_SECONDS = 60.0
"""How long the process stays when nothing is kept: it holds some 0.75 GB."""
_SAME_START = 1e-6
"""Metres and quaternion components."""
_Answer = TypeVar("_Answer", Captured, Loaded, Placed, Stepped)


class PastKeeper:
    """Keeps episodes, one job at a time."""

    def __init__(self, folder: Path, finisher: EpisodeFinisher, on_change: Callable[[], None]) -> None:
        self._folder, self._finisher, self._on_change = folder, finisher, on_change
        self._lock = threading.Lock()
        self._said, self._failed = "", False
        self._process = BackgroundProcess("that draws it", "to draw it with")
        self._loaded: tuple[Load, tuple[PlaceCamera, ...]] | None = None
        """By the process that is there."""
        self._lane = Lane("keep-past", on_change, self._fail, _IDLE_SECONDS, self._process.end)

    def keep(self, what: WhatToKeep) -> None:
        """Begin; what was under way is given up."""
        self._say("")
        self._lane.start("starting a process to draw it with", lambda job: self._work(job, what))

    def stop(self) -> None:
        """Give up; nothing of it is kept."""
        self._lane.stop()
        self._say("stopped; nothing was kept")

    def refuse(self, why: str) -> None:
        """Say why nothing can be kept."""
        self._fail(why)
        self._on_change()

    def status(self) -> KeepStatus:
        progress = self._lane.progress
        with self._lock:
            if progress is None:
                return KeepStatus(said=self._said, failed=self._failed)
        return KeepStatus(True, progress.what, progress.done, progress.total)

    def close(self) -> None:
        self._lane.close()

    # --- on the lane's thread --------------------------------------------------------------------------

    def _work(self, job: Job, what: WhatToKeep) -> None:
        self._have_loaded(job, what)
        what, lost = self._with_sure_seeds(job, what)
        writers: dict[int, GatheredEpisode] = {}
        try:
            self._capture_all(job, what, writers)
        except (RecordingError, ValueError) as error:
            _discard(writers)
            raise JobFailed(f"it could not be kept: {error}") from error
        except BaseException:
            _discard(writers)
            raise
        job.tell(1, 1, "writing the files")
        made = [self._finisher.finish(episode) for episode in writers.values()]
        problems = [result for future in made if isinstance(result := future.result(), str)]
        if problems:
            raise JobFailed(problems[0])
        steps = sum(episode.steps for episode in what.episodes)
        unfinished = sum(not episode.ended for episode in what.episodes)
        kept = f"kept {len(made)} episode{'' if len(made) == 1 else 's'}, {steps} steps"
        self._say(kept + _not_ended(unfinished, len(made)) + _no_seed(lost, len(made)))

    def _with_sure_seeds(self, job: Job, what: WhatToKeep) -> tuple[WhatToKeep, int]:
        """Each episode with its seed only if that, alone, starts it; and of how many it does not.

        What envs that were reset together drew from torch's generator hangs on all of them.
        """
        sure: list[PastEpisode] = []
        for done, episode in enumerate(what.episodes):
            job.tell(done, len(what.episodes), "trying the seeds")
            sure.append(episode if self._starts(job, episode) else replace(episode, seed=-1))
        lost = sum(was.seed != now.seed for was, now in zip(what.episodes, sure, strict=True))
        return replace(what, episodes=tuple(sure)), lost

    def _starts(self, job: Job, episode: PastEpisode) -> bool:
        """Whether a reset of its env alone with its seed gives its first state."""
        if episode.seed < 0:
            return True
        first, env = episode.moments[0]
        self._process.send(Reset((env,), episode.seed))
        while True:
            event = self._answer(job, Stepped)
            # The one that the version began with may come before.
            if event.reset_mask.sum() == 1 and event.seeds is not None and event.seeds[env] == episode.seed:
                return np.allclose(
                    event.step.poses[env],
                    first.as_recorded.poses[env],
                    rtol=0,
                    atol=_SAME_START,
                    equal_nan=True,
                )

    def _capture_all(self, job: Job, what: WhatToKeep, writers: dict[int, GatheredEpisode]) -> None:
        names = [dimension.name for dimension in what.task.actions]
        moments, packer = moments_of(what.episodes), BatchPacker()
        rows: dict[int, dict[int, list[tuple[PastEpisode, bool]]]] = {}
        for episode in what.episodes:
            for index, (moment, env) in enumerate(episode.moments):
                rows.setdefault(moment.serial, {}).setdefault(env, []).append((episode, index == 0))
        for done, (moment, envs) in enumerate(moments):
            job.tell(done, len(moments), "drawing it again")
            snapshot = pickle.dumps(what.snapshots[moment.serial])
            answer = self._ask(
                job, CaptureMoments((MomentToCapture(snapshot, envs),), what.task.can_render), Captured
            )
            columns, pictures, step = answer.columns[0], answer.pictures[0], moment.as_recorded
            for env in envs:
                for episode, is_first in rows[moment.serial][env]:
                    if is_first:
                        writer = EpisodeWriter(
                            self._folder,
                            episode_info(what.task, episode.env, episode.seed),
                            what.task.geometry,
                            what.task.segmentation,
                            names,
                            what.task.cameras,
                        )
                        writers[episode.env] = GatheredEpisode(writer, episode.env, episode.seed)
                    else:
                        writers[episode.env].acts(moment.acted_by)
                    writers[episode.env].take(packer, step, env, columns, pictures)

    def _have_loaded(self, job: Job, what: WhatToKeep) -> None:
        if self._loaded is not None and self._loaded[1] != what.placed:
            self._process.end()  # a camera that was put back to the file would stay where it was placed
        if not self._process.there:
            self._loaded = None
            self._process.start()
        if self._loaded == (what.load, what.placed):
            return
        job.tell(0, 0, "building the envs to draw it with")
        self._loaded = None
        self._ask(job, what.load, Loaded)
        for request in what.placed:
            self._ask(job, request, Placed)
        self._loaded = what.load, what.placed

    def _ask(self, job: Job, request: Request, kind: type[_Answer]) -> _Answer:
        self._process.send(request)
        return self._answer(job, kind)

    def _answer(self, job: Job, kind: type[_Answer]) -> _Answer:
        try:
            event = self._process.answer(job, kind, Failed)
        except Stopped:
            self._process.end()  # what it was asked for last belongs to nobody
            raise
        if isinstance(event, Failed):
            where = "" if event.problem.line is None else f" (line {event.problem.line})"
            raise JobFailed(f"it could not be drawn again: {event.problem.message}{where}")
        return event

    def _fail(self, why: str) -> None:
        with self._lock:
            self._said, self._failed = why, True

    def _say(self, words: str) -> None:
        with self._lock:
            self._said, self._failed = words, False
        self._on_change()


def _not_ended(count: int, kept: int) -> str:
    if not count:
        return ""
    if kept == 1:
        return "; it had not ended"
    return "; none of them had ended" if count == kept else f"; {count} of them had not ended"


def _no_seed(count: int, kept: int) -> str:
    if not count:
        return ""
    what = "its start was" if kept == 1 else "their starts were" if count == kept else f"{count} starts were"
    return f"; {what} drawn for several envs at once, so their first state is recorded and no seed"


def _discard(writers: dict[int, GatheredEpisode]) -> None:
    for episode in writers.values():
        episode.writer.discard()
