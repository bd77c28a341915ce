"""How each env's episode stood at one moment: what the table of envs must know again when somebody goes back there.

The table follows the batch forward, and what it says of an env (return, first times, outliers) cannot be read off a
moment of the past. So it leaves this with every moment. Arrays are never written to, and shared by the moments
between which they did not change: what a step adds is one array of returns.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from workbench.session.outliers import Outlier


@dataclass(frozen=True)
class LastEpisode:
    """The episode before the present one, of each env; only of those that ended or had outliers."""

    outcome: NDArray[np.int8]
    """(N,) `Outcome`; RUNNING where it was cut short, or there was none (then `steps` is -1)."""
    steps: NDArray[np.int32]
    """(N,) control steps until its end."""
    total: NDArray[np.float64]
    """(N,) its return until its end."""
    outliers: dict[int, tuple[Outlier, ...]]
    """By env; envs without any are not in it."""


@dataclass(frozen=True)
class Standing:
    """See `env_table.EnvRows`, whose fields these are."""

    outcome: NDArray[np.int8]
    end: NDArray[np.int32]
    total: NDArray[np.float64]
    followed: NDArray[np.bool_]
    first_true: dict[str, NDArray[np.int32]]
    outliers: dict[int, tuple[Outlier, ...]]
    last: LastEpisode

    @staticmethod
    def bytes_a_step(num_envs: int) -> int:
        """What one more of them takes, nearly always."""
        return 8 * num_envs + 400
