"""One row an env: state of its episode, outcome of the one before, and outliers."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Mapping
from dataclasses import dataclass, replace
from enum import Enum, IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from workbench.core.env.step_result import StepResult
from workbench.core.scene.shapes import SceneGeometry
from workbench.jobs.task import Restored, Stepped

FASTEST = 20.0
"""m/s, as a mean over a control step; robots of the field move at a tenth of it."""
UNDER_EVERYTHING = 0.2
"""Metres under the lowest point of all static bodies."""
DEEPEST_DROP = 0.5
"""Metres below the start of the episode, of a body that is not part of an articulation: more than off a block, less than
off a table."""
REWARD_RANGES: dict[str, tuple[float, float]] = {"sparse": (-1.0, 1.0), "normalized_dense": (-1.0, 1.0)}
"""By reward mode, where ManiSkill defines a range: sparse is success minus fail, normalized is divided by its maximum (some
tasks take penalties, so it may be negative). A plain dense reward has none."""
ROUNDING = 1e-4
"""3.0000002 / 3 is not out of range."""


class OutlierKind(Enum):
    NOT_A_NUMBER = "NaN or infinite"
    FAST = "fast"
    UNDER_FLOOR = "under the floor"
    DROPPED = "dropped"
    REWARD = "reward"


@dataclass(frozen=True)
class Outlier:
    """The first outlier of a kind in an env's episode."""

    kind: OutlierKind
    step: int
    """Control step of the episode."""
    reason: str
    """Text such as ``cube moved at 134 m/s``."""


@dataclass(frozen=True)
class OutlierSighting:
    """The envs with an outlier of one kind in one control step."""

    kind: OutlierKind
    envs: NDArray[np.bool_]
    """(N,)"""
    reason: Callable[[int], str]
    """The text for one of these envs. Called only for the first outlier of a kind: texts cost more than the checks."""


class OutlierWatch:
    """Checks the control steps of one task, in order, for what no healthy task does: NaN and infinite numbers, bodies that
    fly off or fall, rewards out of range. The limits are meant to report nothing on every task that works."""

    def __init__(
        self, geometry: SceneGeometry, first: StepResult, control_dt: float, reward_mode: str
    ) -> None:
        """
        Args:
            first: the state after the first reset; bodies that an env lacks are NaN there.
        """
        kinds = np.array(geometry.body_kinds)
        self._names = geometry.body_names
        self._present = np.isfinite(first.poses).all(axis=2)
        self._moves = self._present & np.isin(kinds, ("dynamic", "link"))
        self._loose = self._present & (kinds == "dynamic")
        self._dt = control_dt
        self._low, self._high = REWARD_RANGES.get(reward_mode, (-np.inf, np.inf))
        self._floor = lowest_still_point(geometry, first.poses) - UNDER_EVERYTHING
        self._before = first.poses[..., :3].copy()
        self._start = self._before[..., 2].copy()

    def begin(self, envs: NDArray[np.bool_], step: StepResult) -> None:
        """These envs (N,) were reset or put back to a moment: the jump does not count as movement."""
        if step.poses.shape[:2] == self._present.shape:
            self._before[envs] = step.poses[envs, :, :3]
            self._start[envs] = step.poses[envs, :, 2]

    def check(self, step: StepResult) -> list[OutlierSighting]:
        """The kinds of outlier in a control step, each with at least one env."""
        # With `reconfiguration_freq` a reset may change the bodies without notice: poses are skipped then.
        found = self._check_poses(step) if step.poses.shape[:2] == self._present.shape else []
        for name, values in _numbers(step):
            wrong: Any = ~np.isfinite(values.reshape(len(values), -1)).all(axis=1)
            found.append(
                OutlierSighting(
                    OutlierKind.NOT_A_NUMBER,
                    wrong,
                    lambda env, of=values, name=name: f"{name} {_nan_text(of[env])}",
                )
            )
        if step.sound_obs is not None:
            found.append(
                OutlierSighting(
                    OutlierKind.NOT_A_NUMBER, ~step.sound_obs, lambda _: "the observation is NaN or infinite"
                )
            )
        with np.errstate(invalid="ignore"):
            out = (step.reward < self._low - ROUNDING) | (step.reward > self._high + ROUNDING)
        out &= np.isfinite(step.reward)
        found.append(
            OutlierSighting(OutlierKind.REWARD, out, lambda env: self._reward_text(float(step.reward[env])))
        )
        return [sight for sight in found if sight.envs.any()]

    def _check_poses(self, step: StepResult) -> list[OutlierSighting]:
        place = step.poses[..., :3]
        # An env that blew up has NaN and 1e30 in its poses: these are to be found, not to warn about.
        with np.errstate(invalid="ignore", over="ignore"):
            speed = np.where(self._moves, np.linalg.norm(place - self._before, axis=2) / self._dt, 0.0)
            drop = np.where(self._loose, self._start - place[..., 2], 0.0)
            lost: Any = self._present & ~np.isfinite(step.poses).all(axis=2)
            fast: Any = speed > FASTEST
            dropped: Any = drop > DEEPEST_DROP
            under: Any = self._moves & (place[..., 2] < self._floor)
        self._before = place.copy()

        def first(bodies: NDArray[np.bool_], env: int) -> str:
            return self._names[int(bodies[env].argmax())]

        def worst(amounts: NDArray, env: int) -> tuple[str, float]:
            body = int(np.nanargmax(amounts[env]))
            return self._names[body], float(amounts[env, body])

        return [
            OutlierSighting(
                OutlierKind.NOT_A_NUMBER,
                lost.any(axis=1),
                lambda e: f"the pose of {first(lost, e)} {_nan_text(step.poses[e, int(lost[e].argmax())])}",
            ),
            OutlierSighting(
                OutlierKind.FAST,
                fast.any(axis=1),
                lambda e: "{} moved at {:.3g} m/s".format(*worst(speed, e)),
            ),
            OutlierSighting(
                OutlierKind.UNDER_FLOOR, under.any(axis=1), lambda e: f"{first(under, e)} is under the floor"
            ),
            OutlierSighting(
                OutlierKind.DROPPED,
                dropped.any(axis=1),
                lambda e: "{} dropped {:.2f} m".format(*worst(drop, e)),
            ),
        ]

    def _reward_text(self, reward: float) -> str:
        side = f"below {self._low:g}" if reward < self._low else f"above {self._high:g}"
        return f"the reward is {reward:.3g}, {side}"


