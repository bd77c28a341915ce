"""A trajectory as ManiSkill writes it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np


def write(folder: Path, spoil: Callable[[h5py.Group], None] = lambda group: None) -> Path:
    """Write a trajectory of three steps in ManiSkill's format, damaged by `spoil`; returns the ``.h5``."""
    path = folder / "theirs.h5"
    with h5py.File(path, "w") as file:
        group = file.create_group("traj_0")
        group["actions"] = np.zeros((3, 2), np.float32)
        group["rewards"] = np.ones(3, np.float32)
        group["terminated"] = group["truncated"] = np.zeros(3, bool)
        group["env_states/actors/cube"] = np.zeros((4, 13), np.float32)
        spoil(group)
    document = {"env_info": {"env_id": "PickCube-v1"}, "episodes": [{"episode_id": 0, "elapsed_steps": 3}]}
    path.with_suffix(".json").write_text(json.dumps(document))
    return path
