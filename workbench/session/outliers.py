"""What no env of a healthy task does: NaN and infinite numbers, bodies that fly off or fall, odd rewards.

One env in sixty-four that has blown up does not show in a mean, and by the time a person looks its episode may
be over. So every control step of the batch is looked at, with a handful of array operations, and what an env
did first is kept for its row on the page. All of it is read from what a step brings to the page anyway; nothing
is asked of the simulation.

The limits are meant to be quiet on every task that works. A body is *fast* from 20 m/s on, as a mean over a
control step (robots of the field move at a tenth of it). It is *under the floor* when it is 0.2 m below all that
stands still, and it has *dropped* when it is 0.5 m lower than where its episode began (more than off a block, less
than off a table). Rewards have a range where ManiSkill names one: ``sparse`` is success less fail, so -1 to 1, and
``normalized_dense`` is divided by the most it can be, so at most 1; a plain ``dense`` reward has none.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from workbench.core.geometry import SceneGeometry
from workbench.core.step import StepResult

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
class Sight:
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

    def look(self, step: StepResult) -> list[Sight]:
        """What a control step shows; only kinds that some env shows."""
        # With `reconfiguration_freq` a reset may change which bodies there are, which nobody tells us.
        sights = self._odd_poses(step) if step.poses.shape[:2] == self._there.shape else []
        for name, values in _numbers(step):
            wrong: Any = ~np.isfinite(values.reshape(len(values), -1)).all(axis=1)
            sights.append(
                Sight(
                    Kind.NOT_A_NUMBER, wrong, lambda env, of=values, name=name: f"{name} {_is_lost(of[env])}"
                )
            )
        if step.sound_obs is not None:
            sights.append(
                Sight(Kind.NOT_A_NUMBER, ~step.sound_obs, lambda _: "the observation is NaN or infinite")
            )
        with np.errstate(invalid="ignore"):
            out = (step.reward < self._low - ROUNDING) | (step.reward > self._high + ROUNDING)
        out &= np.isfinite(step.reward)
        sights.append(Sight(Kind.REWARD, out, lambda env: self._say_reward(float(step.reward[env]))))
        return [sight for sight in sights if sight.envs.any()]

    def _odd_poses(self, step: StepResult) -> list[Sight]:
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
            Sight(
                Kind.NOT_A_NUMBER,
                lost.any(axis=1),
                lambda e: f"the pose of {first(lost, e)} {_is_lost(step.poses[e, int(lost[e].argmax())])}",
            ),
            Sight(Kind.FAST, fast.any(axis=1), lambda e: "{} moved at {:.3g} m/s".format(*worst(speed, e))),
            Sight(Kind.UNDER_FLOOR, under.any(axis=1), lambda e: f"{first(under, e)} is under the floor"),
            Sight(Kind.DROPPED, dropped.any(axis=1), lambda e: "{} dropped {:.2f} m".format(*worst(drop, e))),
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
