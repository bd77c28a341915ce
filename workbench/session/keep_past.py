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
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from workbench.recording.columns import BatchPacker
from workbench.recording.landing import RecordingError
from workbench.session.askers import Background
from workbench.session.episode_files import EpisodeFinisher
from workbench.session.episodes import GatheredEpisode
from workbench.session.lane import Job, JobFailed, Lane
from workbench.session.messages import Reset
from workbench.session.past_episodes import PastEpisode, WhatToKeep, moments_of
from workbench.session.questions import CaptureMoment
from workbench.session.view import KeepStatus

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
        self._lane = Lane("keep-past", on_change, self._failed)

    def keep(self, what: WhatToKeep) -> None:
        """Begin; what was under way is given up."""
        self._say("")
        self._lane.start("waiting for other work in the background", lambda job: self._keep(job, what))

    def stop(self) -> None:
        """Give up; nothing of it is kept."""
        self._lane.stop()
        self._say("stopped; nothing was kept")

    def refuse(self, why: str) -> None:
        """Say why nothing can be kept."""
        self._say(why, failed=True)

    def status(self) -> KeepStatus:
        if (progress := self._lane.progress) is not None:
            return KeepStatus(True, progress.what, progress.done, progress.total)
        return self._status

    def close(self) -> None:
        self._lane.close()

    # --- on the lane's thread --------------------------------------------------------------------------

    def _keep(self, job: Job, what: WhatToKeep) -> None:
        with self._process.turn(job):
            self._process.ensure(job, what.load, what.placed)
            what, lost = self._with_sure_seeds(job, what)
            writers: dict[int, GatheredEpisode] = {}
            try:
                self._capture_all(job, what, writers)
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
        step = self._process.ask(job.check, Reset((env,), episode.seed))
        return np.allclose(
            step.poses[env], first.as_recorded.poses[env], rtol=0, atol=_SAME_START, equal_nan=True
        )

    def _capture_all(self, job: Job, what: WhatToKeep, writers: dict[int, GatheredEpisode]) -> None:
        moments, packer = moments_of(what.episodes), BatchPacker()
        rows: dict[int, dict[int, list[tuple[PastEpisode, bool]]]] = {}
        for episode in what.episodes:
            for index, (moment, env) in enumerate(episode.moments):
                rows.setdefault(moment.serial, {}).setdefault(env, []).append((episode, index == 0))
        for done, (moment, envs) in enumerate(moments):
            job.tell(done, len(moments), "drawing it again")
            snapshot = pickle.dumps(what.snapshots[moment.serial])
            captured = self._process.ask(job.check, CaptureMoment(snapshot, envs, what.task.can_render))
            columns, pictures, step = captured.columns, captured.pictures, moment.as_recorded
            for env in envs:
                for episode, is_first in rows[moment.serial][env]:
                    if is_first:
                        writers[episode.env] = GatheredEpisode.of(
                            self._folder, what.task, episode.env, episode.seed
                        )
                    else:
                        writers[episode.env].acts(moment.acted_by)
                    writers[episode.env].take(packer, step, env, columns, pictures)

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
