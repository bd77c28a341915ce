"""Episodes out of the history: which moments a recording of them would have held.

An episode is what an env lived through from a reset on, through the moments that it was put back to, until it
terminated, was truncated, or was reset or left. That is what the Record button gathers while it happens; here it is
found afterwards, and only where its beginning is still in memory, since an episode without its reset could not be
made again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from workbench.core.snapshot_bytes import WholeSnapshot
from workbench.session.history import History, Lived, Moment
from workbench.session.messages import Load, PlaceCamera, TaskDescription


@dataclass(frozen=True)
class PastEpisode:
    """The moments of one env's episode, oldest first; the first is its reset."""

    env: int
    moments: tuple[Lived, ...]
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

    @property
    def success(self) -> bool | None:
        """At its last moment; None for a task that says nothing of it."""
        moment, env = self.moments[-1]
        found = moment.as_recorded.evaluate.get("success")
        return None if found is None else bool(np.any(found[env]))


@dataclass(frozen=True)
class WhatToKeep:
    """Everything that the work needs; it goes on while the history moves on."""

    task: TaskDescription
    load: Load
    """How another worker gets the version that runs."""
    placed: tuple[PlaceCamera, ...]
    """Cameras that stand elsewhere than the file says."""
    episodes: tuple[PastEpisode, ...]
    snapshots: dict[int, WholeSnapshot]
    """Of their moments, by serial."""


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
    lived = history.episode(env, serial)
    if not lived:
        return "nothing was seen yet"
    first, of = lived[0]
    if not first.jumped[of] or first.step.elapsed_steps[of] != 0:
        return "its beginning is no longer in memory"
    if any(not moment.snapshot for moment, _ in lived):
        return "the state of this task cannot be kept, so what was seen cannot be put back"
    for count, (moment, at) in enumerate(lived):
        step = moment.as_recorded
        if count > 0 and (step.terminated[at] or step.truncated[at]):
            lived = lived[: count + 1]
            break
    seed = -1 if first.seeds is None else int(first.seeds[of])
    return PastEpisode(env, lived, seed)


def moments_of(episodes: Sequence[PastEpisode]) -> list[tuple[Moment, tuple[int, ...]]]:
    """All their moments once, oldest first, with the numbers of the envs that have it in their episode."""
    envs: dict[int, dict[int, None]] = {}
    moments: dict[int, Moment] = {}
    for episode in episodes:
        for moment, env in episode.moments:
            moments[moment.serial] = moment
            envs.setdefault(moment.serial, {})[env] = None
    return [(moments[serial], tuple(envs[serial])) for serial in sorted(moments)]