def _nan_text(values: NDArray) -> str:
    """Which kind of not finite: some of `values` is NaN or infinite."""
    return "is NaN" if np.isnan(values).any() else "is infinite"


def lowest_still_point(geometry: SceneGeometry, poses: NDArray[np.float32]) -> float:
    """Height in metres of the lowest vertex of any static body; -inf without one."""
    lowest = [np.inf]
    static = np.array([kind == "static" for kind in geometry.body_kinds], bool)
    for visual in geometry.visuals:
        instances = np.flatnonzero(static[visual.bodies])
        if not len(instances) or not len(visual.mesh.vertices):
            continue
        # All envs have the same ground; they differ in what is on it. So one env is enough.
        p, (w, x, y, z) = np.split(poses[visual.envs[instances[0]], visual.bodies[instances[0]]], [3])
        up = np.array([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])
        lowest.append(float((visual.mesh.vertices @ up).min() + p[2]))
    finite = [height for height in lowest if np.isfinite(height)]
    return min(finite) if finite else -np.inf


def _numbers(step: StepResult) -> list[tuple[str, NDArray]]:
    """Numbers that the author's code computes: reward, float entries of ``evaluate``, and a policy's action."""
    action = [] if step.action is None or not step.action.size else [("the action", step.action)]
    entries = [(str(name), np.asarray(value)) for name, value in step.evaluate.items()]
    floats = [(name, value) for name, value in entries if value.dtype.kind == "f" and value.ndim]
    return [("the reward", step.reward), *action, *floats]


KEPT_REWARDS = 100
"""The newest steps of an episode whose rewards a row holds."""
NONFINITE_REWARD_KEY = (OutlierKind.REWARD, OutlierKind.NOT_A_NUMBER)
"""Key in `EnvRows.first` of a reward that is NaN or infinite."""
Outliers = Mapping[int, tuple[Outlier, ...]]
"""By env, oldest first; only envs with outliers."""


class Outcome(IntEnum):
    RUNNING = 0
    SUCCESS = 1
    FAIL = 2
    TRUNCATED = 3


@dataclass(frozen=True)
class LastEpisode:
    """The last episode of each env that ended or had outliers, before the present one.

    Envs are reset as soon as an episode ends, so "failed" would never be seen in the present one's row.
    """

    outcome: NDArray[np.int8]
    """(N,) `Outcome`; RUNNING if it was cut short, or there was none (then `steps` is -1)."""
    steps: NDArray[np.int32]
    """(N,) control steps until its end."""
    total: NDArray[np.float64]
    """(N,) its return until its end."""
    outliers: Outliers

    def with_envs(self, envs: NDArray[np.bool_], other: LastEpisode) -> LastEpisode:
        """The same, but with the values of `other` in these envs (N,)."""
        return LastEpisode(
            np.where(envs, other.outcome, self.outcome),
            np.where(envs, other.steps, self.steps),
            np.where(envs, other.total, self.total),
            _merged(envs, other.outliers, self.outliers),
        )


