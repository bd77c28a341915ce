"""Six envs, each in a different state."""

from __future__ import annotations

import math

import numpy as np

from workbench.envs.outliers import Outlier, OutlierKind
from workbench.live.history.env_table import KEPT_REWARDS, EnvRows, LastEpisode

FELL = Outlier(OutlierKind.DROPPED, 12, "cube dropped 0.90 m")


def rows_of(**changes: object) -> EnvRows:
    """Six envs: running, solved, failed, cut off, running after a failure, running with an outlier."""
    rewards = np.full((6, KEPT_REWARDS), np.nan, np.float32)
    rewards[:, -3:] = np.arange(18).reshape(6, 3)
    values: dict[str, object] = {
        "outcome": np.array([0, 1, 2, 3, 0, 0], np.int8),
        "steps": np.array([3, 34, 20, 50, 3, 30], np.int32),
        "end": np.array([-1, 33, 20, 50, -1, -1], np.int32),
        "total": np.array([1.0, 20.0, 5.0, math.nan, 0.5, 3.0]),
        "followed": np.array([True, True, True, False, True, True]),
        "first": {"success": np.array([-1, 33, -1, -1, -1, -1]), "near": np.array([1, 20, -1, 7, -1, 0])},
        "rewards": rewards,
        "outliers": {5: (FELL,)},
        "by_hand": np.zeros(6, bool),
        "last": LastEpisode(
            np.array([1, 0, 0, 0, 2, 0], np.int8),
            np.array([41, -1, -1, -1, 9, -1], np.int32),
            np.zeros(6),
            {},
        ),
        "ended": np.array([5, 1, 1, 1, 2, 0]),
        "succeeded": np.array([3, 1, 0, 0, 0, 0]),
        "failed": np.array([1, 0, 1, 0, 2, 0]),
    }
    return EnvRows(**{**values, **changes})  # type: ignore[arg-type]
