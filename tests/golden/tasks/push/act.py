"""The policies of the golden recordings."""

from __future__ import annotations

import time
from pathlib import Path

import torch

steps = 0


def act(obs: torch.Tensor) -> torch.Tensor:
    """Forward, a little to one side."""
    return torch.tensor([0.8, 0.1]).repeat(len(obs), 1)


def act_and_wait(obs: torch.Tensor) -> torch.Tensor:
    """The same, and no seventh step: whoever waits for that finds the file ``waiting``."""
    global steps
    steps += 1
    if steps == 7:
        Path("waiting").touch()
        time.sleep(3600)
    return act(obs)
