"""The 3-D view of an episode as frames, drawn without a browser from the recorded meshes and poses.

SAPIEN draws them (`workbench.core.recorded_scene`), on a graphics card or in software, so this belongs into a process
of its own: the one that serves the page imports no renderer.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from workbench.recording.episode import Episode
from workbench.recording.scene_eye import Eye, usual_eye

SIZE = (960, 720)
"""Width and height in pixels."""


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
