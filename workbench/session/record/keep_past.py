"""Keep what I just saw: an episode of the past becomes a recording after the fact.

An episode is what an env lived through from a reset on, through the moments that it was put back to, until it
terminated, was truncated, or was reset or left. That is what the Record button gathers while it happens; here it is
found afterwards, and only where its beginning is still in memory, since an episode without its reset could not be
made again.

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
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from workbench.jobs.gather import EpisodeFinisher, GatheredEpisode
from workbench.jobs.task import TaskDescription
from workbench.recording.episode.columns import BatchPacker
from workbench.recording.writing.publish import RecordingError
from workbench.session.history.history import EnvMoment, History, Moment
from workbench.session.process.askers import WAITING, Background
from workbench.session.process.job_lane import Job, JobFailed, JobLane
from workbench.session.protocol.messages import Load, PlaceCamera, Reset
from workbench.session.protocol.questions import CaptureMoment
from workbench.session.record.status import KeepStatus


@dataclass(frozen=True)
class PastEpisode:
    """The moments of one env's episode, oldest first; the first is its reset."""

    env: int
    moments: tuple[EnvMoment, ...]
    seed: int
    """Below 0 where it is not known."""

    @property
    def steps(self) -> int:
        return len(self.moments) - 1

    @property
    def ended(self) -> bool:
        """Whether the task ended it; else it runs, or was reset before."""
        moment, env = self.moments[-1]
        step = moment.as_recorded
        return bool(step.terminated[env] or step.truncated[env])


@dataclass(frozen=True)
class WhatToKeep:
    """Everything that the work needs; it goes on while the history moves on."""

    task: TaskDescription
    load: Load
    """How another worker gets the version that runs."""
    placed: tuple[PlaceCamera, ...]
    """Cameras that stand elsewhere than the file says."""
    episodes: tuple[PastEpisode, ...]


def episode_round(history: History, env: int, serial: int | None, before: bool = False) -> PastEpisode | str:
    """The episode of this env round a moment, to where it ended; or in a sentence why there is none to keep.

    Args:
        serial: None for what was just seen: the episode that runs, or the one before if that has no step yet.
        before: the one before that.
    """
    if not len(history):
        return "nothing was seen yet"
    found = _of(history, env, history.last if serial is None else serial)
    if isinstance(found, PastEpisode) and found.steps == 0 and serial is None:
        found = _before(history, env, found) or found
    if before and isinstance(found, PastEpisode):
        found = _before(history, env, found) or "there is no episode before it in memory"
    if isinstance(found, PastEpisode) and found.steps == 0:
        return "its episode has no step yet"
    return found


def _before(history: History, env: int, episode: PastEpisode) -> PastEpisode | str | None:
    """The one before; None where that is not in memory any more."""
    begin = episode.moments[0][0].serial
    return _of(history, env, begin - 1) if begin > history.first else None


def _of(history: History, env: int, serial: int) -> PastEpisode | str:
    moments = history.episode(env, serial)
    if not moments:
        return "nothing was seen yet"
    first, of = moments[0]
    if not first.jumped[of] or first.step.elapsed_steps[of] != 0:
        return "its beginning is no longer in memory"
    if any(moment.snapshot is None for moment, _ in moments):
        return "the state of this task cannot be kept, so what was seen cannot be put back"
    for count, (moment, at) in enumerate(moments):
        step = moment.as_recorded
        if count > 0 and (step.terminated[at] or step.truncated[at]):
            moments = moments[: count + 1]
            break
    seed = -1 if first.seeds is None else int(first.seeds[of])
    return PastEpisode(env, moments, seed)


def moments_of(episodes: Sequence[PastEpisode]) -> list[tuple[Moment, dict[int, list[PastEpisode]]]]:
    """All their moments once, oldest first; and of each, by env, the episodes that it is a moment of."""
    found: dict[int, tuple[Moment, dict[int, list[PastEpisode]]]] = {}
    for episode in episodes:
        for moment, env in episode.moments:
            found.setdefault(moment.serial, (moment, {}))[1].setdefault(env, []).append(episode)
    return [found[serial] for serial in sorted(found)]


_SAME_START = 1e-6
"""Metres and quaternion components."""


