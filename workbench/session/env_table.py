"""One row an env: how its episode stands, what came of the one before, and what was odd about it.

The page shows one env's numbers and the batch's mean; neither says which of sixty-four envs to look at. This
does: it follows every reset and control step of the batch. A step costs array operations over the batch; sentences
are made only for what is out of the ordinary.

An episode *ends* with the first step that is terminated or truncated. What happens after it (the player may let
it run on) does not change its outcome. With the usual rule the env is reset at once, and nobody would ever read
"failed" in its row; so a row also has the outcome of the episode before.

An env that is put back to a moment of the past has its row put back too: to what the rows were at that moment, of the
env whose moment it is. Only the counts of episodes that ended go on, since those did end.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Mapping
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from workbench.core.geometry import SceneGeometry
from workbench.core.step import StepResult
from workbench.session.messages import Restored, Stepped
from workbench.session.outliers import Kind, Outlier, OutlierWatch

KEPT_REWARDS = 100
"""Steps of an episode whose rewards a row has; the newest where there are more."""
LOST_REWARD = (Kind.REWARD, Kind.NOT_A_NUMBER)
"""What `EnvRows.first` calls a reward that is NaN or infinite."""
Outliers = Mapping[int, tuple[Outlier, ...]]
"""By env, oldest first; envs without any are not in it."""


class Outcome(IntEnum):
    RUNNING = 0
    SUCCESS = 1
    FAIL = 2
    TRUNCATED = 3


@dataclass(frozen=True)
class LastEpisode:
    """The episode before the present one, of each env; only of those that ended or had outliers."""

    outcome: NDArray[np.int8]
    """(N,) `Outcome`; RUNNING where it was cut short, or there was none (then `steps` is -1)."""
    steps: NDArray[np.int32]
    """(N,) control steps until its end."""
    total: NDArray[np.float64]
    """(N,) its return until its end."""
    outliers: Outliers

    def with_those(self, envs: NDArray[np.bool_], other: LastEpisode) -> LastEpisode:
        """The same, but of these envs (N,) what `other` says."""
        return LastEpisode(
            np.where(envs, other.outcome, self.outcome),
            np.where(envs, other.steps, self.steps),
            np.where(envs, other.total, self.total),
            _of_those(envs, other.outliers, self.outliers),
        )


@dataclass(frozen=True)
class EnvRows:
    """The whole table at one moment. Its arrays are never written to, and what did not change since the moment before
    is shared with that: what a step adds is one array of returns."""

    steps: NDArray[np.int32]
    """(N,) control steps of the present episode."""
    outcome: NDArray[np.int8]
    """(N,) `Outcome` of the present episode, RUNNING until it ends."""
    end: NDArray[np.int32]
    """(N,) the step at which it ended; -1 while it runs."""
    total: NDArray[np.float64]
    """(N,) undiscounted return so far; NaN after a reward that is."""
    followed: NDArray[np.bool_]
    """(N,) whether the episode was followed from its start; of another there is no return."""
    first: Mapping[Hashable, NDArray[np.int32]]
    """(N,) the first step at which it was so (0: after the reset); -1: never. By bool entry of ``evaluate``, by `Kind`
    of outlier, and of `LOST_REWARD`."""
    outliers: Outliers
    last: LastEpisode
    ended: NDArray[np.int64]
    """(N,) episodes that ended since the task was loaded."""
    succeeded: NDArray[np.int64]
    """(N,) those of them that ended in success."""
    rewards: NDArray[np.float32]
    """(N, `KEPT_REWARDS`) oldest first; NaN before the episode's start. (N, 0) in what a moment of the past keeps."""

    @property
    def num_envs(self) -> int:
        return len(self.steps)

    @property
    def first_true(self) -> dict[str, NDArray[np.int32]]:
        """`first` of the entries of ``evaluate``."""
        return {what: steps for what, steps in self.first.items() if isinstance(what, str)}

    @staticmethod
    def bytes_a_step(num_envs: int) -> int:
        """What one more of them takes, nearly always."""
        return 8 * num_envs + 400


