"""One row an env: how its episode stands, what came of the one before, and what was odd about it.

The page shows one env's numbers and the batch's mean; neither says which of sixty-four envs to look at. This
does: it follows every reset and control step of the batch. A step costs array operations over the batch; sentences
are made only for what is out of the ordinary.

An episode *ends* with the first step that is terminated or truncated. What happens after it (the player may let
it run on) does not change its outcome. With the usual rule the env is reset at once, and nobody would ever read
"failed" in its row; so a row also has the outcome of the episode before.

An env that is put back to a moment of the past has its row put back too: to what the rows were at that moment, of the
env whose moment it is. Only the counts of episodes that ended go on, since those did end.

What is *odd* is what no env of a healthy task does: NaN and infinite numbers, bodies that fly off or fall, rewards out of
range. The limits are meant to be quiet on every task that works. A body is *fast* from 20 m/s on, as a mean over a
control step (robots of the field move at a tenth of it). It is *under the floor* when it is 0.2 m below all that
stands still, and it has *dropped* when it is 0.5 m lower than where its episode began (more than off a block, less
than off a table). Rewards have a range where ManiSkill names one: ``sparse`` is success less fail, so -1 to 1, and
``normalized_dense`` is divided by the most it can be, so at most 1; a plain ``dense`` reward has none.
"""

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
"""m/s."""
UNDER_EVERYTHING = 0.2
"""Metres under the lowest point of all that stands still."""
DEEPEST_DROP = 0.5
"""Metres, of a body that is no robot's and no articulation's."""
REWARD_RANGES: dict[str, tuple[float, float]] = {"sparse": (-1.0, 1.0), "normalized_dense": (-1.0, 1.0)}
"""By reward mode. A normalized reward may go below zero: some tasks take penalties."""
ROUNDING = 1e-4
"""3.0000002 / 3 is not out of range."""


class Kind(Enum):
    NOT_A_NUMBER = "NaN or infinite"
    FAST = "fast"
    UNDER_FLOOR = "under the floor"
    DROPPED = "dropped"
    REWARD = "reward"


@dataclass(frozen=True)
class Outlier:
    """The first time in its episode that an env did this."""

    kind: Kind
    step: int
    """Control step of the episode."""
    reason: str
    """For a person: ``cube moved at 134 m/s``."""


@dataclass(frozen=True)
class OutlierSighting:
    """The envs that show something of a kind in one control step."""

    kind: Kind
    envs: NDArray[np.bool_]
    """(N,)"""
    reason: Callable[[int], str]
    """Of one of these envs. Made only for the first time: a sentence costs more than the look."""


