"""Policies that solve examples, from their flat state and with ``control_mode="pd_ee_delta_pos"``: one unit is 0.1 m.

For tests and for the pictures of the gallery. Each looks at the observation alone, so it may begin at any moment.
"""

from __future__ import annotations

import torch

OPEN, SHUT = 1.0, -1.0
"""The fingers."""


def open_drawer(obs: torch.Tensor) -> torch.Tensor:
    """articulated.py: the shut fingers go down behind the handle, and pull it."""
    tcp, handle = obs[:, 18:21], obs[:, 25:28]
    behind = handle + torch.tensor([0.021, 0.0, 0.0])
    beside = (tcp[:, :2] - behind[:, :2]).norm(dim=1) > 0.012
    hooked = (tcp[:, 2] < handle[:, 2] + 0.01) & ((tcp[:, 1] - handle[:, 1]).abs() < 0.04)
    target = behind.clone()
    target[beside, 2] = handle[beside, 2] + 0.08
    target[hooked] = behind[hooked] - torch.tensor([0.03, 0.0, 0.01])
    return torch.cat([_towards(target - tcp), torch.full((len(obs), 1), SHUT)], dim=1)


def lift_cube(obs: torch.Tensor) -> torch.Tensor:
    """reward_terms.py."""
    return _lift(obs[:, 7:9], obs[:, 32:35], obs[:, 27])


def lift_bar(obs: torch.Tensor) -> torch.Tensor:
    """two_robots.py: each takes its end, and they lift when both have it."""
    height = obs[:, 52]
    fingers, to_grips = (obs[:, 7:9], obs[:, 25:27]), (obs[:, 57:60], obs[:, 60:63])
    taken = [_taken(both, way) for both, way in zip(fingers, to_grips, strict=True)]
    together = taken[0] & taken[1]
    left, right = (_lift(both, way, height, together) for both, way in zip(fingers, to_grips, strict=True))
    # The second one faces back.
    return torch.cat([left, right * torch.tensor([-1.0, -1.0, 1.0, 1.0])], dim=1)


def _lift(
    fingers: torch.Tensor, way: torch.Tensor, height: torch.Tensor, may: torch.Tensor | None = None
) -> torch.Tensor:
    """Go above it, down, take it, and up as soon as it `may`.

    Args:
        fingers: (N, 2), how far they are apart from the middle.
        way: (N, 3), from the tcp to where it is to be taken.
        height: (N,), of what is lifted.
    """
    above = way.clone()
    above[:, 2] += 0.1
    beside = way[:, :2].norm(dim=1) > 0.01
    there = way.norm(dim=1) < 0.015
    taken = _taken(fingers, way)
    up = torch.zeros_like(way)
    up[:, 2] = (0.16 - height).clamp(-0.02, 0.02)
    if may is not None:
        up[~may] = 0
    move = torch.where((beside & ~taken)[:, None], above, way)
    move = torch.where(taken[:, None], up, move)
    hand = torch.where(there | taken, SHUT, OPEN)
    return torch.cat([_towards(move), hand[:, None]], dim=1)


def _taken(fingers: torch.Tensor, way: torch.Tensor) -> torch.Tensor:
    """Whether shut fingers are around it: what they hold is 4 cm wide."""
    return (fingers.sum(dim=1) < 0.042) & (way.norm(dim=1) < 0.03)


def _towards(way: torch.Tensor) -> torch.Tensor:
    return (way / 0.1).clamp(-0.4, 0.4)
