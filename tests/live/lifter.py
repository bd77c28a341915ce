"""A policy that solves PickCube-v1 with ``obs_mode="state"`` and ``control_mode="pd_ee_delta_pos"`` (1 is 0.1 m)."""

from __future__ import annotations

import torch


def act(obs: torch.Tensor) -> torch.Tensor:
    held, tcp, goal, cube = obs[:, 18] > 0.5, obs[:, 19:22], obs[:, 26:29], obs[:, 29:32]
    beside = (tcp[:, :2] - cube[:, :2]).norm(dim=1)
    target = cube.clone()
    target[:, 2] += torch.where(beside > 0.015, 0.1, 0.0)
    close = (tcp - cube).norm(dim=1) < 0.02
    target = torch.where(held[:, None], goal + (tcp - cube), target)
    move = ((target - tcp) / 0.1).clamp(-0.8, 0.8)
    grip = torch.where(held | close, -1.0, 1.0)
    return torch.cat([move, grip[:, None]], dim=1)