class OutlierWatch:
    """Looks at the control steps of one task, in order; see the module's text for the rules."""

    def __init__(
        self, geometry: SceneGeometry, first: StepResult, control_dt: float, reward_mode: str
    ) -> None:
        """
        Args:
            first: the state after the first reset; bodies that an env lacks are NaN there.
        """
        kinds = np.array(geometry.body_kinds)
        self._names = geometry.body_names
        self._there = np.isfinite(first.poses).all(axis=2)
        self._moves = self._there & np.isin(kinds, ("dynamic", "link"))
        self._loose = self._there & (kinds == "dynamic")
        self._dt = control_dt
        self._low, self._high = REWARD_RANGES.get(reward_mode, (-np.inf, np.inf))
        self._floor = lowest_still_point(geometry, first.poses) - UNDER_EVERYTHING
        self._before = first.poses[..., :3].copy()
        self._start = self._before[..., 2].copy()

    def begin(self, envs: NDArray[np.bool_], step: StepResult) -> None:
        """These envs (N,) were reset or put elsewhere: how they came there is no movement."""
        if step.poses.shape[:2] == self._there.shape:
            self._before[envs] = step.poses[envs, :, :3]
            self._start[envs] = step.poses[envs, :, 2]

    def look(self, step: StepResult) -> list[OutlierSighting]:
        """What a control step shows; only kinds that some env shows."""
        # With `reconfiguration_freq` a reset may change which bodies there are, which nobody tells us.
        sights = self._odd_poses(step) if step.poses.shape[:2] == self._there.shape else []
        for name, values in _numbers(step):
            wrong: Any = ~np.isfinite(values.reshape(len(values), -1)).all(axis=1)
            sights.append(
                OutlierSighting(
                    Kind.NOT_A_NUMBER, wrong, lambda env, of=values, name=name: f"{name} {_is_lost(of[env])}"
                )
            )
        if step.sound_obs is not None:
            sights.append(
                OutlierSighting(
                    Kind.NOT_A_NUMBER, ~step.sound_obs, lambda _: "the observation is NaN or infinite"
                )
            )
        with np.errstate(invalid="ignore"):
            out = (step.reward < self._low - ROUNDING) | (step.reward > self._high + ROUNDING)
        out &= np.isfinite(step.reward)
        sights.append(
            OutlierSighting(Kind.REWARD, out, lambda env: self._say_reward(float(step.reward[env])))
        )
        return [sight for sight in sights if sight.envs.any()]

    def _odd_poses(self, step: StepResult) -> list[OutlierSighting]:
        place = step.poses[..., :3]
        # An env that blew up has NaN and 1e30 in its poses: that is what is looked for, not a mishap.
        with np.errstate(invalid="ignore", over="ignore"):
            speed = np.where(self._moves, np.linalg.norm(place - self._before, axis=2) / self._dt, 0.0)
            drop = np.where(self._loose, self._start - place[..., 2], 0.0)
            lost: Any = self._there & ~np.isfinite(step.poses).all(axis=2)
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
                Kind.NOT_A_NUMBER,
                lost.any(axis=1),
                lambda e: f"the pose of {first(lost, e)} {_is_lost(step.poses[e, int(lost[e].argmax())])}",
            ),
            OutlierSighting(
                Kind.FAST, fast.any(axis=1), lambda e: "{} moved at {:.3g} m/s".format(*worst(speed, e))
            ),
            OutlierSighting(
                Kind.UNDER_FLOOR, under.any(axis=1), lambda e: f"{first(under, e)} is under the floor"
            ),
            OutlierSighting(
                Kind.DROPPED, dropped.any(axis=1), lambda e: "{} dropped {:.2f} m".format(*worst(drop, e))
            ),
        ]

    def _say_reward(self, reward: float) -> str:
        side = f"below {self._low:g}" if reward < self._low else f"above {self._high:g}"
        return f"the reward is {reward:.3g}, {side}"


def _is_lost(values: NDArray) -> str:
    """What is wrong with numbers of which one at least is not finite."""
    return "is NaN" if np.isnan(values).any() else "is infinite"


def lowest_still_point(geometry: SceneGeometry, poses: NDArray[np.float32]) -> float:
    """Height in metres of the lowest vertex of any static body; -inf where nothing stands still."""
    lowest = [np.inf]
    static = np.array([kind == "static" for kind in geometry.body_kinds], bool)
    for visual in geometry.visuals:
        worn = np.flatnonzero(static[visual.bodies])
        if not len(worn) or not len(visual.mesh.vertices):
            continue
        # All envs stand on the same ground; what differs between them is on it.
        p, (w, x, y, z) = np.split(poses[visual.envs[worn[0]], visual.bodies[worn[0]]], [3])
        up = np.array([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])
        lowest.append(float((visual.mesh.vertices @ up).min() + p[2]))
    finite = [height for height in lowest if np.isfinite(height)]
    return min(finite) if finite else -np.inf


def _numbers(step: StepResult) -> list[tuple[str, NDArray]]:
    """What a task's author computes: the reward, what ``evaluate`` gives, and the action of a policy."""
    action = [] if step.action is None or not step.action.size else [("the action", step.action)]
    entries = [(str(name), np.asarray(value)) for name, value in step.evaluate.items()]
    floats = [(name, value) for name, value in entries if value.dtype.kind == "f" and value.ndim]
    return [("the reward", step.reward), *action, *floats]


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
