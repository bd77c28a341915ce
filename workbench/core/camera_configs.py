"""What a ManiSkill camera's config says, as plain numbers; and where in the author's code it was made.

A config is an object that the author's hook makes anew whenever the scene is built, and nothing in it says which
line made it. But that line is what must be edited when a camera is to stand elsewhere, and a name is not enough
to find it: names are computed, and two classes may use the same. So in a worker every config is marked when it is
made (`note_camera_sites`); elsewhere ManiSkill's class is left alone.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from workbench.core import seams
from workbench.core.camera_settings import CameraSettings


def note_camera_sites() -> None:
    """From now on every camera config of this process knows where it was made (`seams.camera_site`), and what its
    pose was made to look at (`target_of`)."""
    seams.mark_camera_configs()


def settings_of(config: Any) -> CameraSettings | None:
    """A ``CameraConfig`` as plain numbers; of the first env where poses differ.

    A quaternion that is not of unit length (``look_at`` straight down gives one) is made so. None where it cannot
    be said: a lens, near or far that differs between envs, or a pose that is none.
    """
    pose = rows_of_pose(config)[0].astype(np.float64)
    length = float(np.linalg.norm(pose[3:]))
    if not np.isfinite(pose).all() or length < 1e-6:
        return None
    fov, near, far = (_one(getattr(config, name)) for name in ("fov", "near", "far"))
    intrinsic = None if config.intrinsic is None else _one_matrix(config.intrinsic)
    if near is None or far is None or (fov is None) == (intrinsic is None):
        return None
    x, y, z = (float(v) for v in pose[:3])
    w, i, j, k = (float(v) for v in pose[3:] / length)
    return CameraSettings(
        position=(x, y, z),
        quaternion=(w, i, j, k),
        fov=fov,
        intrinsic=intrinsic,  # type: ignore[arg-type]
        width=int(config.width),
        height=int(config.height),
        near=near,
        far=far,
        shader_pack=str(config.shader_pack),
    )


def target_of(config: Any) -> tuple[float, float, float] | None:
    """The point that the config's ``look_at`` names, in the frame of its pose, of the first env where it differs.

    None where the pose was not made by ``look_at``, or not noted.
    """
    target = seams.camera_target(config)
    if target is None:
        return None
    x, y, z = (float(number) for number in _numbers(target).reshape(-1, 3)[0])
    return x, y, z


def rows_of_pose(config: Any) -> np.ndarray:
    """(1, 7) or (N, 7) local poses, p then wxyz."""
    return config.pose.raw_pose.detach().cpu().numpy()


def _numbers(value: Any) -> np.ndarray:
    return np.asarray(value.detach().cpu() if isinstance(value, torch.Tensor) else value, dtype=np.float64)


def _one(value: Any) -> float | None:
    """The number that it is, or that all of its numbers are."""
    if value is None:
        return None
    numbers = _numbers(value).reshape(-1)
    return float(numbers[0]) if len(numbers) and (numbers == numbers[0]).all() else None


def _one_matrix(value: Any) -> tuple[tuple[float, ...], ...] | None:
    matrices = _numbers(value)
    if matrices.shape[-2:] != (3, 3):
        return None
    matrices = matrices.reshape(-1, 3, 3)
    if not (matrices == matrices[0]).all():
        return None
    return tuple(tuple(float(v) for v in row) for row in matrices[0])
