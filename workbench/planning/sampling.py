"""Candidate actions around a plan, and the plan that their returns make of them: predictive sampling, MPPI, CEM."""

from __future__ import annotations

import torch

from workbench.planning.options import PlanOptions

_SMALL = 0.05, 0.5
"""Smallest and largest factor on the noise, for a third of the candidates: large steps do not improve a nearly right
plan."""
_MOVED = 0.5
"""Probability that a dimension differs from the plan, in a third of the candidates."""
_FLIPS = 0.3
"""Probability that a knot of a switching dimension is redrawn, in half of the candidates: candidates that drop an
object do not find how to carry it."""
_TOP = 0.25
"""Fraction of the candidates, the best ones, whose spread of returns scales MPPI's temperature: where many candidates
drop an object, the spread of all is so wide that the good ones all get the same weight."""
_KEPT = 2
"""Best candidates of a round that are tried again in the next."""
_QUIET = 1.0
"""MPPI's penalty on motion, in spreads of the best candidates: what full motion in every dimension must earn more than
holding still. Without the penalty, turns that earn nothing add up, and a hand that arrives tilted grasps badly."""
_LEAST_SPREAD = 0.2
"""CEM's smallest spread, as a fraction of the noise: a spread of zero finds nothing new."""


class Sampler:
    """Plan of one env: knots of actions from -1 to 1, and candidates around the plan.

    A knot is an action at a time of the horizon: the first is now, the last at its end. Between knots a dimension goes along
    a straight line; one that switches (a gripper) stays as at the knot before, since what is half closed holds nothing.
    """

    def __init__(
        self, options: PlanOptions, steps: int, switches: torch.Tensor, scale: torch.Tensor, seed: int
    ) -> None:
        """
        Args:
            steps: H, control steps of the horizon.
            switches: (A,) bool, dimensions that switch.
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
        """(A,) the action that was taken last; None before the first."""
        self._times = torch.linspace(0, steps - 1, options.knots)
        self._weights = _weights(torch.arange(steps, dtype=torch.float32), self._times)

    @property
    def plan(self) -> torch.Tensor:
        """(P, A) knots of the plan; there is one from the first `candidates` on."""
        assert self._mean is not None
        return self._mean

    def draw_seed(self) -> int:
        """A seed of this plan's own random numbers."""
        return int(torch.randint(2**31, (1,), generator=self._generator))

    def candidates(self, hold: torch.Tensor) -> torch.Tensor:
        """(K, P, A) knots within -1 to 1: the plan itself, holding still, the best of the last round, others around the plan,
        and a sixth around holding still, since a plan that leads nowhere is not left by small steps.

        Args:
            hold: (A,) the action that changes nothing; the plan that an episode begins with. What switches stays as it was
                last: a gripper that is told to stay at the width of what it holds lets it fall.
        """
        if self._taken is not None:
            hold = torch.where(self._switches, self._taken, hold)
        self._hold = hold
        if self._mean is None:
            self._mean = hold.expand(self._options.knots, -1).clone()
        shape = (self._options.rollouts, *self._mean.shape)
        drawn = torch.randn(shape, generator=self._generator)
        flips = torch.rand(shape, generator=self._generator) < _FLIPS
        flips &= torch.rand((shape[0], 1, 1), generator=self._generator) < 0.5
        some = torch.rand((shape[0], 1, shape[2]), generator=self._generator) < _MOVED
        # What only a long motion shows is found by a third of one action throughout, in some of the dimensions.
        drawn[0::3], flips[0::3] = drawn[0::3, :1].clone(), flips[0::3, :1].clone()
        side = torch.sign(drawn)
        drawn[0::3] *= some[0::3]
        least, most = _SMALL
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
        """Make the plan of the returns (K,) of candidates (K, P, A). One that is NaN or infinite counts as the worst."""
        finite = torch.isfinite(returns)
        if not finite.any():
            return
        returns = torch.where(finite, returns, -torch.inf)
        # Stable: equal returns would else be in an order that depends on the machine.
        best = returns.argsort(descending=True, stable=True)
        if self._options.method == "predictive":
            self._mean = knots[best[0]].clone()
        elif self._options.method == "cem":
            count = max(2, round(self._options.elites * len(knots)))
            elites = knots[best[: min(count, int(finite.sum()))]]
            self._mean = elites.mean(0)
            least = _LEAST_SPREAD * self._noise
            self._spread = 0.5 * self._spread + 0.5 * torch.maximum(elites.std(0, correction=0), least)
        else:
            top = returns[best[: min(max(2, round(_TOP * len(knots))), int(finite.sum()))]]
            spread = top.std(correction=0)
            moved = torch.where(self._switches, 0.0, (knots - self._hold).square()).mean((1, 2))
            returns = returns - _QUIET * spread * moved
            best = returns.argsort(descending=True, stable=True)
            width = self._options.temperature * spread
            weights = torch.softmax((returns - returns[best[0]]) / (width + 1e-12), 0)
            mean = (weights[:, None, None] * knots).sum(0)
            # The mean of open and closed would be neither.
            self._mean = torch.where(self._switches, knots[best[0]], mean)
        self._kept = knots[best[:_KEPT]].clone()

    def shift(self, steps: int) -> None:
        """Move the plan on by control steps that were taken: what was planned for then is at its beginning now."""
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
    """(T, P) parts of each knot in the value at times (T,): along straight lines, and as at the knot before."""
    after = torch.searchsorted(times, at, right=True).clamp(1, len(times) - 1)
    part = ((at - times[after - 1]) / (times[after] - times[after - 1])).clamp(0, 1)
    return _rows(after, part, len(times)), _rows(after, (part >= 1).float(), len(times))


def _rows(after: torch.Tensor, part: torch.Tensor, knots: int) -> torch.Tensor:
    weights, rows = torch.zeros(len(after), knots), torch.arange(len(after))
    weights[rows, after - 1] += 1 - part
    weights[rows, after] += part
    return weights
