"""Records a past episode from the history."""

from __future__ import annotations

import pickle
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from workbench.envs.camera_data import CameraKey, CameraSettings, differences
from workbench.episodes.columns import BatchPacker
from workbench.episodes.writing.publish import RecordingError
from workbench.live.history.moments import Moment
from workbench.live.messages import PlaceCamera, Reset
from workbench.live.process.ask import WAITING, Background
from workbench.live.process.background_jobs import Job, JobFailed, Jobs
from workbench.machine.loop import BlockingPool, do, post
from workbench.record.gather import EpisodeFinisher, GatheredEpisode
from workbench.record.questions import Captured, CaptureMoment
from workbench.record.saving_state import (
    BeginSaving,
    EpisodesSaved,
    PastEpisode,
    SaveEvent,
    SaveFailed,
    SaveProgressed,
    SaveRequest,
)
from workbench.record.state import EpisodeEnded
from workbench.task.description import TaskDescription


def moments_of(episodes: Sequence[PastEpisode]) -> list[tuple[Moment, dict[int, list[PastEpisode]]]]:
    """Each moment of the episodes once, oldest first, with the episodes that contain the moment, by env."""
    found: dict[int, tuple[Moment, dict[int, list[PastEpisode]]]] = {}
    for episode in episodes:
        for moment, env in episode.moments:
            found.setdefault(moment.serial, (moment, {}))[1].setdefault(env, []).append(episode)
    return [found[serial] for serial in sorted(found)]


_START_TOLERANCE = 1e-6
"""Tolerance of the start state: metres, and quaternion components."""