@dataclass(frozen=True)
class EnvRows:
    """The whole table at one moment. Arrays are never written to, and unchanged ones are shared with the moment before:
    most steps add only an array of returns."""

    steps: NDArray[np.int32]
    """(N,) control steps of the present episode."""
    outcome: NDArray[np.int8]
    """(N,) `Outcome` of the present episode, RUNNING until it ends."""
    end: NDArray[np.int32]
    """(N,) the first terminated or truncated step; -1 while it runs. Later steps do not change the outcome."""
    total: NDArray[np.float64]
    """(N,) undiscounted return so far; NaN after a NaN reward."""
    followed: NDArray[np.bool_]
    """(N,) whether the episode was followed from its start; otherwise `total` is NaN."""
    first: Mapping[Hashable, NDArray[np.int32]]
    """(N,) the first step at which it was true (0: after the reset); -1: never. By bool entry of ``evaluate``, by
    `OutlierKind`, and by `NONFINITE_REWARD_KEY`."""
    outliers: Outliers
    last: LastEpisode
    ended: NDArray[np.int64]
    """(N,) episodes that ended since the task was loaded."""
    succeeded: NDArray[np.int64]
    """(N,) those of them that ended in success."""
    rewards: NDArray[np.float32]
    """(N, `KEPT_REWARDS`) oldest first; NaN before the episode's start. (N, 0) in a moment of the history."""

    @property
    def num_envs(self) -> int:
        return len(self.steps)

    @property
    def first_true(self) -> dict[str, NDArray[np.int32]]:
        """`first` of the entries of ``evaluate``."""
        return {what: steps for what, steps in self.first.items() if isinstance(what, str)}

    @staticmethod
    def bytes_a_step(num_envs: int) -> int:
        """Bytes that one more moment's rows take, nearly always."""
        return 8 * num_envs + 400


class EnvTable:
    """Follows every reset and control step of the batch, by array operations; `add` all events in order.

    An env that goes back to a moment gets that moment's row, of the env whose moment it is. Only the counts of ended
    episodes continue.
    """

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
        """Take one event: a reset of some envs, a jump back, or a control step of all.

        Args:
            then: the rows at the moment that some envs went back to. None without a jump back, or if that moment is
                unknown: the rows of its envs start without a past.
            rewards_then: of an env, the rewards of its episode until then, oldest first.

        Returns:
            The rows to store in the moment.
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
            _note_first(first, name, so, step)
        _note_first(first, NONFINITE_REWARD_KEY, ~np.isfinite(step.reward), step)
        for sight in self._watch.check(step):
            for env in np.flatnonzero(_note_first(first, sight.kind, sight.envs, step)).tolist():
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
            # A task's own rule may terminate an env without success or fail: that counts as fail.
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
        """Start a new episode in these envs (N,); the one before becomes `EnvRows.last`."""
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
            followed=np.where(envs, from_start, now.followed),
            first=first,
            outliers=_merged(envs, {}, now.outliers),
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
    """The bool entries (N,) of ``evaluate``, and success and fail of any type."""
    for name, values in step.evaluate.items():
        if name in ("success", "fail") or (values.dtype == np.bool_ and values.ndim == 1):
            yield name, values.reshape(len(step.reward), -1)[:, 0].astype(bool)


def _note_first(
    first: dict[Hashable, NDArray[np.int32]], what: Hashable, true: NDArray[np.bool_], step: StepResult
) -> NDArray[np.bool_]:
    """Write the step into `first` in envs where it is true for the first time in the episode; returns these (N,)."""
    known = first.get(what)
    if known is None:
        known = first[what] = np.full(len(true), -1, np.int32)
    new = true & (known < 0)
    if new.any():
        first[what] = np.where(new, step.elapsed_steps, known)
    return new


def _merged(envs: NDArray[np.bool_], new: Outliers, old: Outliers) -> Outliers:
    """The new outliers in these envs (N,), the old ones in the others."""
    kept = {env: seen for env, seen in old.items() if not envs[env]}
    return {**kept, **{env: seen for env, seen in new.items() if seen and envs[env]}}
