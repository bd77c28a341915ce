"""A policy for screenshots: pushes push_cube's cube to its goal, in every fifth env past it.

For ``obs_mode="state"`` and ``control_mode="pd_ee_delta_pos"``, where one unit of an action is 0.1 m.
"""

from __future__ import annotations

import torch


def act(obs: torch.Tensor) -> torch.Tensor:
    tcp, goal, cube = obs[:, 18:21], obs[:, 25:28], obs[:, 28:31]
    careless = torch.arange(len(obs)) % 5 == 3
    behind = cube + torch.tensor([-0.09, 0.0, 0.0])
    behind[:, 1] += 0.03 * careless
    beside = (tcp[:, 1] - behind[:, 1]).abs() > 0.015
    away = (tcp[:, 0] > cube[:, 0] - 0.03) | beside
    low = tcp[:, 2] < 0.05
    target = torch.where((away & ~low)[:, None] | (beside & low)[:, None], behind, goal)
    arrived = (tcp[:, :2] - behind[:, :2]).norm(dim=1) < 0.04
    target[:, 2] = torch.where(arrived | low, 0.02, 0.15)
    target[:, :2] = torch.where((arrived & ~low)[:, None], behind[:, :2], target[:, :2])
    move = ((target - tcp) / 0.1).clamp(-0.6, 0.6)
    return torch.cat([move, -torch.ones(len(obs), 1)], dim=1)
