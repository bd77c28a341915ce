"""The same task as a batch and as ManiSkill's single env, both after a reset with `SEED`."""

from __future__ import annotations

from typing import Any

from tests.drive import envs
from tests.drive.render_device import RENDER_BACKEND

SEED = 3


def batched(task: Any, num_envs: int = 2, render: bool = True, **kwargs: Any) -> Any:
    """Return a batch of `task`, an env id or a class."""
    env = envs.batched(task, num_envs, render=render, **kwargs)
    env.reset(seed=SEED)
    return env


def stock(task: str, **kwargs: Any) -> Any:
    """Return ManiSkill's own single CPU env of `task`."""
    env = envs.stock(task, render_backend=RENDER_BACKEND, **kwargs)
    env.reset(seed=SEED)
    return env
