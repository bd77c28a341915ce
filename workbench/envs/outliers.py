"""Finds outliers in control steps: numbers that are not finite, bodies that fly off or fall, rewards out of range."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from workbench.envs.gpu_rules import DeclaredRule, declared_rule
from workbench.envs.scene.shapes import SceneGeometry
from workbench.envs.step_result import TERM_PREFIX, StepResult

MAX_SPEED = 20.0
"""Maximum speed of a body in m/s, as a mean over a control step; robots move at a tenth of it."""
UNDER_FLOOR_METRES = 0.2
"""A body that is this far below the lowest point of all static bodies, in metres, is under the floor."""
MAX_DROP_METRES = 0.5
"""Maximum drop in metres since the start of the episode, of a body that is not part of an articulation: more than the height
of a block, less than that of a table."""
REWARD_RANGES: dict[str, tuple[float, float]] = {"sparse": (-1.0, 1.0), "normalized_dense": (-1.0, 1.0)}
"""Range of rewards by mode, for the modes whose range ManiSkill defines. A sparse reward is success minus
fail. A normalized reward is the dense reward divided by its maximum; it is negative where a task subtracts
penalties. A plain dense reward has no range."""
ROUNDING = 1e-4
"""Tolerance of the range: 3.0000002 / 3 is not out of range."""


class OutlierKind(Enum):
    """(quantity, rule id). The rule is None for actions: they come from the policy."""

    rule: str | None

    ACTION_NOT_FINITE = "action not finite", None
    POSE_NOT_FINITE = "pose not finite", "bodies-stay"
    FAST = "fast", "bodies-stay"
    UNDER_FLOOR = "under the floor", "bodies-stay"
    DROPPED = "dropped", "bodies-stay"
    ENTRY_NOT_FINITE = "entry not finite", "entries-finite"
    TERM_NOT_FINITE = "reward term not finite", "reward-finite"
    OBSERVATION_NOT_FINITE = "observation not finite", "observation-finite"
    REWARD_NOT_FINITE = "reward not finite", "reward-finite"
    REWARD_OUT_OF_RANGE = "reward out of range", "reward-normalized"

    def __new__(cls, what: str, rule: str | None) -> OutlierKind:
        made = object.__new__(cls)
        made._value_ = what
        made.rule = rule
        return made


OUTLIER_RULES: Mapping[str, DeclaredRule] = {
    rule.id: rule
    for rule in (
        declared_rule(
            "bodies-stay",
            "warn",
            "step",
            """While the task runs, bodies neither fly off nor fall out of the scene.

            An episode without the body cannot be solved, and its numbers leave the range of all others.

            ## Why
            An episode without its body cannot be solved, and runs to the time limit. Its observations and
            rewards are many times larger than all others: among thousands of envs a few such episodes spoil
            running means and the value function. Most often bodies overlap, or a force is too high. The same
            scene explodes more often on the GPU.

            ## Fix
            Make sure that no bodies overlap and none is thrown. If a body may be lost, end the episode there.

            ```python fragment
            def evaluate(self):
                fallen = self.cube.pose.p[:, 2] < -0.1
                return {"success": self.reached() & ~fallen, "fail": fallen}
            ```

            ## How it is checked
            The rule looks at random rollouts of all seeds, of up to 50 steps, and at episodes that you play.
            It reports a body that is faster than 20 m/s, that is 20 cm below everything that stands still,
            that is half a metre below where its episode began (if it belongs to no articulation), or whose
            pose is NaN. Bodies without a shape are left out, and so is what happens after the end of an
            episode. The limits are wide: the rule does not see a cube that rolls off a low block.
            """,
        ),
        declared_rule(
            "entries-finite",
            "warn",
            "evaluate",
            """Numbers that evaluate() returns are finite.

            One NaN makes a mean over envs or episodes NaN, and a comparison with NaN is false.

            ## Why
            Trainers and loggers take the mean of an entry over envs and episodes: one NaN among 4096 envs
            makes it NaN. A comparison with NaN is false, so a success that is computed from it is never
            reached. The reward often uses the same number.

            ## Fix
            Clamp divisors and the arguments of roots. For a value that is not known, return 0 and a bool that
            says so.

            ```python fragment
            height = self.block.pose.p[:, 2]
            tilt = self.rise / self.run.abs().clamp(min=1e-6)
            return {"tilt": tilt, "lifted": height > 0.1}
            ```

            ## How it is checked
            The rule reads each floating entry after the resets of all seeds, at each step of random rollouts
            of up to 50 steps, and in those of `--actions`. While you play, it looks at each step and flags an
            env with such an entry. It does not see other states.
            """,
        ),
        declared_rule(
            "reward-finite",
            "stop",
            "compute_dense_reward",
            """Rewards are finite, even at the limits of joints and the edges of the table.

            One NaN makes the whole network NaN.

            ## Why
            One NaN in a batch of 4096 envs makes the loss NaN, then every weight of the network. Training
            ends there, often after hours, since the state that gives NaN is rare.

            ## Fix
            Clamp divisors and the arguments of roots and logarithms.

            ```python fragment
            speed = torch.linalg.norm(velocity, dim=1)
            straight = velocity[:, 0] / speed.clamp(min=1e-6)
            ```

            ## How it is checked
            The rule reads the reward in random rollouts of all seeds, and in those of `--actions`. Then, for
            the first two batches of seeds, it puts joints at random places and at their limits, and bodies at
            random places around their start and at each goal mark, and calls the reward hook without a step.
            While you play, it looks at each step and flags an env that breaks the rule. It does not see other
            states.
            """,
        ),
        declared_rule(
            "reward-normalized",
            "warn",
            "compute_normalized_dense_reward",
            """The normalized dense reward and the sparse reward lie between -1 and 1.

            Learning rates and clipping of trainers expect that range.

            ## Why
            Trainers are tuned for rewards of about 1 per step. Larger rewards scale the value loss and the
            gradients, or are clipped, so that the best states look alike.

            ## Fix
            Divide by the largest dense reward of one step.

            ```python fragment
            def compute_normalized_dense_reward(self, obs, action, info):
                return self.compute_dense_reward(obs, action, info) / 3
            ```

            ## How it is checked
            The rule reads the normalized or sparse reward, whichever the task is made with, in random
            rollouts of all seeds and in those of `--actions`. While you play, it flags an env with a reward
            outside the range. It also reads the reward of states with success: in the states that
            `reward-finite` makes, and from a call of the reward hook with `success` set for all envs, if that
            gives the same number in all states. The result is *not known* if no success was seen, since
            success pays the largest reward. It is *not applicable* for a plain dense reward.
            """,
        ),
        declared_rule(
            "observation-finite",
            "stop",
            "_get_obs_extra",
            """Observations are finite.

            One NaN makes the whole network NaN.

            ## Why
            One NaN in a batch of 4096 envs makes the network's output NaN, then its weights, even if the
            reward is finite. Running means of a normaliser stay NaN forever.

            ## Fix
            Clamp divisors, or leave the number out.

            ```python fragment
            direction = offset / torch.linalg.norm(offset, dim=1, keepdim=True).clamp(min=1e-6)
            ```

            ## How it is checked
            The rule reads each number of the observation in random rollouts of all seeds, and in the states
            that `reward-finite` makes. Pictures are left out. While you play, it looks at each step and flags
            an env that breaks the rule. It does not see other states.
            """,
        ),
    )
}
"""The rules that outliers break, by id."""


@dataclass(frozen=True)
class Outlier:
    """The first outlier of a kind in one episode of an env."""

    kind: OutlierKind
    step: int
    """Control step of the episode."""
    reason: str
    """Text such as ``cube moved at 134 m/s``."""

    @property
    def text(self) -> str:
        """The rule, then the reason."""
        return self.reason if self.kind.rule is None else f"{self.kind.rule}: {self.reason}"


@dataclass(frozen=True)
class OutlierSighting:
    """The envs with an outlier of one kind in one control step."""

    kind: OutlierKind
    envs: NDArray[np.bool_]
    """(N,)"""
    reason: Callable[[int], str]
    """Returns the text for one of these envs. Called only for the first outlier of a kind: texts cost more
    than the checks."""
    body: Callable[[int], str] | None = None
    """Returns the name of the outlier body in one of these envs; None if this kind is not about bodies."""


class OutlierWatch:
    """Checks the control steps of one task, in order, for outliers: NaN and infinite numbers, bodies that fly off or fall,
    rewards out of range. The limits are wide, so that a working task has no outliers."""

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
        # A free root is made of links without a shape, which may be anywhere.
        shaped = np.isin(np.arange(len(kinds)), [body for each in geometry.visuals for body in each.bodies])
        self._moves = self._present & shaped & np.isin(kinds, ("dynamic", "link"))
        self._loose = self._present & shaped & (kinds == "dynamic")
        self._dt = control_dt
        self._low, self._high = REWARD_RANGES.get(reward_mode, (-np.inf, np.inf))
        self._floor = lowest_still_point(geometry, first.poses) - UNDER_FLOOR_METRES
        self._before = first.poses[..., :3].copy()
        self._start = self._before[..., 2].copy()

    def begin(self, envs: NDArray[np.bool_], step: StepResult) -> None:
        """Note that these envs (N,) were reset or restored: their jump does not count as movement."""
        if step.poses.shape[:2] == self._present.shape:
            self._before[envs] = step.poses[envs, :, :3]
            self._start[envs] = step.poses[envs, :, 2]

    def check(self, step: StepResult) -> list[OutlierSighting]:
        """The kinds of outlier in a control step, each with at least one env."""
        # With `reconfiguration_freq` a reset may change the bodies without notice: then skip their poses.
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
        # An env that exploded has NaN and 1e30 in its poses; numpy must not warn about them.
        with np.errstate(invalid="ignore", over="ignore"):
            speed = np.where(self._moves, np.linalg.norm(place - self._before, axis=2) / self._dt, 0.0)
            drop = np.where(self._loose, self._start - place[..., 2], 0.0)
            lost: Any = self._present & ~np.isfinite(step.poses).all(axis=2)
            fast: Any = speed > MAX_SPEED
            dropped: Any = drop > MAX_DROP_METRES
            under: Any = self._moves & (place[..., 2] < self._floor)
        self._before = place.copy()

        names = self._names

        def sighting(
            kind: OutlierKind,
            wrong: NDArray[np.bool_],
            say: Callable[[int, int], str],
            most: NDArray | None = None,
        ) -> OutlierSighting:
            """`say` gets the env and one of its bodies: the one with the largest value in `most`; without
            `most`, the first that is wrong."""

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
    """Text that says whether `values` have NaN or infinite numbers."""
    return "is NaN" if np.isnan(values).any() else "is infinite"


def lowest_still_point(geometry: SceneGeometry, poses: NDArray[np.float32]) -> float:
    """Height in metres of the lowest vertex of any static body; -inf if there is no static body."""
    lowest = [np.inf]
    static = np.array([kind == "static" for kind in geometry.body_kinds], bool)
    for visual in geometry.visuals:
        instances = np.flatnonzero(static[visual.bodies])
        if not len(instances) or not len(visual.mesh.vertices):
            continue
        # One env is enough: all envs have the same ground, and differ in what is on it.
        p, (w, x, y, z) = np.split(poses[visual.envs[instances[0]], visual.bodies[instances[0]]], [3])
        up = np.array([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])
        lowest.append(float((visual.mesh.vertices @ up).min() + p[2]))
    finite = [height for height in lowest if np.isfinite(height)]
    return min(finite) if finite else -np.inf


def _numbers(step: StepResult) -> list[tuple[OutlierKind, str, NDArray]]:
    """Kind, name and values of the numbers to check: reward, float entries of ``evaluate``, and action."""
    action = (
        []
        if step.action is None or not step.action.size
        else [(OutlierKind.ACTION_NOT_FINITE, "the action", step.action)]
    )
    entries = [(str(name), np.asarray(value)) for name, value in step.evaluate.items()]
    floats = [
        # The reward's hook puts its terms into the entries of evaluate.
        (
            OutlierKind.TERM_NOT_FINITE if name.startswith(TERM_PREFIX) else OutlierKind.ENTRY_NOT_FINITE,
            name,
            value,
        )
        for name, value in entries
        if value.dtype.kind == "f" and value.ndim
    ]
    return [(OutlierKind.REWARD_NOT_FINITE, "the reward", step.reward), *action, *floats]
