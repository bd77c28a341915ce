"""Numbers of all envs over the past steps, as arrays for curves and the time slider."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from workbench.core.env.step_result import StepResult

PREFIX = "reward_terms/"
"""Of the entries of a `StepResult` that are terms of a dense reward.

``compute_dense_reward`` puts them into ``info["reward_terms"]``, a dict of tensors (N,). The key is the workbench's own,
since ManiSkill has no place for them; it passes ``info`` on unchanged, nested dicts included, so such a file runs in stock
ManiSkill too. A term that is not one number an env is shown among the numbers, without a curve.
"""
MOST = 12
"""Terms with a curve; more cannot be told apart."""
_LENGTH = 1000
"""Steps of a curve."""
_FIRST_ROWS = 1024


class Columns:
    """Columns of numbers by name, each (rows, N). Rows are numbered upwards; the oldest are dropped when space runs out.

    Curves are drawn several times a second: reading them from some thousand moments would take longer than a step.
    """

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
            oldest: number of the oldest row to keep.
            values: (N,) by name of the column; missing columns become NaN in this row.
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
        """(K, N) of the rows from `low` to `high`, both kept ones and included; NaN if there is no such column.

        A view, not a copy: it changes if one of these rows is written again.
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
    """The newest steps of all envs, oldest first, bounded in length."""

    serial: int
    """Control steps so far: the tick of the newest row."""
    tick: NDArray[np.int64]
    """(T,) control steps since the task was loaded; the first is 1, as in a recording."""
    reward: NDArray[np.float32]
    """(T, N)"""
    success: NDArray[np.float32]
    """(T, N) 0 or 1; NaN for a task that has no ``success``."""
    parts: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)
    """(T, N) of each term of the reward by name; NaN in steps without it."""
    no_curve: tuple[str, ...] = ()
    """Names of the last step's terms that are not one number an env."""

    @property
    def terms(self) -> dict[str, NDArray[np.float32]]:
        """Those of `parts` that have a value in these steps."""
        return {name: values for name, values in self.parts.items() if not np.isnan(values).all()}


class RecentSteps:
    """Reward, success and the reward's terms of the newest control steps."""

    def __init__(self, num_envs: int) -> None:
        self._num_envs, self._columns = num_envs, Columns(num_envs)
        self._no_curve: tuple[str, ...] = ()
        self.count = 0
        """Control steps so far."""

    def add(self, step: StepResult) -> None:
        """Add a control step. Resets are left out, since they have no reward."""
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
        # A term that a reload dropped becomes NaN in the new steps.
        self._columns.write(self.count, max(0, self.count - _LENGTH), {"reward": step.reward, **of_each_env})
        self.count += 1

    def curves(self) -> Curves:
        """Views of the columns, without a copy: a row is written once."""
        first, last, columns = max(0, self.count - _LENGTH), self.count - 1, self._columns
        reward, success = (columns.between(name, first, last) for name in ("reward", "success"))
        parts = {
            name.removeprefix(PREFIX): columns.between(name, first, last)
            for name in columns.names
            if name.startswith(PREFIX)
        }
        return Curves(self.count, np.arange(first, self.count) + 1, reward, success, parts, self._no_curve)
