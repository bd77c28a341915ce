"""What cameras there are, and what one of them saw: plain data that crosses the pipe.

The functions that ask SAPIEN are in `take_pictures`, so that whoever only shows pictures need not
import a simulator.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from workbench.core.camera_settings import CallSite, CameraKey, CameraKind, CameraSettings


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
    """What its shader gives, of ``rgb depth segmentation position normal albedo``."""
    settings: CameraSettings | None = None
    """What the task's own config says, wherever the camera was moved since; env 0's where they differ. None where
    the config cannot be said in these words (a lens that differs between envs)."""
    varies: bool = False
    """Its pose differs between envs, or is another than its config says: the task's code moves it."""
    site: CallSite | None = None
    """Where the config was made; None where that was not noted."""

    @property
    def key(self) -> CameraKey:
        """What tells it from all others."""
        return self.kind, self.name


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
    this in whole millimetres as int16, which ends at 32.767 m: what `step_pictures` takes from there is left so. Else
    there is no such end."""
    segmentation: NDArray[np.int32] | None = None
    """(H, W) ids of actors and links; 0 is background. Names in `TaskDescription.segmentation`."""
    position: NDArray[np.float32] | None = None
    """(H, W, 3) metres, in the camera's OpenGL frame (x right, y up, z backward), as ManiSkill observes it in whole
    millimetres; 0 where the ray met nothing. The minimal shader's own numbers end at 32.767 m."""
    normal: NDArray[np.float32] | None = None
    """(H, W, 3) of unit length, in the same frame; 0 where the ray met nothing."""
    albedo: NDArray[np.uint8] | None = None
    """(H, W, 3) colour without light."""

    @property
    def nbytes(self) -> int:
        """Roughly what it takes in memory."""
        planes = self.rgb, self.depth, self.segmentation, self.position, self.normal, self.albedo
        return 300 + sum(plane.nbytes for plane in planes if plane is not None)

    @property
    def key(self) -> CameraKey:
        """Of its camera."""
        return self.kind, self.camera
