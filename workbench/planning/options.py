"""Options of the planner, as plain data. Imports no torch."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

Method = Literal["mppi", "predictive", "cem"]
_MIN_ROLLOUTS = 4
"""Minimum number of rollouts: the plan itself, holding still, and the two best of the previous round."""
_HORIZON_STEPS = 8, 20
"""Minimum and maximum control steps of the default horizon."""


@dataclass(frozen=True)
class PlanArguments:
    """Options of the planner: candidate actions are rolled out from the current state, and the plan moves toward the best.

    Args:
        method: mppi, the mean of all candidates weighted by their returns (Williams et al., 2017); predictive, the best
            candidate (predictive sampling; Howell et al., 2022); cem, mean and spread of the best ones (the
            cross-entropy method, warm-started as in iCEM; Pinneri et al., 2020).
        rollouts: number of candidates rolled out at once, each in its own env.
        horizon: planning horizon in seconds; 0 for 0.5 s, or 1 s if the task has no success, within 8 to 20 control
            steps.
        knots: number of equally spaced actions that define a candidate, interpolated in between.
        noise: standard deviation of the candidates' knots around the plan, relative to half the range of each action
            dimension.
        temperature: temperature of mppi, in standard deviations of the returns of the best quarter of the candidates; a
            lower one gives more weight to the best.
        elites: fraction of the candidates that form the next plan of cem.
        rounds: sampling and rollout iterations for each plan.
        every: control steps to take before planning again.
    """

    method: Method = "mppi"
    rollouts: int = 64
    horizon: float = 0.0
    knots: int = 4
    noise: float = 0.5
    temperature: float = 0.2
    elites: float = 0.1
    rounds: int = 1
    every: int = 1


@dataclass(frozen=True)
class PlanOptions(PlanArguments):
    """Validated `PlanArguments`: every value is within its range."""

    def __post_init__(self) -> None:
        """Raises ValueError with a sentence that names the option."""
        if self.method not in get_args(Method):
            raise ValueError(f"method must be one of {', '.join(get_args(Method))}, not {self.method!r}")
        for name, least in (("rollouts", _MIN_ROLLOUTS), ("knots", 2), ("rounds", 1), ("every", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"{name} must be at least {least}, not {getattr(self, name)}")
        for name in ("noise", "temperature", "elites"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be greater than 0, not {getattr(self, name)}")
        if self.elites > 1:
            raise ValueError(f"elites is a fraction of the candidates, at most 1, not {self.elites}")
        if not 0 <= self.horizon < math.inf:
            raise ValueError(f"horizon is a time in seconds, 0 for the default, not {self.horizon}")

    def steps(self, control_dt: float, has_success: bool = True) -> int:
        """H, the control steps of a plan: at least two, and at least `every`.

        Args:
            control_dt: simulated seconds of a control step.
            has_success: whether the task's ``evaluate`` reports success. A task without success has to hold a
                state, such as a balanced pole, and a plan of half a second is too short to see a fall.
        """
        fewest, most = _HORIZON_STEPS
        seconds = 0.5 if has_success else 1.0
        usual = min(most, max(fewest, round(seconds / control_dt)))
        steps = max(2, round(self.horizon / control_dt)) if self.horizon else usual
        return max(steps, self.every)
