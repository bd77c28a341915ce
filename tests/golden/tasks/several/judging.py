"""When the box of the golden recording was pushed far enough."""

from __future__ import annotations

import torch

BEGIN, WANTED = 0.06, 0.02


def pushed(place: torch.Tensor) -> torch.Tensor:
    """Metres along x."""
    return place[:, 0] - BEGIN


def share(place: torch.Tensor) -> torch.Tensor:
    return (pushed(place) / WANTED).clamp(-1, 1)
