"""One state of one env with the step that led to it: what an episode is made of, one at a time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from workbench.core.pictures import Picture
from workbench.core.step import OtherEntry


@dataclass(frozen=True)
class EpisodeRow:
    poses: NDArray[np.float32]
    """(B, 7) position and wxyz of every body; NaN for bodies this env lacks."""
    evaluate: Mapping[str, NDArray] = field(default_factory=dict)
    """This env's value of the entries of ``evaluate()`` that have a row for each env: () or (...) each, booleans or real
    numbers."""
    env_states: Mapping[str, NDArray] = field(default_factory=dict)
    """``actors/cube``: (D,)"""
    obs: Mapping[str, NDArray] = field(default_factory=dict)
    """``agent/qpos``: (...); the key is ``""`` where the observation is one array."""
    action: NDArray[np.float32] | None = None
    """(A,) that led here; None in state 0 and only there."""
    reward: float = 0.0
    terminated: bool = False
    truncated: bool = False
    pictures: tuple[Picture, ...] = ()
    """Of this env alone; every state keeps the modalities that the first picture of a camera had. They are encoded while the episode
    goes on, so nobody may write to them any more."""
    others: Mapping[str, OtherEntry] = field(default_factory=dict)
    """Its other entries, each as `OtherEntry.of_env` gives it."""
