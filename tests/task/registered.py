"""The process-wide registries of ManiSkill and gymnasium, which decorators fill."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
from mani_skill.agents.registration import REGISTERED_AGENTS
from mani_skill.utils.assets.data import DATA_GROUPS
from mani_skill.utils.registration import REGISTERED_ENVS

TABLES: tuple[dict[str, Any], ...] = (REGISTERED_ENVS, gym.registry, REGISTERED_AGENTS, DATA_GROUPS)


def registered() -> list[dict[str, Any]]:
    """Copies of the registries' present content."""
    return [dict(table) for table in TABLES]
