"""What one control step of the whole batch gives, as plain arrays that can cross a pipe."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class StepResult:
    """The state of all N envs after a reset or a control step. Leading dimension is always N."""

    elapsed_steps: NDArray[np.int32]
    """(N,) control steps since each env's reset."""
    reward: NDArray[np.float32]
    """(N,); zero right after a reset."""
    terminated: NDArray[np.bool_]
    """(N,) success or fail, as ManiSkill defines it."""
    truncated: NDArray[np.bool_]
    """(N,) the time limit of ``@register_env(max_episode_steps=...)`` was reached."""
    evaluate: dict[str, NDArray]
    """Every entry that ``evaluate()`` returned, each (N, ...)."""
    poses: NDArray[np.float32]
    """(N, B, 7) of every body: position in metres, quaternion wxyz, env's own frame."""
    action: NDArray[np.float32] | None = None
    """(N, A) that led here; None right after a reset."""
    sound_obs: NDArray[np.bool_] | None = None
    """(N,) whether all numbers of the env's observation are finite, pictures left out; None where nothing is known
    of it."""
