"""The ManiSkill env that a caller means, whatever it is wrapped in, or a sentence that says what is wrong with it."""

from __future__ import annotations

from typing import Any

from mani_skill.envs.sapien_env import BaseEnv


def open_env(env: Any) -> BaseEnv:
    """The env under its wrappers: ``base_env`` of ManiSkillVectorEnv, ``unwrapped`` of all others.

    Raises:
        TypeError: there is no ManiSkill env.
        RuntimeError: it was closed.
    """
    env = getattr(getattr(env, "base_env", env), "unwrapped", env)
    if not isinstance(env, BaseEnv):
        raise TypeError(f"a ManiSkill env is wanted, not {type(env).__name__}")
    if env.scene is None:
        raise RuntimeError("this env was closed: there is no simulation any more")
    return env
