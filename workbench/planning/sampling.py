"""Samples candidate actions around a plan, and updates the plan from their returns: predictive sampling, MPPI, CEM."""

from __future__ import annotations

import torch

from workbench.planning.options import PlanOptions

_NOISE_FACTORS = 0.05, 0.5
"""Minimum and maximum of the random factor on the noise of a third of the candidates: large steps do not
improve a plan that is nearly right."""
_MOVE_PROBABILITY = 0.5
"""Probability that a dimension gets noise, in the third of the candidates that move the same way at every
knot."""
_FLIP_PROBABILITY = 0.3
"""Probability that a knot of a switching dimension is redrawn, in half of the candidates. The other half
keeps the plan's knots in this dimension: a candidate that drops an object does not find how to carry it."""
_TOP_FRACTION = 0.25
"""MPPI's temperature is scaled by the spread of the returns of this fraction of the candidates, the best
ones. If many candidates drop an object, the spread of all returns is so wide that all good candidates would
get the same weight."""
_KEPT_CANDIDATES = 2
"""Number of best candidates of a round that are tried again in the next round."""
_MOTION_PENALTY = 1.0
"""MPPI's penalty on full motion in every dimension, in standard deviations of the best candidates' returns:
such a motion must earn this much more than holding still. Without the penalty, useless rotations add up, and
a hand that arrives tilted grasps badly."""
_MIN_SPREAD = 0.2
"""CEM's minimum spread, as a fraction of the noise: a spread of zero finds nothing new."""