class PastKeeper:
    """Keeps episodes, one job at a time."""

    def __init__(
        self, folder: Path, finisher: EpisodeFinisher, on_change: Callable[[], None], process: Background
    ) -> None:
        self._folder, self._finisher, self._on_change = folder, finisher, on_change
        self._status = KeepStatus()
        self._process = process
        self._job_lane = JobLane("keep-past", on_change, self._failed)

    def keep(self, what: WhatToKeep) -> None:
        """Begin; what was under way is given up."""
        self._say("")
        self._job_lane.start(WAITING, lambda job: self._keep(job, what))

    def stop(self) -> None:
        """Give up; nothing of it is kept."""
        self._job_lane.stop()
        self._say("stopped; nothing was kept")

    def refuse(self, why: str) -> None:
        """Say why nothing can be kept."""
        self._say(why, failed=True)

    def status(self) -> KeepStatus:
        return replace(self._status, progress=self._job_lane.progress)

    def close(self) -> None:
        self._job_lane.close()

    # --- on the lane's thread --------------------------------------------------------------------------

    def _keep(self, job: Job, what: WhatToKeep) -> None:
        seeds: dict[int, int] = {}
        writers: dict[int, GatheredEpisode] = {}
        moments, packer = deque(moments_of(what.episodes)), BatchPacker()
        total = len(moments)

        def see_again() -> None:
            """From where it gave way."""
            self._process.ensure(job, what.load, what.placed)
            for episode in what.episodes:
                if episode.env not in seeds:
                    job.tell(len(seeds), len(what.episodes), "trying the seeds")
                    seeds[episode.env] = self._sure_seed(job, episode)
            while moments:
                job.tell(total - len(moments), total, "drawing it again")
                moment, rows = moments[0]
                question = CaptureMoment(pickle.dumps(moment.snapshot), tuple(rows), what.task.can_render)
                captured = self._process.ask(job.check, question)
                del moments[0]
                for row, episodes in rows.items():
                    for episode in episodes:
                        if (writer := writers.get(episode.env)) is not None:
                            writer.acts(moment.acted_by)
                        else:
                            seed = seeds[episode.env]
                            writer = GatheredEpisode.of(self._folder, what.task, episode.env, seed)
                            writers[episode.env] = writer
                        writer.take(packer, moment.as_recorded, row, captured.columns, captured.pictures)

        try:
            self._process.in_turns(job, see_again)
        except BaseException as error:
            for episode in writers.values():
                episode.writer.discard()
            if isinstance(error, RecordingError | ValueError):
                raise JobFailed(f"it could not be kept: {error}") from error
            raise
        job.tell(1, 1, "writing the files")
        made = [self._finisher.finish(episode) for episode in writers.values()]
        problems = [result for future in made if isinstance(result := future.result(), str)]
        if problems:
            raise JobFailed(problems[0])
        steps = sum(episode.steps for episode in what.episodes)
        unfinished = sum(not episode.ended for episode in what.episodes)
        lost = sum(seeds[episode.env] != episode.seed for episode in what.episodes)
        kept = f"kept {len(made)} episode{'' if len(made) == 1 else 's'}, {steps} steps"
        self._say(kept + _not_ended(unfinished, len(made)) + _no_seed(lost, len(made)))

    def _sure_seed(self, job: Job, episode: PastEpisode) -> int:
        """Its seed, if a reset of its env alone with that gives its first state; else below 0.

        What envs that were reset together drew from torch's generator hangs on all of them.
        """
        if episode.seed < 0:
            return episode.seed
        first, env = episode.moments[0]
        step = self._process.ask(job.check, Reset((env,), episode.seed))
        now, then = step.poses[env], first.as_recorded.poses[env]
        return episode.seed if np.allclose(now, then, rtol=0, atol=_SAME_START, equal_nan=True) else -1

    def _failed(self, job: Job, failure: JobFailed) -> None:
        why, problem = str(failure), failure.problem
        if problem is not None:
            where = "" if problem.line is None else f" (line {problem.line})"
            why = f"it could not be drawn again: {problem.message}{where}"
        if not job.stopped:
            self._say(why, failed=True)

    def _say(self, words: str, failed: bool = False) -> None:
        self._status = KeepStatus(said=words, failed=failed)
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
