"""The keywords of ``gym.make`` that make an env again, as far as a text file can say them.

Whoever replays a recording makes the env anew: ManiSkill's ``replay_trajectory`` by
``gym.make(env_id, **env_kwargs)``, the workbench by its own ``make``. What decides how an episode goes is the robot,
the modes and the task's own arguments; how many envs stand beside each other, on which device, and what draws them, is
up to who makes it again.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mani_skill.envs.sapien_env import BaseEnv  # the server reads what is below, and loads no torch

HOW_IT_IS_RUN = frozenset({"num_envs", "sim_backend", "render_backend", "render_device", "render_mode"})
"""Keywords that say how an env is run, and not what it is."""


def env_kwargs(env: BaseEnv, given: Mapping[str, Any]) -> dict[str, Any]:
    """What `env` was made with (`given`) and the modes that it took; what JSON cannot say is left out."""
    modes: dict[str, Any] = {"obs_mode": env.obs_mode, "reward_mode": env.reward_mode}
    if env.agent is not None and isinstance(env.control_mode, str):
        modes["control_mode"] = env.control_mode
    said = {**given, **modes}
    return {name: said[name] for name in said if name not in HOW_IT_IS_RUN and _is_json(said[name])}


def _is_json(value: Any) -> bool:
    try:
        return json.loads(json.dumps(value)) == value or isinstance(value, tuple)
    except (TypeError, ValueError):
        return False
