"""Records an episode after it happened, from the history."""

from __future__ import annotations

import pickle
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from workbench.core.camera_data import CameraKey, CameraSettings, differences
from workbench.jobs.record.gather import EpisodeFinisher, GatheredEpisode
from workbench.jobs.task import TaskDescription
from workbench.recording.episode.columns import BatchPacker
from workbench.recording.writing.publish import RecordingError
from workbench.session.history.history import EnvMoment, History, Moment
from workbench.session.loop import Aside, do, on_loop
from workbench.session.process.askers import WAITING, Background
from workbench.session.process.jobs import Job, JobFailed, JobProgress, Jobs
from workbench.session.protocol.messages import Load, PlaceCamera, Reset
from workbench.session.protocol.questions import Captured, CaptureMoment
from workbench.session.run.run import Run


@dataclass(frozen=True)
class SaveStatus:
    """Progress and result of recording a past episode."""

    message: str = ""
    """Result of the last job that ended."""
    failed: bool = False
    """Whether `message` is an error."""
    refused_at: object = None
    """What was shown when nothing could be recorded of it; the message holds only there. None for any other message."""
    progress: JobProgress | None = None
    """Progress in moments; None while no job runs."""


@dataclass(frozen=True)
class PastEpisode:
    """The moments of one env's episode, oldest first; the first is its reset.

    It runs through the moments that the env was put back to, until it terminated, was truncated, was reset or was left.
    """

    env: int
    moments: tuple[EnvMoment, ...]
    seed: int
    """Seed of the episode; negative if unknown."""
    played_by: TaskDescription | None = None
    """The version that made the last moment; None for the running one."""

    @property
    def steps(self) -> int:
        return len(self.moments) - 1

    @property
    def ended(self) -> bool:
        """Whether the task ended the episode; False if it still runs or was reset early."""
        moment, env = self.moments[-1]
        step = moment.as_recorded
        return bool(step.terminated[env] or step.truncated[env])


@dataclass(frozen=True)
class SaveRequest:
    """Episodes to record and what a worker needs for it. Independent of the history, which moves on meanwhile."""

    task: TaskDescription
    load: Load
    """The load of the running version, for another worker."""
    placed: tuple[PlaceCamera, ...]
    """Cameras that were placed by hand."""
    episodes: tuple[PastEpisode, ...]


def request_of(
    run: Run, env_idx: tuple[int, ...] | None, placed: tuple[PlaceCamera, ...], before: bool = False
) -> SaveRequest | str:
    """What to record of these envs (all if None): for each the episode that contains the shown moment; or the reason why
    there is nothing.

    Args:
        placed: cameras that were placed by hand.
        before: record the episode before that one.
    """
    load = run.running_load()
    if run.task is None or run.past is None or load is None:
        return "no task is loaded"
    shown = run.past.shown
    serial = None if shown is None else shown.serial
    envs = range(run.num_envs) if env_idx is None else env_idx
    found = {env: find_episode(run.past.history, env, serial, before) for env in envs}
    episodes = tuple(
        replace(episode, played_by=run.version_of(episode.moments[-1][0].serial))
        for episode in found.values()
        if isinstance(episode, PastEpisode)
    )
    if not episodes:
        env, why = next(iter(found.items()))
        return f"nothing was saved of env {env}: {why}"
    return SaveRequest(run.task, load, placed, episodes)


def find_episode(history: History, env: int, serial: int | None, before: bool = False) -> PastEpisode | str:
    """The episode of this env that contains a moment, up to its end; or the reason why none can be recorded.

    Args:
        serial: None for the running episode, or the one before if that has no step yet.
        before: the one before that.
    """
    if not len(history):
        return "there is no step yet"
    found = _episode_at(history, env, history.last if serial is None else serial)
    if isinstance(found, PastEpisode) and found.steps == 0 and serial is None:
        found = _episode_before(history, env, found) or found
    if before and isinstance(found, PastEpisode):
        found = _episode_before(history, env, found)
        while isinstance(found, PastEpisode) and found.steps == 0:  # it was reset at once
            found = _episode_before(history, env, found)
        found = found or "there is no episode before it in memory"
    if isinstance(found, PastEpisode) and found.steps == 0:
        return "the previous episode has no step: it was reset at once" if before else "it has no step yet"
    return found


