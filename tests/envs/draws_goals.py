"""A helper beside a task, which makes the commonest mistake in its place; for ``test_kept_rows``."""

from __future__ import annotations

from typing import Any

import torch


def draw(env: Any) -> None:
    env.target = torch.rand((env.num_envs, 2))  # the fault
