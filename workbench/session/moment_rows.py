"""What happened to each env at each moment, and its reward, as rows of arrays: what is drawn under the time slider.

A strip of some thousand moments is drawn several times a second, and going through the moments one by one for it would
take longer than a step.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_FIRST_ROWS = 1024


class MomentRows:
    """Rows by the serial of their moment; they grow at the end, and the oldest are dropped when there is no room."""

    def __init__(self, num_envs: int, first_serial: int) -> None:
        self._base = first_serial
        self._happened = np.zeros((_FIRST_ROWS, num_envs), np.uint8)
        self._reward = np.zeros((_FIRST_ROWS, num_envs), np.float32)

    def write(
        self, serial: int, oldest: int, happened: NDArray[np.uint8], reward: NDArray[np.float32]
    ) -> None:
        """
        Args:
            serial: of the newest moment, or the one after it.
            oldest: of the moments that are kept.
            happened: (N,)
            reward: (N,)
        """
        if serial - self._base == len(self._reward):
            kept = slice(oldest - self._base, serial - self._base)
            rows = max(_FIRST_ROWS, 2 * (serial - oldest))
            self._happened = _moved(self._happened[kept], rows)
            self._reward = _moved(self._reward[kept], rows)
            self._base = oldest
        self._happened[serial - self._base] = happened
        self._reward[serial - self._base] = reward

    def events(self, env: int, low: int, high: int) -> list[tuple[int, int]]:
        """Serials from `low` to `high`, both of moments that are kept, at which something happened, and what."""
        happened = self._happened[self._rows(low, high), env]
        return [(low + int(k), int(happened[k])) for k in np.flatnonzero(happened)]

    def rewards(self, env: int, low: int, high: int) -> NDArray[np.float32]:
        """(K,) of the moments from `low` to `high`, both kept."""
        return self._reward[self._rows(low, high), env].copy()

    def _rows(self, low: int, high: int) -> slice:
        return slice(low - self._base, max(low, high + 1) - self._base)


def _moved(kept: NDArray, rows: int) -> NDArray:
    new = np.zeros((rows, kept.shape[1]), kept.dtype)
    new[: len(kept)] = kept
    return new
