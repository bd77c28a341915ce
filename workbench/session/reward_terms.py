"""The parts of a reward over time, for tasks that name them.

A dense reward is a sum, and its total does not say which part is stuck. ManiSkill has no place for the parts,
so the workbench names one: ``info["reward_terms"]``, a dict of tensors (N,), put there by
``compute_dense_reward``, which is given ``info``. ManiSkill hands ``info`` on as it is, nested dicts included,
so the same file runs everywhere. In a `StepResult` a term is the entry ``reward_terms/<name>``. A term that is no number
for each env is shown among the numbers, and has no curve.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from workbench.session.messages import Stepped

PREFIX = "reward_terms/"
MOST = 12
"""Terms that are followed; more cannot be told apart."""
_LENGTH = 1000


@dataclass(frozen=True)
class TermCurves:
    """Oldest first."""

    tick: NDArray[np.int64]
    """(T,) control steps since the task was loaded."""
    terms: dict[str, NDArray[np.float32]]
    """By name: (T, N); NaN where a step did not have that term."""
    no_curve: tuple[str, ...] = ()
    """Names of what the last step put there that is no number for each env."""


class TermHistory:
    """A ring of rows, one a control step."""

    def __init__(self, num_envs: int, length: int = _LENGTH) -> None:
        self._num_envs, self._length = num_envs, length
        self._tick = np.zeros(length, np.int64)
        self._terms: dict[str, NDArray[np.float32]] = {}
        self._no_curve: tuple[str, ...] = ()
        self._count = 0

    def add(self, stepped: Stepped) -> None:
        """A reset has no reward, so it is no row."""
        if stepped.reset_mask.any():
            return
        row = self._count % self._length
        self._tick[row] = self._count
        found = {
            name.removeprefix(PREFIX): values
            for name, values in stepped.step.evaluate.items()
            if name.startswith(PREFIX) and values.size == self._num_envs
        }
        self._no_curve = tuple(
            name.removeprefix(PREFIX)
            for name in [*stepped.step.evaluate, *stepped.step.others]
            if name.startswith(PREFIX) or name == PREFIX[:-1]
            if name.removeprefix(PREFIX) not in found
        )
        for name in found:
            if name not in self._terms and len(self._terms) < MOST:
                self._terms[name] = np.full((self._length, self._num_envs), np.nan, np.float32)
        for name, kept in self._terms.items():
            # A reload may drop a term, and the old one's values must not stand for the new steps.
            kept[row] = found[name].reshape(self._num_envs, -1)[:, 0] if name in found else np.nan
        self._count += 1

    def curves(self) -> TermCurves:
        rows = np.arange(max(0, self._count - self._length), self._count) % self._length
        kept = {name: values[rows] for name, values in self._terms.items()}
        # A term that is gone for as long as the ring is long has no curve any more.
        drawn = {n: v for n, v in kept.items() if not np.isnan(v).all()}
        return TermCurves(self._tick[rows], drawn, self._no_curve)
