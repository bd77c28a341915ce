"""Plan and take steps, in a test or in a child process."""

from __future__ import annotations

from typing import Any

import numpy as np

import workbench
from workbench.envs.maniskill_private import open_env

SMALL: dict[str, Any] = {"rollouts": 8, "horizon": 0.2}
MADE: dict[str, Any] = {"control_mode": "pd_ee_delta_pose", "render_backend": "none", "backend": "cpu"}


def walk(env: Any, planner: workbench.Planner, env_idx: list[int] | None, steps: int = 3) -> np.ndarray:
    """Reset, then plan and take `steps`; return the actions, (T, N, A)."""
    env.reset(seed=[5, 6, 7, 8][: open_env(env).num_envs])
    planner.reset()
    taken = []
    for _ in range(steps):
        action = planner.actions(env_idx)
        env.step(action)
        taken.append(action.numpy().copy())
    return np.stack(taken)
