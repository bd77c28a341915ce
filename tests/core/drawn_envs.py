"""A task batched and stock, after the same reset, with a renderer where one is wanted."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import mani_skill.envs  # noqa: F401  registers the ids
from mani_skill.utils.registration import REGISTERED_ENVS

from workbench.core.task_env import EnvOptions, make_env

SEED = 3


def batched(task: Any, num_envs: int = 2, render: bool = True, **kwargs: Any) -> Any:
    """Of an id, or of a class."""
    cls = REGISTERED_ENVS[task].cls if isinstance(task, str) else task
    env = make_env(cls, EnvOptions(num_envs=num_envs, backend="cpu", render=render, kwargs=kwargs))
    env.reset(seed=SEED)
    return env


def stock(task: str, **kwargs: Any) -> Any:
    """ManiSkill's own single env."""
    env: Any = gym.make(task, render_backend="cpu", **kwargs).unwrapped
    env.reset(seed=SEED)
    return env