class PastSaver:
    """Records past episodes, one job at a time, in the background process.

    The history has the original poses, actions, rewards and results of ``evaluate``, and a snapshot of each
    moment. Env states, observations and pictures of all cameras are read from envs that are restored from the
    snapshots. So the file equals a live recording, except after an edit of the task's file: then states,
    observations and pictures come from the new code. The recorded source is the version that played the
    episode.
    """

    def __init__(
        self,
        folder: Path,
        finisher: EpisodeFinisher,
        process: Background,
        dispatch: Callable[[SaveEvent | EpisodeEnded], object],
    ) -> None:
        """
        Args:
            finisher: makes the files.
            process: the process that renders moments again.
            dispatch: called on the loop with the events of a job.
        """
        self._folder, self._finisher, self._process, self._dispatch = folder, finisher, process, dispatch
        self._job = 0
        """Number of the running job."""
        self._jobs = Jobs(self._progressed, self._failed)
        self._aside = BlockingPool("keep-past")
        """Thread that writes, because the disk may be slow."""

    def begin(self, effect: BeginSaving, placed: tuple[PlaceCamera, ...]) -> None:
        """Begin a job; called on the loop.

        Args:
            placed: cameras that are placed by hand.
        """
        self._job = effect.job
        self._jobs.start(WAITING, lambda job: self._save(job, effect.what, placed))

    def end(self) -> None:
        """Cancel the job; called on the loop."""
        self._jobs.stop()

    def close(self) -> None:
        """Cancel the running job, and wait until nothing more is written. Must not be called on the loop's thread."""
        do(self._jobs.close)
        self._aside.close()

    def _progressed(self) -> None:
        if (progress := self._jobs.progress) is not None:
            self._dispatch(SaveProgressed(self._job, progress))

    # --- the job -------------------------------------------------------------------------------------

    async def _save(self, job: Job, what: SaveRequest, placed: tuple[PlaceCamera, ...]) -> None:
        seeds: dict[int, int] = {}
        writers: dict[int, GatheredEpisode] = {}
        moments, packer = deque(moments_of(what.episodes)), BatchPacker()
        total = len(moments)

        async def redraw() -> None:
            """Capture the moments that are not captured yet. Runs again after a job of higher rank
            interrupted this one."""
            await self._process.ensure(job, what.load, placed)
            for episode in what.episodes:
                if episode.env not in seeds:
                    job.report(len(seeds), len(what.episodes), "trying the seeds")
                    seeds[episode.env] = await self._verified_seed(episode)
            while moments:
                job.report(total - len(moments), total, "rendering again")
                moment, rows = moments[0]
                question = CaptureMoment(pickle.dumps(moment.snapshot), tuple(rows), what.task.can_render)
                captured = await self._process.ask(question)
                del moments[0]
                await self._aside.run(partial(write, moment, rows, captured))

        def write(moment: Moment, rows: dict[int, list[PastEpisode]], captured: Captured) -> None:
            for row, episodes in rows.items():
                for episode in episodes:
                    if (writer := writers.get(episode.env)) is not None:
                        writer.set_source(moment.acted_by)
                    else:
                        writer = self._begun(what, placed, episode, seeds[episode.env])
                        writers[episode.env] = writer
                    writer.take(packer, moment.as_recorded, row, captured.columns, captured.pictures)

        def discard() -> None:
            for episode in writers.values():
                episode.writer.discard()

        def finish() -> list[str]:
            made = []
            for episode in writers.values():
                post(partial(self._dispatch, EpisodeEnded(live=False)))
                made.append(self._finisher.finish(episode))
            return [result for future in made if isinstance(result := future.result(), str)]

        try:
            await self._process.in_turns(job, redraw)
        except BaseException as error:
            self._aside.begin(discard)
            if isinstance(error, RecordingError | ValueError):
                raise JobFailed(f"Saving failed: {error}") from error
            raise
        job.report(1, 1, "writing the files")
        if problems := await self._aside.run(finish):
            raise JobFailed(problems[0])
        steps = sum(episode.steps for episode in what.episodes)
        unfinished = sum(not episode.ended for episode in what.episodes)
        lost = sum(seeds[episode.env] != episode.seed for episode in what.episodes)
        envs = what.episodes[0].env if len(what.episodes) == 1 else None
        which = f"{len(writers)} episodes" if envs is None else f"an episode of env {envs}"
        saved = f"Saved {which}, {steps} step{'' if steps == 1 else 's'}"
        earlier = sum(
            _as_played(what.task, episode).source_hash != what.task.source_hash for episode in what.episodes
        )
        message = (
            saved
            + _unfinished_text(unfinished, len(writers))
            + _lost_seed_text(lost, len(writers))
            + _earlier_text(earlier, len(writers))
        )
        self._dispatch(EpisodesSaved(self._job, message))

    def _begun(
        self, what: SaveRequest, placed: tuple[PlaceCamera, ...], episode: PastEpisode, seed: int
    ) -> GatheredEpisode:
        """Begin the recording of an episode, with the camera placements that its source lacks. Raises
        RecordingError."""
        task = _as_played(what.task, episode)
        observed_by = "" if task.source_hash == what.task.source_hash else what.task.source_hash
        writer = GatheredEpisode.of(self._folder, task, episode.env, seed, observed_by=observed_by)
        writer.set_placed(
            {p.key: p.settings for p in placed if p.settings}, _cameras_in_source(what.task, episode)
        )
        return writer

    async def _verified_seed(self, episode: PastEpisode) -> int:
        """Seed of the episode, if a reset of its env alone with this seed gives the episode's first state;
        else -1.

        Envs that are reset together share torch's generator, so their random numbers depend on all of them.
        """
        if episode.seed < 0:
            return episode.seed
        first, env = episode.moments[0]
        step = await self._process.ask(Reset((env,), episode.seed))
        now, then = step.poses[env], first.as_recorded.poses[env]
        return episode.seed if np.allclose(now, then, rtol=0, atol=_START_TOLERANCE, equal_nan=True) else -1

    def _failed(self, failure: JobFailed) -> None:
        why, problem = str(failure), failure.problem
        if problem is not None:
            where = "" if problem.line is None else f" (line {problem.line})"
            why = f"The episode could not be rendered again: {problem.message}{where}"
        self._dispatch(SaveFailed(self._job, why))


def _as_played(task: TaskDescription, episode: PastEpisode) -> TaskDescription:
    """The description of the running version, which makes the pictures, but with the file and source of the
    version that played the episode."""
    played = episode.played_by
    if played is None:
        return task
    return replace(task, file=played.file, source_hash=played.source_hash, source=played.source)


def _cameras_in_source(task: TaskDescription, episode: PastEpisode) -> dict[CameraKey, CameraSettings]:
    """Camera settings of the version that played the episode, for the cameras whose settings differ in the
    running version."""
    now = {camera.key: camera.settings for camera in task.cameras}
    played = () if episode.played_by is None else episode.played_by.cameras
    return {
        camera.key: camera.settings
        for camera in played
        if camera.settings is not None
        and (here := now.get(camera.key)) is not None
        and differences(camera.settings, here)
    }


def _unfinished_text(count: int, episodes: int) -> str:
    if not count:
        return ""
    if episodes == 1:
        return "; it had not ended"
    return "; none of them had ended" if count == episodes else f"; {count} of them had not ended"


def _lost_seed_text(count: int, episodes: int) -> str:
    if not count:
        return ""
    what = "" if count == episodes else f"{count} "
    return f"; {what}without a seed (many envs were reset together): a replay restores the first state"


def _earlier_text(count: int, episodes: int) -> str:
    if not count:
        return ""
    what = "it was" if episodes == 1 else "they were" if count == episodes else f"{count} were"
    return (
        f"; {what} played by an earlier version of the file: source and rewards are of that version, "
        "observations and pictures of the current one"
    )
