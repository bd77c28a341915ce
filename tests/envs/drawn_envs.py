"""A task batched and stock, after the same reset, with a renderer where one is wanted."""

from __future__ import annotations

from typing import Any

from tests.drive import envs
from tests.drive.render_device import RENDER_BACKEND

SEED = 3


def batched(task: Any, num_envs: int = 2, render: bool = True, **kwargs: Any) -> Any:
    """Of an id, or of a class."""
    env = envs.batched(task, num_envs, render=render, **kwargs)
    env.reset(seed=SEED)
    return env


def stock(task: str, **kwargs: Any) -> Any:
    """ManiSkill's own single env."""
    env = envs.stock(task, render_backend=RENDER_BACKEND, **kwargs)
    env.reset(seed=SEED)
    return env