class EnvTable:
    """Follows the batch; `add` every event in order, ask for `rows` when they are to be shown."""

    def __init__(
        self, geometry: SceneGeometry, first: StepResult, control_dt: float, reward_mode: str
    ) -> None:
        """
        Args:
            first: the state that the task was loaded with (a reset of all envs).
        """
        count = len(first.reward)
        never, nothing = np.full(count, -1, np.int32), np.zeros(count)
        zero, none = np.zeros(count, np.int8), np.zeros(count, np.int64)
        self._watch = OutlierWatch(geometry, first, control_dt, reward_mode)
        self._rewards = np.full((count, KEPT_REWARDS), np.nan, np.float32)
        self._tick = 0
        self._now = EnvRows(
            steps=first.elapsed_steps,
            outcome=zero,
            end=never,
            total=nothing,
            followed=np.ones(count, bool),
            first={},
            outliers={},
            last=LastEpisode(zero, never, nothing, {}),
            ended=none,
            succeeded=none,
            rewards=self._rewards[:, :0].copy(),
        )
        self._begin(np.ones(count, bool), first)

    def add(
        self, stepped: Stepped, then: EnvRows | None, rewards_then: Callable[[int], NDArray[np.float32]]
    ) -> EnvRows:
        """Take one event: a reset of some envs, a going back, or a control step of all.

        Args:
            then: the rows at the moment that was gone back to. None for no going back, or one to a moment that is not
                known: the rows of its envs begin anew, from where nobody can say what came before.
            rewards_then: those of an env's episode until then, oldest first.

        Returns:
            the rows as a moment keeps them.
        """
        step, jumped = stepped.step, stepped.reset_mask
        if jumped.any():
            begun = step.elapsed_steps != self._now.steps
            self._begin(begun if stepped.resumed else jumped | begun, step)
            if stepped.restored is not None and then is not None:
                self._put_back(stepped.restored, then, rewards_then)
            return self._now
        moved = step.elapsed_steps != self._now.steps + 1
        if moved.any():
            self._begin(moved, step)
        self._rewards[:, self._tick % KEPT_REWARDS] = step.reward
        self._tick += 1
        self._step(step)
        return self._now

    def rows(self) -> EnvRows:
        """The table as it is now."""
        oldest_first = np.arange(self._tick, self._tick + KEPT_REWARDS) % KEPT_REWARDS
        return replace(self._now, rewards=self._rewards[:, oldest_first])

    def _step(self, step: StepResult) -> None:
        now, first, outliers = self._now, dict(self._now.first), self._now.outliers
        for name, so in _flags(step):
            _note(first, name, so, step)
        _note(first, LOST_REWARD, ~np.isfinite(step.reward), step)
        for sight in self._watch.look(step):
            for env in np.flatnonzero(_note(first, sight.kind, sight.envs, step)).tolist():
                outlier = Outlier(sight.kind, int(step.elapsed_steps[env]), sight.reason(env))
                outliers = {**outliers, env: (*outliers.get(env, ()), outlier)}
        same = all(steps is now.first.get(what) for what, steps in first.items())
        running = now.end < 0
        self._now = replace(
            now,
            steps=step.elapsed_steps,
            total=now.total + np.where(running, step.reward, 0.0),
            first=now.first if same else first,
            outliers=outliers,
        )
        ends = (step.terminated | step.truncated) & running
        if ends.any():
            success = dict(_flags(step)).get("success", np.zeros(len(ends), bool))
            # An env may be terminated by neither (a task with its own rule): that is no success.
            lost = np.where(step.terminated, Outcome.FAIL, Outcome.TRUNCATED)
            outcome = np.where(success, Outcome.SUCCESS, lost).astype(np.int8)
            self._now = replace(
                self._now,
                outcome=np.where(ends, outcome, now.outcome),
                end=np.where(ends, step.elapsed_steps, now.end),
                ended=now.ended + ends,
                succeeded=now.succeeded + (ends & success),
            )

    def _begin(self, envs: NDArray[np.bool_], step: StepResult) -> None:
        """A new episode in these envs (N,): what was known of the one before becomes "last"."""
        now, from_start = self._now, step.elapsed_steps == 0
        worth_keeping = envs & ((now.end >= 0) | np.isin(np.arange(len(envs)), list(now.outliers)))
        until = np.where(now.end < 0, now.steps, now.end)
        before = LastEpisode(now.outcome, until, now.total, now.outliers)
        first = {what: np.where(envs, np.int32(-1), steps) for what, steps in now.first.items()}
        for name, so in _flags(step):
            _note(first, name, so & envs, step)
        self._now = replace(
            now,
            steps=np.where(envs, step.elapsed_steps, now.steps),
            outcome=np.where(envs, np.int8(Outcome.RUNNING), now.outcome),
            end=np.where(envs, np.int32(-1), now.end),
            total=np.where(envs, np.where(from_start, 0.0, np.nan), now.total),
            followed=np.where(envs, from_start, now.followed),
            first=first,
            outliers=_of_those(envs, {}, now.outliers),
            last=now.last.with_those(worth_keeping, before) if worth_keeping.any() else now.last,
        )
        self._rewards[envs] = np.nan
        self._watch.begin(envs, step)

    def _put_back(
        self, restored: Restored, then: EnvRows, rewards_then: Callable[[int], NDArray[np.float32]]
    ) -> None:
        """The rows of these envs as they stood at the moment that they went back to."""
        now, every = self._now, np.arange(self._now.num_envs)
        source = every.copy()
        source[list(restored.env_idx)] = restored.source
        put = np.isin(every, restored.env_idx)

        def taken(old: NDArray, new: NDArray | None) -> NDArray:
            return old if new is None else np.where(put, new[source], old)

        self._now = replace(
            now,
            outcome=taken(now.outcome, then.outcome),
            end=taken(now.end, then.end),
            total=taken(now.total, then.total),
            followed=taken(now.followed, then.followed),
            first={what: taken(steps, then.first.get(what)) for what, steps in now.first.items()},
            outliers=_of_those(
                put, {env: then.outliers.get(int(source[env]), ()) for env in restored.env_idx}, now.outliers
            ),
            # The episode before is an env's own, whoever's moment it goes on from.
            last=now.last.with_those(put & (source == every), then.last),
        )
        for env, of in zip(restored.env_idx, restored.source, strict=True):
            rewards = rewards_then(of)
            self._rewards[env, np.arange(self._tick - len(rewards), self._tick) % KEPT_REWARDS] = rewards


def _flags(step: StepResult) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    """The entries of ``evaluate`` that say yes or no of each env, success and fail of whatever type; (N,) each."""
    for name, values in step.evaluate.items():
        if name in ("success", "fail") or (values.dtype == np.bool_ and values.ndim == 1):
            yield name, values.reshape(len(step.reward), -1)[:, 0].astype(bool)


def _note(
    first: dict[Hashable, NDArray[np.int32]], what: Hashable, so: NDArray[np.bool_], step: StepResult
) -> NDArray[np.bool_]:
    """Note in `first` where it is so for the first time in an episode; returns where."""
    known = first.get(what)
    if known is None:
        known = first[what] = np.full(len(so), -1, np.int32)
    new = so & (known < 0)
    if new.any():
        first[what] = np.where(new, step.elapsed_steps, known)
    return new


def _of_those(envs: NDArray[np.bool_], new: Outliers, old: Outliers) -> Outliers:
    """Of these envs (N,) the new ones, of the others the old."""
    kept = {env: seen for env, seen in old.items() if not envs[env]}
    return {**kept, **{env: seen for env, seen in new.items() if seen and envs[env]}}
