"""Record of an episode with planned actions: its rewards, and the returns of the rollouts at each step.

Imports no torch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from workbench.envs.step_result import StepResult

if TYPE_CHECKING:
    from workbench.planning.rollouts import Plan


@dataclass(frozen=True)
class PlannedEpisode:
    """T control steps of one env, from a reset on. The values of a plan that is used for several steps are
    repeated at each of them."""

    seed: int
    horizon: int
    """H, control steps of a rollout."""
    reward: NDArray[np.float32]
    """(T,)"""
    success: NDArray[np.bool_]
    """(T,) after each step; all False if the task has no success."""
    fail: NDArray[np.bool_]
    """(T,) after each step; all False if the task has no fail."""
    best: NDArray[np.float32]
    """(T,) return of the best rollout in the plan of each step."""
    hold: NDArray[np.float32]
    """(T,) return of the rollout that holds still; NaN if one of its rewards was NaN."""
    worst: NDArray[np.float32]
    """(T,) return of the worst rollout among those with a finite return."""
    terms: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)
    """(T,) by name of a term of ``info["reward_terms"]``: each rollout sums the term over its steps; the
    value is the largest of these sums minus the smallest."""
    evaluate: Mapping[str, float] = field(default_factory=dict)
    """Entries of ``evaluate`` at the last step that have one number per env."""
    plan_seconds: float = 0.0
    """Wall time of all plans."""
    cut_off: bool = False
    """Whether the episode ended at its wall time limit, which says nothing about the task."""

    @property
    def steps(self) -> int:
        return len(self.reward)

    @property
    def solved_at(self) -> int:
        """The step of the first success, counted from 1; 0 if there is no success."""
        return int(self.success.argmax()) + 1 if self.success.any() else 0

    @property
    def failed_at(self) -> int:
        """The step of the first fail, counted from 1; 0 if there is no fail."""
        return int(self.fail.argmax()) + 1 if self.fail.any() else 0


class EpisodeLog:
    """Collects a `PlannedEpisode` step by step."""

    def __init__(self, seed: int, horizon: int) -> None:
        self._seed, self._horizon = seed, horizon
        self._plans: list[tuple[float, float, float]] = []
        self._terms: list[dict[str, float]] = []
        self._steps: list[tuple[float, bool, bool]] = []
        self._evaluate: dict[str, float] = {}
        self._last: Plan | None = None
        self._seconds = 0.0
        self.cut_off = False
        """Whether the wall time limit was reached; see `PlannedEpisode.cut_off`."""

    def add_plan(self, plan: Plan) -> None:
        """Record the plan of the next action."""
        if plan is not self._last:
            self._seconds += plan.seconds
        self._last = plan
        returns = plan.returns
        finite = returns[np.isfinite(returns)]
        worst, best = (finite.min(), finite.max()) if len(finite) else (np.nan, np.nan)
        self._plans.append((float(best), float(returns[1]), float(worst)))
        self._terms.append({name: float(np.ptp(term)) for name, term in plan.terms.items()})

    def add_step(self, step: StepResult, env: int) -> None:
        """Record this env's part of a step of the whole batch."""
        flags = [
            bool(step.evaluate[name][env]) if name in step.evaluate else False for name in ("success", "fail")
        ]
        self._steps.append((float(step.reward[env]), flags[0], flags[1]))
        self._evaluate = {name: float(row[env]) for name, row in step.evaluate.items() if np.ndim(row) == 1}

    def episode(self) -> PlannedEpisode:
        """The episode so far, without a plan whose step was not taken."""
        count = len(self._steps)
        reward, success, fail = _columns(self._steps, 3)
        best, hold, worst = _columns(self._plans[:count], 3)
        names = dict.fromkeys(name for terms in self._terms[:count] for name in terms)
        return PlannedEpisode(
            self._seed,
            self._horizon,
            reward,
            success.astype(bool),
            fail.astype(bool),
            best,
            hold,
            worst,
            {
                name: np.array([terms.get(name, np.nan) for terms in self._terms[:count]], np.float32)
                for name in names
            },
            self._evaluate,
            self._seconds,
            self.cut_off,
        )


def _columns(rows: list[Any], width: int) -> NDArray[np.float32]:
    return np.array(rows, np.float32).reshape(-1, width).T
