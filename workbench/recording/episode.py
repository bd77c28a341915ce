"""One episode of one env, as columns, before it becomes a file.

Rerun takes columns forty times faster than calls a step (measured), and ManiSkill's own format is
columns too; so an episode is gathered as columns once and every file is written from them.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from workbench.core.geometry import SceneGeometry
from workbench.core.pictures import CameraInfo


@dataclass(frozen=True)
class EpisodeInfo:
    """What is needed to know an episode again, and to make it again."""

    task: str
    env_index: int
    seed: int
    """Episode seed; below 0 where it is not known."""
    source_file: str | None
    source_hash: str
    source: dict[str, str]
    """Path to text of the task's own files."""
    control_dt: float
    """Seconds of simulated time per step."""
    control_mode: str | None
    backend: str
    versions: dict[str, str] = field(default_factory=dict)
    """Package name to version."""


@dataclass
class CameraTrack:
    """What one camera saw over the episode; P pictures, normally one a state (P = T + 1)."""

    info: CameraInfo
    frame: NDArray[np.int64]
    """(P,) state index 0..T of each picture."""
    pose: NDArray[np.float32]
    """(P, 7) camera pose in the env's frame, ManiSkill convention (x forward, y left, z up), wxyz."""
    rgb: NDArray[np.uint8] | None
    """(P, H, W, 3)"""
    depth: NDArray[np.float32] | None
    """(P, H, W) metres, 0 = nothing."""
    segmentation: NDArray[np.int32] | None
    """(P, H, W)"""


@dataclass
class Episode:
    """T actions and T + 1 states of one env. State 0 is the reset; action t leads to state t + 1."""

    info: EpisodeInfo
    geometry: SceneGeometry
    segmentation: dict[int, str]
    poses: NDArray[np.float32]
    """(T + 1, B, 7) position and wxyz of every body; NaN rows for bodies this env lacks."""
    action: NDArray[np.float32]
    """(T, A)"""
    action_names: tuple[str, ...]
    reward: NDArray[np.float32]
    """(T,)"""
    terminated: NDArray[np.bool_]
    """(T,)"""
    truncated: NDArray[np.bool_]
    """(T,)"""
    evaluate: dict[str, NDArray]
    """(T + 1, ...) every entry of ``evaluate()``; ``success`` and ``fail`` are among them if the
    task has them."""
    cameras: list[CameraTrack]
