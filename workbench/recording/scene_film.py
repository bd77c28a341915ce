"""The 3-D view of an episode as frames, drawn without a browser from the recorded meshes and poses.

SAPIEN draws them (`workbench.core.recorded_scene`), on a graphics card or in software, so this belongs into a process
of its own: the one that serves the page imports no renderer.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from transforms3d.quaternions import mat2quat, quat2mat

from workbench.core.camera_frames import triple
from workbench.recording.episode import Episode, box_of_moving

SIZE = (960, 720)
"""Width and height in pixels."""
FOVY = 0.75
"""Radians, vertical; the page's own."""
FROM_THE_FRONT = np.array([1.0, 0.55, 0.75])
"""ManiSkill's robots look along +x, so their front is seen from there."""


@dataclass(frozen=True)
class Eye:
    """A camera that does not move."""

    position: tuple[float, float, float]
    look_at: tuple[float, float, float]
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    fovy: float = FOVY

    @property
    def pose(self) -> NDArray[np.float32]:
        """(7,) position and wxyz in ManiSkill's camera frame: x forward, y left, z up."""
        forward = np.subtract(self.look_at, self.position).astype(np.float64)
        forward /= max(float(np.linalg.norm(forward)), 1e-9)
        left = np.cross(self.up, forward)
        if np.linalg.norm(left) < 1e-6:  # straight up or down
            left = np.cross([1.0, 0.0, 0.0] if abs(forward[0]) < 0.9 else [0.0, 1.0, 0.0], forward)
        left /= np.linalg.norm(left)
        axes = np.stack([forward, left, np.cross(forward, left)], axis=1)
        return np.concatenate([self.position, mat2quat(axes)]).astype(np.float32)


def usual_eye(episode: Episode) -> Eye:
    """The recorded human-render camera's where there is one, else one that has all that moves in view."""
    for camera in episode.cameras:
        if camera.info.kind == "human" and len(camera.pose):
            position, forward = camera.pose[0, :3], quat2mat(camera.pose[0, 3:])[:, 0]
            look_at = position + forward
            return Eye(triple(position), triple(look_at), fovy=float(camera.info.fovy))
    assert episode.poses is not None and episode.geometry is not None
    low, high = box_of_moving(episode.poses, episode.geometry.body_kinds)
    middle = (low + high) / 2
    # Origins of bodies, not their outlines: half as far again holds a hand or a cube around its origin.
    radius = max(float(np.linalg.norm(high - low)) / 2, 0.25) * 1.1
    direction = FROM_THE_FRONT / np.linalg.norm(FROM_THE_FRONT)
    return Eye(triple(middle + direction * radius / np.sin(FOVY / 2)), triple(middle))


def scene_frames(episode: Episode, eye: Eye | None = None) -> Iterator[NDArray[np.uint8]]:
    """One picture (H, W, 3) a state.

    Raises:
        ValueError: the recording holds no scene.
        RuntimeError: this machine has nothing to render with.
    """
    from workbench.core.recorded_scene import RecordedScene

    if episode.geometry is None or episode.poses is None:
        raise ValueError(f"The recording of {episode.info.task} holds no 3-D scene to film.")
    eye = eye or usual_eye(episode)
    # A recording that was read holds its env alone, as env 0 of 1; one in memory may still hold the batch.
    env = 0 if episode.geometry.num_envs == 1 else episode.info.env_index
    scene = RecordedScene(episode.geometry, env, *SIZE, eye.fovy)
    for poses in episode.poses:
        yield scene.picture(poses, eye.pose)