class Sampler:
    """Plan of one env: knots of actions from -1 to 1, and candidates around the plan.

    A knot is an action at a time of the horizon: the first knot is now, the last at the end. Between knots a dimension is
    interpolated linearly; a switching dimension (a gripper) keeps the value of the previous knot, since a
    half-closed gripper holds nothing.
    """

    def __init__(
        self, options: PlanOptions, steps: int, switches: torch.Tensor, scale: torch.Tensor, seed: int
    ) -> None:
        """
        Args:
            steps: H, control steps of the horizon.
            switches: (A,) whether each dimension switches.
            scale: (A,) factor on the noise of each dimension.
            seed: seed of the random candidates.
        """
        self._options, self._steps, self._switches = options, steps, switches
        self._generator = torch.Generator().manual_seed(seed)
        self._noise = torch.where(switches, 1.0, options.noise * scale).expand(options.knots, -1)
        self._spread = self._noise
        self._mean: torch.Tensor | None = None
        self._kept: torch.Tensor | None = None
        self._hold = torch.zeros(len(switches))
        self._taken: torch.Tensor | None = None
        """(A,) the last action; None before the first."""
        self._times = torch.linspace(0, steps - 1, options.knots)
        self._weights = _weights(torch.arange(steps, dtype=torch.float32), self._times)

    @property
    def plan(self) -> torch.Tensor:
        """(P, A) knots of the plan; exists after the first call of `candidates`."""
        assert self._mean is not None
        return self._mean

    def draw_seed(self) -> int:
        """Draw a seed from this plan's own generator."""
        return int(torch.randint(2**31, (1,), generator=self._generator))

    def candidates(self, hold: torch.Tensor) -> torch.Tensor:
        """(K, P, A) knots within -1 to 1: the plan itself, holding still, the best candidates of the last
        round, and new candidates. A sixth of the new ones are drawn around holding still, since small steps
        do not escape from a bad plan; the others around the plan.

        Args:
            hold: (A,) the action that changes nothing; the initial plan of an episode. Switching dimensions
                keep their last value instead: a gripper that is commanded to the width of a held object drops
                the object.
        """
        if self._taken is not None:
            hold = torch.where(self._switches, self._taken, hold)
        self._hold = hold
        if self._mean is None:
            self._mean = hold.expand(self._options.knots, -1).clone()
        shape = (self._options.rollouts, *self._mean.shape)
        drawn = torch.randn(shape, generator=self._generator)
        flips = torch.rand(shape, generator=self._generator) < _FLIP_PROBABILITY
        flips &= torch.rand((shape[0], 1, 1), generator=self._generator) < 0.5
        some = torch.rand((shape[0], 1, shape[2]), generator=self._generator) < _MOVE_PROBABILITY
        # A third of the candidates move the same way at every knot, in some of the dimensions, to find the
        # effect of long motions.
        drawn[0::3], flips[0::3] = drawn[0::3, :1].clone(), flips[0::3, :1].clone()
        side = torch.sign(drawn)
        drawn[0::3] *= some[0::3]
        least, most = _NOISE_FACTORS
        power = torch.rand((len(drawn[2::3]), 1, 1), generator=self._generator)
        drawn[2::3] *= least * (most / least) ** power
        around = self._mean.repeat(shape[0], 1, 1)
        around[0::6] = hold
        switched = torch.where(flips, side, self._mean)
        knots = torch.where(self._switches, switched, around + drawn * self._spread)
        knots[0], knots[1] = self._mean, hold
        if self._kept is not None:
            knots[2 : 2 + len(self._kept)] = self._kept
        return knots.clamp_(-1, 1)

    def sequences(self, knots: torch.Tensor) -> torch.Tensor:
        """(K, H, A) actions of (K, P, A) knots."""
        return self._between(knots, self._weights)

    def improve(self, knots: torch.Tensor, returns: torch.Tensor) -> None:
        """Update the plan from the returns (K,) of candidates (K, P, A). NaN and infinite returns count as the worst."""
        finite = torch.isfinite(returns)
        if not finite.any():
            return
        returns = torch.where(finite, returns, -torch.inf)
        # Stable, because otherwise the order of equal returns depends on the machine.
        best = returns.argsort(descending=True, stable=True)
        if self._options.method == "predictive":
            self._mean = knots[best[0]].clone()
        elif self._options.method == "cem":
            count = max(2, round(self._options.elites * len(knots)))
            elites = knots[best[: min(count, int(finite.sum()))]]
            self._mean = elites.mean(0)
            least = _MIN_SPREAD * self._noise
            self._spread = 0.5 * self._spread + 0.5 * torch.maximum(elites.std(0, correction=0), least)
        else:
            top = returns[best[: min(max(2, round(_TOP_FRACTION * len(knots))), int(finite.sum()))]]
            spread = top.std(correction=0)
            moved = torch.where(self._switches, 0.0, (knots - self._hold).square()).mean((1, 2))
            returns = returns - _MOTION_PENALTY * spread * moved
            best = returns.argsort(descending=True, stable=True)
            width = self._options.temperature * spread
            weights = torch.softmax((returns - returns[best[0]]) / (width + 1e-12), 0)
            mean = (weights[:, None, None] * knots).sum(0)
            # A switching dimension takes the best candidate's value: the mean of open and closed is neither.
            self._mean = torch.where(self._switches, knots[best[0]], mean)
        self._kept = knots[best[:_KEPT_CANDIDATES]].clone()

    def shift(self, steps: int) -> None:
        """Shift the plan by the control steps that were taken, so that it begins at the current time."""
        if self._mean is not None:
            self._taken = self.sequences(self._mean[None])[0, min(steps, self._steps) - 1]
        weights = _weights((self._times + steps).clamp(max=self._steps - 1), self._times)
        if self._mean is not None:
            self._mean = self._between(self._mean, weights)
        if self._kept is not None:
            self._kept = self._between(self._kept, weights)
        self._spread = self._noise

    def _between(self, knots: torch.Tensor, weights: tuple[torch.Tensor, torch.Tensor]) -> torch.Tensor:
        lines, held = (torch.matmul(each, knots) for each in weights)
        return torch.where(self._switches, held, lines)


def _weights(at: torch.Tensor, times: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Two (T, P) arrays, the weights of the knots at the times `at`: for linear interpolation, and for
    holding the previous knot."""
    after = torch.searchsorted(times, at, right=True).clamp(1, len(times) - 1)
    part = ((at - times[after - 1]) / (times[after] - times[after - 1])).clamp(0, 1)
    return _rows(after, part, len(times)), _rows(after, (part >= 1).float(), len(times))


def _rows(after: torch.Tensor, part: torch.Tensor, knots: int) -> torch.Tensor:
    weights, rows = torch.zeros(len(after), knots), torch.arange(len(after))
    weights[rows, after - 1] += 1 - part
    weights[rows, after] += part
    return weights
