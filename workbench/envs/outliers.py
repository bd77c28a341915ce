"""What no healthy task does: numbers that are not finite, bodies that fly off or fall, rewards out of range."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from workbench.envs.gpu_rules import Rule
from workbench.envs.scene.shapes import SceneGeometry
from workbench.envs.step_result import StepResult

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
    """(quantity, rule id). The rule is None for actions: they come from the policy."""

    rule: str | None

    ACTION_NOT_FINITE = "action not finite", None
    POSE_NOT_FINITE = "pose not finite", "bodies-stay"
    FAST = "fast", "bodies-stay"
    UNDER_FLOOR = "under the floor", "bodies-stay"
    DROPPED = "dropped", "bodies-stay"
    ENTRY_NOT_FINITE = "entry not finite", "entries-finite"
    OBSERVATION_NOT_FINITE = "observation not finite", "observation-finite"
    REWARD_NOT_FINITE = "reward not finite", "reward-finite"
    REWARD_OUT_OF_RANGE = "reward out of range", "reward-normalized"

    def __new__(cls, what: str, rule: str | None) -> OutlierKind:
        made = object.__new__(cls)
        made._value_ = what
        made.rule = rule
        return made


OUTLIER_RULES = {
    rule.id: rule
    for rule in (
        Rule(
            "bodies-stay",
            "warn",
            "While the task runs, bodies neither fly off nor fall out of the scene.",
            "An episode without the body cannot be solved, and its numbers leave the range of all others.",
            "step",
        ),
        Rule(
            "entries-finite",
            "warn",
            "Numbers that evaluate() returns are finite.",
            "A mean over envs or episodes is NaN as soon as one of them is, and a comparison with NaN is false.",
            "evaluate",
        ),
        Rule(
            "reward-finite",
            "stop",
            "Rewards are finite, also at the edges of joints and table.",
            "One NaN makes the whole network NaN.",
            "compute_dense_reward",
        ),
        Rule(
            "reward-normalized",
            "warn",
            "The normalized dense reward and the sparse one lie within -1 and 1.",
            "Learning rates and clipping of trainers expect that range.",
            "compute_normalized_dense_reward",
        ),
        Rule(
            "observation-finite",
            "stop",
            "Observations are finite.",
            "One NaN makes the whole network NaN.",
            "_get_obs_extra",
        ),
    )
}
"""The rules that an outlier breaks, by id."""


@dataclass(frozen=True)
class Outlier:
    """The first outlier of a kind in an env's episode."""

    kind: OutlierKind
    step: int
    """Control step of the episode."""
    reason: str
    """Text such as ``cube moved at 134 m/s``."""

    @property
    def text(self) -> str:
        """The reason after its rule."""
        return self.reason if self.kind.rule is None else f"{self.kind.rule}: {self.reason}"


@dataclass(frozen=True)
class OutlierSighting:
    """The envs with an outlier of one kind in one control step."""

    kind: OutlierKind
    envs: NDArray[np.bool_]
    """(N,)"""
    reason: Callable[[int], str]
    """The text for one of these envs. Called only for the first outlier of a kind: texts cost more than the checks."""
    body: Callable[[int], str] | None = None
    """Name of the body that is the outlier, in one of these envs; None for outliers that are not bodies."""


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
        # The links without a shape that a free root is made of may be anywhere.
        shaped = np.isin(np.arange(len(kinds)), [body for each in geometry.visuals for body in each.bodies])
        self._moves = self._present & shaped & np.isin(kinds, ("dynamic", "link"))
        self._loose = self._present & shaped & (kinds == "dynamic")
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
        for kind, name, values in _numbers(step):
            wrong: Any = ~np.isfinite(values.reshape(len(values), -1)).all(axis=1)
            found.append(
                OutlierSighting(
                    kind,
                    wrong,
                    lambda env, of=values, name=name: f"{name} {_nan_text(of[env])}",
                )
            )
        if step.sound_obs is not None:
            found.append(
                OutlierSighting(
                    OutlierKind.OBSERVATION_NOT_FINITE,
                    ~step.sound_obs,
                    lambda _: "the observation is NaN or infinite",
                )
            )
        with np.errstate(invalid="ignore"):
            out = (step.reward < self._low - ROUNDING) | (step.reward > self._high + ROUNDING)
        out &= np.isfinite(step.reward)
        found.append(
            OutlierSighting(
                OutlierKind.REWARD_OUT_OF_RANGE, out, lambda env: self._reward_text(float(step.reward[env]))
            )
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

        names = self._names

        def sighting(
            kind: OutlierKind,
            wrong: NDArray[np.bool_],
            say: Callable[[int, int], str],
            most: NDArray | None = None,
        ) -> OutlierSighting:
            """`say` gets env and body: the one that has the most of `most`, or the first."""

            def body(env: int) -> int:
                return int(wrong[env].argmax() if most is None else np.nanargmax(most[env]))

            odd: Any = wrong.any(axis=1)
            return OutlierSighting(
                kind,
                odd,
                lambda env: say(env, body(env)),
                lambda env: names[body(env)],
            )

        return [
            sighting(
                OutlierKind.POSE_NOT_FINITE,
                lost,
                lambda e, b: f"the pose of {names[b]} {_nan_text(step.poses[e, b])}",
            ),
            sighting(
                OutlierKind.FAST, fast, lambda e, b: f"{names[b]} moved at {speed[e, b]:.3g} m/s", speed
            ),
            sighting(OutlierKind.UNDER_FLOOR, under, lambda e, b: f"{names[b]} is under the floor"),
            sighting(
                OutlierKind.DROPPED, dropped, lambda e, b: f"{names[b]} dropped {drop[e, b]:.2f} m", drop
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


def _numbers(step: StepResult) -> list[tuple[OutlierKind, str, NDArray]]:
    """Numbers that the author's code computes: reward, float entries of ``evaluate``, and a policy's action."""
    action = (
        []
        if step.action is None or not step.action.size
        else [(OutlierKind.ACTION_NOT_FINITE, "the action", step.action)]
    )
    entries = [(str(name), np.asarray(value)) for name, value in step.evaluate.items()]
    floats = [
        (OutlierKind.ENTRY_NOT_FINITE, name, value)
        for name, value in entries
        if value.dtype.kind == "f" and value.ndim
    ]
    return [(OutlierKind.REWARD_NOT_FINITE, "the reward", step.reward), *action, *floats]
