"""Candidate action sequences around a plan, and the plan that their returns make better: predictive sampling, MPPI, CEM."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

import torch

Method = Literal["mppi", "predictive", "cem"]


@dataclass(frozen=True)
class PlanOptions:
    """How a plan is searched. The defaults solve most tabletop tasks; see ``web_assets/docs/solve.md``."""

    method: Method = "mppi"
    """``mppi``: the mean of all candidates, weighted by return (Williams et al., 2017). ``predictive``: the best candidate
    (Howell et al., 2022, predictive sampling). ``cem``: the mean and spread of the best ones (Pinneri et al., 2020, iCEM)."""
    rollouts: int = 64
    """K, candidates a round; each is an env."""
    horizon: float = 0.0
    """Seconds that a plan looks ahead; 0 for half a second, and from 8 to 20 control steps."""
    knots: int = 4
    """Actions that a candidate consists of; between them it is interpolated."""
    noise: float = 0.5
    """Standard deviation of a candidate's knots, of half the range of each action dimension."""
    temperature: float = 0.1
    """Of MPPI, in standard deviations of the returns: the lower, the more the best candidates count."""
    elites: float = 0.1
    """Of CEM: the part of the candidates that make the next plan."""
    rounds: int = 1
    """Times that candidates are drawn and rolled out for a plan."""
    every: int = 1
    """Control steps that are taken before the next plan."""

    def __post_init__(self) -> None:
        if self.method not in get_args(Method):
            raise ValueError(f"method must be one of {', '.join(get_args(Method))}, not {self.method!r}")
        for name, least in (("rollouts", 2), ("knots", 2), ("rounds", 1), ("every", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"{name} must be at least {least}, not {getattr(self, name)}")
        for name in ("noise", "temperature", "elites"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be above 0, not {getattr(self, name)}")
        if not 0 <= self.horizon < math.inf:
            raise ValueError(f"horizon is a time in seconds, 0 for the usual one, not {self.horizon}")

    def steps(self, control_dt: float) -> int:
        """H, control steps of the horizon."""
        if self.horizon:
            return max(2, round(self.horizon / control_dt))
        return min(20, max(8, round(0.5 / control_dt)))


class Sampler:
    """The plan of one env: knots of actions from -1 to 1, and candidates around them.

    A knot is an action at a time of the horizon; the first is now, the last at its end. Between knots a dimension goes
    along a straight line; one that switches (a gripper) stays as at the knot before.
    """

    def __init__(
        self, options: PlanOptions, steps: int, switches: torch.Tensor, scale: torch.Tensor, seed: int
    ) -> None:
        """
        Args:
            steps: H, control steps of the horizon.
            switches: (A,) bool, dimensions that switch.
            scale: (A,) factor on the noise of each dimension.
            seed: of the candidates.
        """
        self._options, self._steps, self._switches = options, steps, switches
        self._generator = torch.Generator().manual_seed(seed)
        self._noise = torch.where(switches, 1.0, options.noise * scale)
        self._spread = self._noise.expand(options.knots, len(switches)).clone()
        self._mean: torch.Tensor | None = None
        self._kept: torch.Tensor | None = None
        times = torch.linspace(0, steps - 1, options.knots)
        self._times = times
        self._lines = _line_weights(torch.arange(steps, dtype=torch.float32), times)
        self._steps_of_switches = _line_weights(torch.arange(steps, dtype=torch.float32), times, hold=True)

    def candidates(self, hold: torch.Tensor) -> torch.Tensor:
        """(K, P, A) knots: the plan itself, holding still, and the others around the plan.

        Args:
            hold: (A,) the action that changes nothing.
        """
        if self._mean is None:
            self._mean = hold.expand(self._options.knots, -1).clone()
        count = self._options.rollouts
        drawn = torch.randn((count, *self._mean.shape), generator=self._generator)
        # A third of them small: what is nearly right is not only improved by chance.
        drawn[2::3] *= 0.3
        # And a third one action throughout: what only long motions show is found by them.
        drawn[3::3] = drawn[3::3, :1]
        knots = self._mean + drawn * self._spread
        flips = torch.rand((count, *self._mean.shape), generator=self._generator) < 0.3
        side = torch.sign(drawn)
        knots = torch.where(self._switches, torch.where(flips, side, self._mean), knots)
        knots[0] = self._mean
        knots[1] = hold
        if self._kept is not None:
            knots[2 : 2 + len(self._kept)] = self._kept
        return knots.clamp_(-1, 1)

    def sequences(self, knots: torch.Tensor) -> torch.Tensor:
        """(K, H, A) actions of (K, P, A) knots."""
        lines = torch.einsum("hp,kpa->kha", self._lines, knots)
        held = torch.einsum("hp,kpa->kha", self._steps_of_switches, knots)
        return torch.where(self._switches, held, lines)

    def improve(self, knots: torch.Tensor, returns: torch.Tensor) -> None:
        """Make the plan anew from the returns (K,) of candidates (K, P, A); one that is not finite counts as the worst."""
        returns = torch.where(torch.isfinite(returns), returns, -torch.inf)
        best = returns.argsort(descending=True, stable=True)
        if not torch.isfinite(returns[best[0]]):
            return
        finite = returns[torch.isfinite(returns)]
        if self._options.method == "predictive":
            self._mean = knots[best[0]].clone()
        elif self._options.method == "cem":
            elites = knots[best[: max(2, round(self._options.elites * len(knots)))]]
            self._mean = elites.mean(0)
            self._spread = 0.5 * self._spread + 0.5 * torch.maximum(elites.std(0), 0.2 * self._noise)
        else:
            spread = finite.std() if len(finite) > 1 else torch.ones(())
            weights = torch.softmax((returns - finite.max()) / (self._options.temperature * spread + 1e-12), 0)
            self._mean = torch.einsum("k,kpa->pa", weights, knots)
        self._kept = knots[best[:2]].clone()

    @property
    def plan(self) -> torch.Tensor:
        """(P, A) the knots of the plan."""
        assert self._mean is not None
        return self._mean

    def shift(self, steps: int) -> None:
        """Move the plan on by control steps that were taken: what was planned for then is at its beginning now."""
        if self._mean is None:
            return
        moved = (self._times + steps).clamp(max=self._steps - 1)
        lines = _line_weights(moved, self._times)
        held = _line_weights(moved, self._times, hold=True)

        def later(knots: torch.Tensor) -> torch.Tensor:
            return torch.where(self._switches, held @ knots, lines @ knots)

        self._mean = later(self._mean)
        if self._kept is not None:
            self._kept = later(self._kept)
        if self._options.method == "cem":
            self._spread = self._noise.expand_as(self._spread).clone()


def _line_weights(at: torch.Tensor, times: torch.Tensor, hold: bool = False) -> torch.Tensor:
    """(T, P) parts of each knot in the value at times (T,); with `hold` that of the knot before."""
    after = torch.searchsorted(times, at, right=True).clamp(1, len(times) - 1)
    part = ((at - times[after - 1]) / (times[after] - times[after - 1])).clamp(0, 1)
    part = torch.where(part >= 1, 1.0, 0.0) if hold else part
    weights = torch.zeros(len(at), len(times))
    rows = torch.arange(len(at))
    weights[rows, after - 1] += 1 - part
    weights[rows, after] += part
    return weights
