"""What cameras there are, and what one of them saw: plain data that crosses the pipe.

The functions that ask SAPIEN are in `take_pictures`, so that whoever only shows pictures need not
import a simulator.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

CameraKind = Literal["sensor", "human"]


@dataclass(frozen=True)
class CameraInfo:
    """One camera of the task, the same in every env but for its pose.

    Poses are ManiSkill's camera frame: x forward, y left, z up, quaternion wxyz.
    """

    name: str
    kind: CameraKind
    width: int
    height: int
    fovy: float
    """Vertical field of view in radians."""
    near: float
    far: float
    intrinsic: NDArray[np.float32]
    """(3, 3) OpenCV intrinsic matrix in pixels (env 0's, where they differ)."""
    mount: str | None
    """Body name that the camera rides on, or None when it stands still."""
    modalities: tuple[str, ...]
    """What its shader gives, of ``rgb depth segmentation position normal albedo``. Only the first three
    can be asked for as a `Picture`."""


@dataclass(frozen=True)
class Picture:
    """What one camera of one env saw."""

    camera: str
    kind: CameraKind
    env: int
    pose: NDArray[np.float32]
    """(7,) world pose in the env's frame when the picture was taken: p, then q as wxyz."""
    rgb: NDArray[np.uint8] | None = None
    """(H, W, 3)"""
    depth: NDArray[np.float32] | None = None
    """(H, W) metres along the optical axis; 0 where the ray met nothing. ManiSkill's own observation is
    this in whole millimetres as int16, which ends at 32.767 m; here there is no such end."""
    segmentation: NDArray[np.int32] | None = None
    """(H, W) ids of actors and links; 0 is background. Names in `TaskDescription.segmentation`."""