def _episode_before(history: History, env: int, episode: PastEpisode) -> PastEpisode | str | None:
    """The episode before; None if it is no longer in memory."""
    begin = episode.moments[0][0].serial
    return _episode_at(history, env, begin - 1) if begin > history.first else None


def _episode_at(history: History, env: int, serial: int) -> PastEpisode | str:
    moments = history.episode(env, serial)
    if not moments:
        return "there is no step yet"
    first, of = moments[0]
    if not first.jumped[of] or first.step.elapsed_steps[of] != 0:
        return "its beginning is no longer in memory"
    if any(moment.snapshot is None for moment, _ in moments):
        return "the state of this task cannot be kept, so it cannot be replayed"
    for count, (moment, at) in enumerate(moments):
        step = moment.as_recorded
        if count > 0 and (step.terminated[at] or step.truncated[at]):
            moments = moments[: count + 1]
            break
    seed = -1 if first.seeds is None else int(first.seeds[of])
    return PastEpisode(env, moments, seed)


def moments_of(episodes: Sequence[PastEpisode]) -> list[tuple[Moment, dict[int, list[PastEpisode]]]]:
    """All their moments once, oldest first, each with the episodes that it belongs to, by env."""
    found: dict[int, tuple[Moment, dict[int, list[PastEpisode]]]] = {}
    for episode in episodes:
        for moment, env in episode.moments:
            found.setdefault(moment.serial, (moment, {}))[1].setdefault(env, []).append(episode)
    return [found[serial] for serial in sorted(found)]


_SAME_START = 1e-6
"""Tolerance of the start state: metres, and quaternion components."""


class PastSaver:
    """Records past episodes, one job at a time, in the background process.

    The history has poses, actions, rewards and results of ``evaluate`` as they were, and a snapshot of each moment. The
    rest (env states, observations, pictures of all cameras) is read from envs that are put back to the snapshots. So the
    file equals that of a live recording; but after an edit of the task's file that rest is what the new code gives. The
    recorded source is that of the version that played.
    """

    def __init__(
        self, folder: Path, finisher: EpisodeFinisher, on_change: Callable[[], None], process: Background
    ) -> None:
        self._folder, self._finisher, self._on_change = folder, finisher, on_change
        self._status = SaveStatus()
        self._process = process
        self._jobs = Jobs(on_change, self._failed)
        self._aside = Aside("keep-past")
        """Thread that writes, since the disk may be slow."""

    @on_loop
    def save(self, what: SaveRequest) -> None:
        """Start; cancels the running job."""
        self._report("")
        self._jobs.start(WAITING, lambda job: self._save(job, what))

    @on_loop
    def stop(self) -> None:
        """Cancel the running job; it writes no file."""
        self._jobs.stop()
        self._report("stopped; nothing was saved")

    @on_loop
    def refuse(self, why: str, at: object) -> None:
        """Report why nothing can be recorded of what is shown `at` now."""
        self._report(why, failed=True, refused_at=at)

    @on_loop
    def forget(self) -> None:
        """Drop the last result: something else is recorded, or another version runs."""
        if self._status.message:
            self._report("")

    def status(self, at: object) -> SaveStatus:
        """The status for what is shown `at` now."""
        status = self._status
        if status.refused_at not in (None, at):
            status = SaveStatus()
        return replace(status, progress=self._jobs.progress)

    def close(self) -> None:
        """Cancel the running job; returns when no more is written. Called on another thread than the loop."""
        do(self._jobs.close)
        self._aside.close()

    # --- the job -------------------------------------------------------------------------------------

    async def _save(self, job: Job, what: SaveRequest) -> None:
        seeds: dict[int, int] = {}
        writers: dict[int, GatheredEpisode] = {}
        moments, packer = deque(moments_of(what.episodes)), BatchPacker()
        total = len(moments)

        async def redraw() -> None:
            """Continue with the first moment that is not captured yet: a job of higher rank may have interrupted this one."""
            await self._process.ensure(job, what.load, what.placed)
            for episode in what.episodes:
                if episode.env not in seeds:
                    job.report(len(seeds), len(what.episodes), "trying the seeds")
                    seeds[episode.env] = await self._verified_seed(episode)
            while moments:
                job.report(total - len(moments), total, "rendering it again")
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
                        writer = self._begun(what, episode, seeds[episode.env])
                        writers[episode.env] = writer
                    writer.take(packer, moment.as_recorded, row, captured.columns, captured.pictures)

        def discard() -> None:
            for episode in writers.values():
                episode.writer.discard()

        def finish() -> list[str]:
            made = [self._finisher.finish(episode) for episode in writers.values()]
            return [result for future in made if isinstance(result := future.result(), str)]

        try:
            await self._process.in_turns(job, redraw)
        except BaseException as error:
            self._aside.begin(discard)
            if isinstance(error, RecordingError | ValueError):
                raise JobFailed(f"it could not be saved: {error}") from error
            raise
        job.report(1, 1, "writing the files")
        if problems := await self._aside.run(finish):
            raise JobFailed(problems[0])
        steps = sum(episode.steps for episode in what.episodes)
        unfinished = sum(not episode.ended for episode in what.episodes)
        lost = sum(seeds[episode.env] != episode.seed for episode in what.episodes)
        envs = what.episodes[0].env if len(what.episodes) == 1 else None
        which = f"{len(writers)} episodes" if envs is None else f"an episode of env {envs}"
        kept = f"saved {which}, {steps} step{'' if steps == 1 else 's'}"
        earlier = sum(
            _as_played(what.task, episode).source_hash != what.task.source_hash for episode in what.episodes
        )
        self._report(
            kept
            + _unfinished_text(unfinished, len(writers))
            + _lost_seed_text(lost, len(writers))
            + _earlier_text(earlier, len(writers))
        )

    def _begun(self, what: SaveRequest, episode: PastEpisode, seed: int) -> GatheredEpisode:
        """The episode's recording, with what its source does not say of the pictures. Raises RecordingError."""
        task = _as_played(what.task, episode)
        observed_by = "" if task.source_hash == what.task.source_hash else what.task.source_hash
        writer = GatheredEpisode.of(self._folder, task, episode.env, seed, observed_by=observed_by)
        writer.set_placed(
            {p.key: p.settings for p in what.placed if p.settings}, _cameras_in_source(what.task, episode)
        )
        return writer

    async def _verified_seed(self, episode: PastEpisode) -> int:
        """Seed of the episode, if a reset of its env alone with this seed gives the first state; else -1.

        What envs that were reset together drew from torch's generator depends on all of them.
        """
        if episode.seed < 0:
            return episode.seed
        first, env = episode.moments[0]
        step = await self._process.ask(Reset((env,), episode.seed))
        now, then = step.poses[env], first.as_recorded.poses[env]
        return episode.seed if np.allclose(now, then, rtol=0, atol=_SAME_START, equal_nan=True) else -1

    def _failed(self, failure: JobFailed) -> None:
        why, problem = str(failure), failure.problem
        if problem is not None:
            where = "" if problem.line is None else f" (line {problem.line})"
            why = f"it could not be rendered again: {problem.message}{where}"
        self._report(why, failed=True)

    def _report(self, message: str, failed: bool = False, refused_at: object = None) -> None:
        self._status = SaveStatus(message, failed, refused_at)
        self._on_change()


