"""CPU envs: batched, as the workbench makes them, and ManiSkill's own single env."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import mani_skill.envs  # noqa: F401  registers the ids
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils.registration import REGISTERED_ENVS

from workbench.envs.broken_rule import warn_of
from workbench.envs.gpu_rules import Degree, Finding
from workbench.envs.task_env import EnvOptions, make_env

CPU: Any = {"backend": "cpu", "render_backend": "none"}
"""Arguments of `workbench.make` for the CPU without a renderer."""
PICK_CUBE: Any = REGISTERED_ENVS["PickCube-v1"].cls
PUSH_CUBE: Any = REGISTERED_ENVS["PushCube-v1"].cls


def batched(
    task: str | type[BaseEnv],
    num_envs: int = 2,
    *,
    render: bool = False,
    rules: Degree | None = None,
    on_finding: Callable[[Finding], None] = warn_of,
    **kwargs: Any,
) -> Any:
    """The unwrapped env of a task id or class; `kwargs` go to the task."""
    spec = REGISTERED_ENVS[task] if isinstance(task, str) else None
    options = EnvOptions(num_envs, "cpu", render=render, rules=rules, on_finding=on_finding, kwargs=kwargs)
    if spec is None:
        return make_env(task, options)  # type: ignore[arg-type]
    return make_env(spec.cls, options, default_kwargs=spec.default_kwargs)


def stock(task: str, render_backend: str = "none", **kwargs: Any) -> Any:
    """ManiSkill's own single CPU env, unwrapped."""
    return gym.make(task, num_envs=1, render_backend=render_backend, **kwargs).unwrapped
