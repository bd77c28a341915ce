"""One row per env: state of its episode, outcome of the previous one, and outliers."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from workbench.envs.gpu_rules import Finding
from workbench.envs.outliers import Outlier, OutlierKind, OutlierSighting, OutlierWatch
from workbench.envs.scene.shapes import SceneGeometry
from workbench.envs.step_result import StepResult
from workbench.task.description import Restored, Stepped

KEPT_REWARDS = 100
"""Number of the newest rewards of an episode that a row holds."""
Outliers = Mapping[int, tuple[Outlier, ...]]
"""Outliers by env, oldest first; only envs with outliers."""


class Outcome(IntEnum):
    RUNNING = 0
    SUCCESS = 1
    FAIL = 2
    TRUNCATED = 3


EnvEvent = Literal["failed", "limit", "flagged"]
"""The end of an episode by fail or at the time limit, or the first outlier of an episode."""


@dataclass(frozen=True)
class LastEpisode:
    """For each env: the last episode, before the present one, that ended or had outliers.

    Envs are reset as soon as an episode ends, so "failed" would never be visible in the row of the present episode.
    """

    outcome: NDArray[np.int8]
    """(N,) `Outcome`; RUNNING if the episode was cut short, or if there was none (then `steps` is -1)."""
    steps: NDArray[np.int32]
    """(N,) control steps until the end of the episode."""
    total: NDArray[np.float64]
    """(N,) return until the end of the episode."""
    outliers: Outliers

    def with_envs(self, envs: NDArray[np.bool_], other: LastEpisode) -> LastEpisode:
        """A copy with the values of `other` in these envs (N,)."""
        return LastEpisode(
            np.where(envs, other.outcome, self.outcome),
            np.where(envs, other.steps, self.steps),
            np.where(envs, other.total, self.total),
            _merged(envs, other.outliers, self.outliers),
        )


@dataclass(frozen=True)
class EnvRows:
    """The whole table at one moment. Arrays are never changed in place, and unchanged arrays are shared with
    the previous moment: most steps add only an array of returns."""

    steps: NDArray[np.int32]
    """(N,) control steps of the present episode."""
    outcome: NDArray[np.int8]
    """(N,) `Outcome` of the present episode, RUNNING until it ends."""
    end: NDArray[np.int32]
    """(N,) the first terminated or truncated step; -1 while the episode runs. Later steps do not change the outcome."""
    total: NDArray[np.float64]
    """(N,) undiscounted return so far; NaN after a NaN reward."""
    followed: NDArray[np.bool_]
    """(N,) whether `total` is known: the task has a reward, and the episode was followed from its start."""
    first: Mapping[Hashable, NDArray[np.int32]]
    """For each entry: (N,) the first step of the episode at which it was true; 0 is the reset, -1 is never.
    Keys are the names of bool entries of ``evaluate``, and `OutlierKind` values, even if their rule is
    off."""
    outliers: Outliers
    by_hand: NDArray[np.bool_]
    """(N,) whether a person moved or pulled a body in the present episode. What flies or falls then is not the task's
    mistake."""
    last: LastEpisode
    ended: NDArray[np.int64]
    """(N,) number of episodes that ended since the task was loaded."""
    succeeded: NDArray[np.int64]
    """(N,) number of the ended episodes that ended in success."""
    failed: NDArray[np.int64]
    """(N,) number of the ended episodes that ended by fail, or were terminated without success. The episodes
    counted neither here nor in `succeeded` reached the time limit."""
    rewards: NDArray[np.float32]
    """(N, `KEPT_REWARDS`) rewards, oldest first; NaN before the episode's start. (N, 0) in a moment of the history."""

    @property
    def num_envs(self) -> int:
        return len(self.steps)

    @property
    def first_true(self) -> dict[str, NDArray[np.int32]]:
        """The part of `first` that is about entries of ``evaluate``."""
        return {what: steps for what, steps in self.first.items() if isinstance(what, str)}

    @staticmethod
    def bytes_a_step(num_envs: int) -> int:
        """Bytes that one more moment's rows usually take."""
        return 8 * num_envs + 400


def event_step(rows: EnvRows, env: int, event: EnvEvent) -> int | None:
    """The step of an env's present episode at which this event happened; None if it has not happened."""
    if event == "flagged":
        return rows.outliers[env][0].step if env in rows.outliers else None
    wanted = Outcome.FAIL if event == "failed" else Outcome.TRUNCATED
    return int(rows.end[env]) if rows.outcome[env] == wanted else None


