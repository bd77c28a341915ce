"""Fixtures: episodes to write and read, a real one and small synthetic ones."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from tests.drive.episodes import Made
from workbench.envs.scene.shapes import Material, Mesh, SceneGeometry, Visual
from workbench.episodes.episode import EpisodeInfo

if TYPE_CHECKING:
    from tests.episodes.stock import Recorded


@pytest.fixture(scope="session")
def recorded(renderer: None) -> Recorded:
    # Imported here: ManiSkill takes seconds to import, and most of these tests do not need it.
    from tests.episodes.stock import record_stock

    return record_stock("PickCube-v1", robot_uids="panda_wristcam")


@pytest.fixture(scope="session")
def make_episode() -> Callable[..., Made]:
    """A small synthetic episode for cases that no simulation produces; fields can be replaced."""
    return _make_episode


def _make_episode(steps: int = 3, **fields: Any) -> Made:
    poses = np.zeros((steps + 1, 2, 7), dtype=np.float32)
    poses[..., 3] = 1
    poses[:, 1, 0] = np.arange(steps + 1)
    box = Mesh(
        np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype=np.float32), np.array([[0, 1, 2]], dtype=np.uint32)
    )
    both = np.array([0, 1], dtype=np.int32)
    values: dict[str, Any] = {
        "info": EpisodeInfo(
            task="Made-v1",
            env_index=0,
            seed=7,
            source_file=None,
            source_hash="",
            source={},
            control_dt=0.05,
            control_mode=None,
            backend="cpu",
            acted_by=((0, "random"),),
        ),
        "geometry": SceneGeometry(
            num_envs=1,
            body_names=("floor", "robot/hand"),
            body_kinds=("static", "link"),
            body_hidden=(False, False),
            visuals=(Visual("box", box, Material((1.0, 0.5, 0.0, 1.0)), np.zeros(2, dtype=np.int32), both),),
        ),
        "segmentation": {},
        "poses": poses,
        "action": np.zeros((steps, 1), dtype=np.float32),
        "action_names": ("grip",),
        "reward": np.zeros(steps, dtype=np.float32),
        "terminated": np.zeros(steps, dtype=np.bool_),
        "truncated": np.zeros(steps, dtype=np.bool_),
        "evaluate": {},
        "cameras": [],
    }
    return Made(**{**values, **fields})
