"""The recent past of the batch, for curves: reward and success of every env, bounded in length.

Kept for all envs, not only for the one that is looked at, so that choosing another env shows its past
and not an empty plot.
"""

from __future__ import annotations

import numpy as np

from workbench.session.messages import Stepped
from workbench.session.view import Curves

_LENGTH = 1000


class RecentCurves:
    """A ring of rows, one a control step; `curves` gives them oldest first."""

    def __init__(self, num_envs: int) -> None:
        self._tick = np.zeros(_LENGTH, np.int64)
        self._reward = np.zeros((_LENGTH, num_envs), np.float32)
        self._success = np.full((_LENGTH, num_envs), np.nan, np.float32)
        self._started = np.zeros((_LENGTH, num_envs), bool)
        self._count = 0
        self._new_episode = np.ones(num_envs, bool)

    def add(self, stepped: Stepped) -> None:
        """A reset is not a row of its own: it marks the next row as the start of an episode."""
        self._new_episode |= stepped.reset_mask
        if stepped.reset_mask.any():
            return
        row = self._count % _LENGTH
        self._tick[row] = self._count
        self._reward[row] = stepped.step.reward
        success = stepped.step.evaluate.get("success")
        self._success[row] = (
            np.nan if success is None else success.reshape(len(stepped.step.reward), -1)[:, 0]
        )
        self._started[row] = self._new_episode
        self._new_episode = np.zeros_like(self._new_episode)
        self._count += 1

    @property
    def count(self) -> int:
        """Control steps so far, which is one past the tick of the newest row."""
        return self._count

    def curves(self) -> Curves:
        rows = np.arange(max(0, self._count - _LENGTH), self._count) % _LENGTH
        return Curves(
            self._count, self._tick[rows], self._reward[rows], self._success[rows], self._started[rows]
        )