def _as_played(task: TaskDescription, episode: PastEpisode) -> TaskDescription:
    """The running version with the source that made the episode's rewards: its scene and cameras are in the pictures."""
    played = episode.played_by
    if played is None:
        return task
    return replace(task, file=played.file, source_hash=played.source_hash, source=played.source)


def _cameras_in_source(task: TaskDescription, episode: PastEpisode) -> dict[CameraKey, CameraSettings]:
    """Settings in the version that played, for the cameras that the running version has elsewhere."""
    now = {camera.key: camera.settings for camera in task.cameras}
    played = () if episode.played_by is None else episode.played_by.cameras
    return {
        camera.key: camera.settings
        for camera in played
        if camera.settings is not None
        and (here := now.get(camera.key)) is not None
        and differences(camera.settings, here)
    }


def _unfinished_text(count: int, kept: int) -> str:
    if not count:
        return ""
    if kept == 1:
        return "; it had not ended"
    return "; none of them had ended" if count == kept else f"; {count} of them had not ended"


def _lost_seed_text(count: int, kept: int) -> str:
    if not count:
        return ""
    what = "" if count == kept else f"{count} "
    return f"; {what}without a seed (the start came from a reset of many envs): replayed from the first state"


def _earlier_text(count: int, kept: int) -> str:
    if not count:
        return ""
    what = "it was" if kept == 1 else "they were" if count == kept else f"{count} were"
    return (
        f"; {what} played by an earlier version of the file: that source and its rewards are recorded, observations and "
        "pictures are the present version's"
    )
