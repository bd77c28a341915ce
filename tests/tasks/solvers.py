"""Scripted policies that solve examples from flat state observations with ``pd_ee_delta_pos``, where one unit is 0.1 m.

Used by tests and for the gallery's pictures. Policies depend on the observation only, so they can start at any step.
"""

from __future__ import annotations

import torch

OPEN, SHUT = 1.0, -1.0
"""Actions of the gripper."""


def open_drawer(obs: torch.Tensor) -> torch.Tensor:
    """Solve articulated.py: lower the closed fingers behind the handle and pull."""
    tcp, handle = obs[:, 18:21], obs[:, 25:28]
    behind = handle + torch.tensor([0.021, 0.0, 0.0])
    not_above = (tcp[:, :2] - behind[:, :2]).norm(dim=1) > 0.012
    hooked = (tcp[:, 2] < handle[:, 2] + 0.01) & ((tcp[:, 1] - handle[:, 1]).abs() < 0.04)
    target = behind.clone()
    target[not_above, 2] = handle[not_above, 2] + 0.08
    target[hooked] = behind[hooked] - torch.tensor([0.03, 0.0, 0.01])
    return torch.cat([_towards(target - tcp), torch.full((len(obs), 1), SHUT)], dim=1)


def lift_cube(obs: torch.Tensor) -> torch.Tensor:
    """Solve reward_terms.py: grasp the cube and lift it."""
    return _lift(obs[:, 7:9], obs[:, 32:35], obs[:, 27])


def lift_bar(obs: torch.Tensor) -> torch.Tensor:
    """Solve two_robots.py: each robot grasps its end, and both lift once both have grasped."""
    height = obs[:, 52]
    fingers, to_grips = (obs[:, 7:9], obs[:, 25:27]), (obs[:, 57:60], obs[:, 60:63])
    taken = [_taken(both, offset) for both, offset in zip(fingers, to_grips, strict=True)]
    together = taken[0] & taken[1]
    left, right = (
        _lift(both, offset, height, together) for both, offset in zip(fingers, to_grips, strict=True)
    )
    # The second robot faces the opposite way.
    return torch.cat([left, right * torch.tensor([-1.0, -1.0, 1.0, 1.0])], dim=1)


def _lift(
    fingers: torch.Tensor, offset: torch.Tensor, height: torch.Tensor, may: torch.Tensor | None = None
) -> torch.Tensor:
    """Move above the object, lower, grasp, and lift where `may` is true.

    Args:
        fingers: (N, 2), distance of each finger from the middle, in metres.
        offset: (N, 3), from the tcp to the grasp point, in metres.
        height: (N,), of the lifted object, in metres.
    """
    above = offset.clone()
    above[:, 2] += 0.1
    not_above = offset[:, :2].norm(dim=1) > 0.01
    there = offset.norm(dim=1) < 0.015
    taken = _taken(fingers, offset)
    up = torch.zeros_like(offset)
    up[:, 2] = (0.16 - height).clamp(-0.02, 0.02)
    if may is not None:
        up[~may] = 0
    move = torch.where((not_above & ~taken)[:, None], above, offset)
    move = torch.where(taken[:, None], up, move)
    hand = torch.where(there | taken, SHUT, OPEN)
    return torch.cat([_towards(move), hand[:, None]], dim=1)


def _taken(fingers: torch.Tensor, offset: torch.Tensor) -> torch.Tensor:
    """Whether the closed fingers hold the object, which is 4 cm wide."""
    return (fingers.sum(dim=1) < 0.042) & (offset.norm(dim=1) < 0.03)


def _towards(offset: torch.Tensor) -> torch.Tensor:
    return (offset / 0.1).clamp(-0.4, 0.4)
