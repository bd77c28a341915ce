"""The past of the batch as rows of numbers: what the curves are, and what is drawn under the time slider.

Both are drawn several times a second, and going through some thousand moments one by one for it would take longer than a
step. They are kept of all envs, so that choosing another env shows its past and not an empty plot.

A dense reward is a sum, and its total does not say which part is stuck. ManiSkill has no place for the parts, so the
workbench names one: ``info["reward_terms"]``, a dict of tensors (N,), put there by ``compute_dense_reward``, which is
given ``info``. ManiSkill hands ``info`` on as it is, nested dicts included, so the same file runs everywhere. In a
`StepResult` a term is the entry ``reward_terms/<name>``. A term that is no number for each env is shown among the numbers,
and has no curve.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from workbench.core.env.step_result import StepResult

PREFIX = "reward_terms/"
MOST = 12
"""Terms that are followed; more cannot be told apart."""
_LENGTH = 1000
"""Steps of a curve."""
_FIRST_ROWS = 1024


class Columns:
    """Columns of numbers by name, each of shape (rows, N). Rows have numbers that count up; the oldest are dropped when
    there is no room."""

    def __init__(self, num_envs: int, first: int = 0) -> None:
        """
        Args:
            first: the number of the first row.
        """
        self._num_envs, self._base, self._room = num_envs, first, _FIRST_ROWS
        self._columns: dict[str, NDArray[np.float32]] = {}

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self._columns)

    def write(self, number: int, oldest: int, values: Mapping[str, ArrayLike]) -> None:
        """
        Args:
            number: of the newest row, or the one after it.
            oldest: number of the oldest row that is still wanted.
            values: (N,) by name of the column; what is not in it is NaN in this row.
        """
        if number - self._base == self._room:
            kept = slice(oldest - self._base, self._room)
            self._base, self._room = oldest, max(_FIRST_ROWS, 2 * (number - oldest))
            before, self._columns = self._columns, {}
            for name, column in before.items():
                if not np.isnan(column[kept]).all():
                    self._new(name)[: number - oldest] = column[kept]
        for name in values:
            if name not in self._columns:
                self._new(name)
        for name, column in self._columns.items():
            column[number - self._base] = values.get(name, np.nan)

    def between(self, name: str, low: int, high: int) -> NDArray[np.float32]:
        """(K, N) of the rows from `low` to `high`, both of rows that are wanted; NaN in a column that is not there.

        What is given changes only where one of these rows is written again.
        """
        rows = slice(low - self._base, max(low, high + 1) - self._base)
        column = self._columns.get(name)
        if column is None:
            return np.full((rows.stop - rows.start, self._num_envs), np.nan, np.float32)
        return column[rows]

    def _new(self, name: str) -> NDArray[np.float32]:
        column = self._columns[name] = np.full((self._room, self._num_envs), np.nan, np.float32)
        return column


@dataclass(frozen=True)
class Curves:
    """The past of the batch, oldest first, bounded in length; kept over env selection."""

    serial: int
    """Control steps so far: the tick of the newest row."""
    tick: NDArray[np.int64]
    """(T,) control steps since the task was loaded; the first is 1, as in a recording."""
    reward: NDArray[np.float32]
    """(T, N)"""
    success: NDArray[np.float32]
    """(T, N) 0 or 1; NaN for a task that has no ``success``."""
    parts: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)
    """(T, N) of each term of the reward by name; NaN where a step did not have it."""
    no_curve: tuple[str, ...] = ()
    """Names of what the last step put there that is no number for each env."""

    @property
    def terms(self) -> dict[str, NDArray[np.float32]]:
        """Of `parts` those that are drawn: one that is gone for as long as a curve is long has none any more."""
        return {name: values for name, values in self.parts.items() if not np.isnan(values).all()}


class RecentSteps:
    """Reward, success and the reward's terms of the newest control steps."""

    def __init__(self, num_envs: int) -> None:
        self._num_envs, self._columns = num_envs, Columns(num_envs)
        self._no_curve: tuple[str, ...] = ()
        self.count = 0
        """Control steps so far."""

    def add(self, step: StepResult) -> None:
        """The next control step. A reset has no reward, so it is none."""
        of_each_env = {
            name: values.reshape(self._num_envs, -1)[:, 0]
            for name, values in step.evaluate.items()
            if name == "success" or (name.startswith(PREFIX) and values.size == self._num_envs)
        }
        self._no_curve = tuple(
            name.removeprefix(PREFIX)
            for name in [*step.evaluate, *step.others]
            if (name.startswith(PREFIX) or name == PREFIX[:-1]) and name not in of_each_env
        )
        known = self._columns.names
        new = [name for name in of_each_env if name.startswith(PREFIX) and name not in known]
        room = MOST - sum(name.startswith(PREFIX) for name in known)
        for name in new[max(0, room) :]:
            del of_each_env[name]
        # A reload may drop a term, and the old one's values do not stand for the new steps: they are NaN there.
        self._columns.write(self.count, max(0, self.count - _LENGTH), {"reward": step.reward, **of_each_env})
        self.count += 1

    def curves(self) -> Curves:
        """Nothing is copied for it: a row is written once."""
        first, last, columns = max(0, self.count - _LENGTH), self.count - 1, self._columns
        reward, success = (columns.between(name, first, last) for name in ("reward", "success"))
        parts = {
            name.removeprefix(PREFIX): columns.between(name, first, last)
            for name in columns.names
            if name.startswith(PREFIX)
        }
        return Curves(self.count, np.arange(first, self.count) + 1, reward, success, parts, self._no_curve)