class EnvTable:
    """Updates the table with every reset and control step of the batch, by array operations. Call `add` with
    every event, in order.

    If an env goes back to a moment, its row becomes the row that the source env (whose state it takes) had at
    that moment. The counts of ended episodes continue, and an env that takes another env's state keeps its
    own last episode.
    """

    def __init__(
        self,
        geometry: SceneGeometry,
        first: StepResult,
        control_dt: float,
        reward_mode: str,
        rules: Mapping[str, Finding],
    ) -> None:
        """
        Args:
            first: the state that the task was loaded with (a reset of all envs).
            rules: as `TaskDescription.outlier_rules`; an outlier of any other rule flags no env.
        """
        count = len(first.reward)
        never, nothing = np.full(count, -1, np.int32), np.zeros(count)
        zero, none = np.zeros(count, np.int8), np.zeros(count, np.int64)
        self._has_reward = reward_mode != "none"
        self._watch = OutlierWatch(geometry, first, control_dt, reward_mode)
        self._rewards = np.full((count, KEPT_REWARDS), np.nan, np.float32)
        self._tick = 0
        self._rules, self._found = rules, dict[str, Finding]()
        self._now = EnvRows(
            steps=first.elapsed_steps,
            outcome=zero,
            end=never,
            total=nothing,
            followed=np.full(count, self._has_reward),
            first={},
            outliers={},
            by_hand=np.zeros(count, bool),
            last=LastEpisode(zero, never, nothing, {}),
            ended=none,
            succeeded=none,
            failed=none,
            rewards=self._rewards[:, :0].copy(),
        )
        self._begin(np.ones(count, bool), first)

    def add(
        self,
        stepped: Stepped,
        then: EnvRows | None,
        rewards_then: Callable[[int], NDArray[np.float32]],
        limited: bool = True,
    ) -> EnvRows:
        """Add one event: a reset of some envs, a jump back, or a control step of all envs.

        Args:
            then: the rows at the moment that some envs went back to. None without a jump back, or if that moment is
                unknown. If it is unknown, the rows of these envs begin without a past.
            rewards_then: returns the rewards of an env's episode up to that moment, oldest first.
            limited: whether the time limit ends the episodes.

        Returns:
            The rows to store in the moment.
        """
        step, jumped = stepped.step, stepped.reset_mask
        if jumped.any():
            begun = step.elapsed_steps != self._now.steps
            self._begin(begun if stepped.resumed else jumped | begun, step)
            if stepped.restored is not None and then is not None:
                self._put_back(stepped.restored, then, rewards_then)
            if stepped.restored is not None and stepped.restored.moved:
                self._note_hand(stepped.restored.env_idx)
            return self._now
        moved = step.elapsed_steps != self._now.steps + 1
        if moved.any():
            self._begin(moved, step)
        self._rewards[:, self._tick % KEPT_REWARDS] = step.reward if self._has_reward else np.nan
        self._tick += 1
        if stepped.pulled is not None:
            self._note_hand((stepped.pulled.env,))
        self._step(step, limited)
        return self._now

    def _note_hand(self, env_idx: Sequence[int]) -> None:
        if not self._now.by_hand[list(env_idx)].all():
            by_hand = self._now.by_hand.copy()
            by_hand[list(env_idx)] = True
            self._now = replace(self._now, by_hand=by_hand)

    @property
    def findings(self) -> tuple[Finding, ...]:
        """The rules that the running version broke by outliers, one finding per rule."""
        return tuple(self._found.values())

    def begin_version(self, rules: Mapping[str, Finding]) -> None:
        """Drop the findings of the old code and keep the rows, because the code has changed."""
        self._rules, self._found = rules, {}

    def rows(self) -> EnvRows:
        """The present table."""
        oldest_first = np.arange(self._tick, self._tick + KEPT_REWARDS) % KEPT_REWARDS
        return replace(self._now, rewards=self._rewards[:, oldest_first])

    def _step(self, step: StepResult, limited: bool) -> None:
        now, first, outliers = self._now, dict(self._now.first), self._now.outliers
        for name, so in _flags(step):
            _note_first(first, name, so, step)
        for sight in self._watch.check(step):
            if sight.kind.rule == OutlierKind.FAST.rule:
                sight = replace(sight, envs=sight.envs & ~now.by_hand)
                if not sight.envs.any():
                    continue
            new = _note_first(first, sight.kind, sight.envs, step)
            if sight.kind.rule is not None and not self._break(sight.kind.rule, sight, step):
                continue
            for env in np.flatnonzero(new).tolist():
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
        ends = (step.terminated | (step.truncated & limited)) & running
        if ends.any():
            success = dict(_flags(step)).get("success", np.zeros(len(ends), bool))
            # A task's own rule may terminate an env without success or fail: that counts as fail.
            lost = np.where(step.terminated, Outcome.FAIL, Outcome.TRUNCATED)
            outcome = np.where(success, Outcome.SUCCESS, lost).astype(np.int8)
            self._now = replace(
                self._now,
                outcome=np.where(ends, outcome, now.outcome),
                end=np.where(ends, step.elapsed_steps, now.end),
                ended=now.ended + ends,
                succeeded=now.succeeded + (ends & success),
                failed=now.failed + (ends & ~success & step.terminated),
            )

    def _break(self, rule: str, sight: OutlierSighting, step: StepResult) -> bool:
        """Count a violation of this rule; returns False if the rule is off."""
        if (whole := self._rules.get(rule)) is None:
            return False
        known, count = self._found.get(rule), int(np.count_nonzero(sight.envs))
        if known is None:
            env = int(sight.envs.argmax())
            message = f"{sight.reason(env)}, in env {env} at step {step.elapsed_steps[env]} of its episode"
            known = replace(whole, message=message, first_step=self._tick - 1)
        self._found[rule] = replace(known, count=known.count + count)
        return True

    def _begin(self, envs: NDArray[np.bool_], step: StepResult) -> None:
        """Start new episodes in these envs (N,); `EnvRows.last` keeps their previous episodes, if these ended
        or had outliers."""
        now, from_start = self._now, step.elapsed_steps == 0
        worth_keeping = envs & ((now.end >= 0) | np.isin(np.arange(len(envs)), list(now.outliers)))
        until = np.where(now.end < 0, now.steps, now.end)
        before = LastEpisode(now.outcome, until, now.total, now.outliers)
        first = {what: np.where(envs, np.int32(-1), steps) for what, steps in now.first.items()}
        for name, so in _flags(step):
            _note_first(first, name, so & envs, step)
        self._now = replace(
            now,
            steps=np.where(envs, step.elapsed_steps, now.steps),
            outcome=np.where(envs, np.int8(Outcome.RUNNING), now.outcome),
            end=np.where(envs, np.int32(-1), now.end),
            total=np.where(envs, np.where(from_start, 0.0, np.nan), now.total),
            followed=np.where(envs, from_start & self._has_reward, now.followed),
            first=first,
            outliers=_merged(envs, {}, now.outliers),
            by_hand=now.by_hand & ~envs,
            last=now.last.with_envs(worth_keeping, before) if worth_keeping.any() else now.last,
        )
        self._rewards[envs] = np.nan
        self._watch.begin(envs, step)

    def _put_back(
        self, restored: Restored, then: EnvRows, rewards_then: Callable[[int], NDArray[np.float32]]
    ) -> None:
        """Give these envs the rows of the moment that they went back to."""
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
            by_hand=taken(now.by_hand, then.by_hand),
            first={what: taken(steps, then.first.get(what)) for what, steps in now.first.items()},
            outliers=_merged(
                put, {env: then.outliers.get(int(source[env]), ()) for env in restored.env_idx}, now.outliers
            ),
            # An env that continues from another env's moment keeps its own last episode.
            last=now.last.with_envs(put & (source == every), then.last),
        )
        for env, of in zip(restored.env_idx, restored.source, strict=True):
            rewards = rewards_then(of)
            self._rewards[env, np.arange(self._tick - len(rewards), self._tick) % KEPT_REWARDS] = rewards


def _flags(step: StepResult) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    """Names and masks (N,) of the bool entries of ``evaluate``; success and fail may have any type."""
    for name, values in step.evaluate.items():
        if name in ("success", "fail") or (values.dtype == np.bool_ and values.ndim == 1):
            yield name, values.reshape(len(step.reward), -1)[:, 0].astype(bool)


def _note_first(
    first: dict[Hashable, NDArray[np.int32]], what: Hashable, true: NDArray[np.bool_], step: StepResult
) -> NDArray[np.bool_]:
    """Write the step into `first` in envs where the entry is true for the first time in the episode; returns
    the mask (N,) of these envs."""
    known = first.get(what)
    if known is None:
        known = first[what] = np.full(len(true), -1, np.int32)
    new = true & (known < 0)
    if new.any():
        first[what] = np.where(new, step.elapsed_steps, known)
    return new


def _merged(envs: NDArray[np.bool_], new: Outliers, old: Outliers) -> Outliers:
    """Outliers by env: the new ones of these envs (N,), and the old ones of all other envs."""
    kept = {env: seen for env, seen in old.items() if not envs[env]}
    return {**kept, **{env: seen for env, seen in new.items() if seen and envs[env]}}
