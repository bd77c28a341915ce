"""What one camera of an episode saw, as frames at the control rate, for films and sheets of pictures."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from workbench.recording.episode import CameraTrack, Episode

SMALLEST_SIDE = 256
"""Pixels. What a policy sees is often 128 wide, which no player shows well; whole pixels are repeated."""


def cameras_by_name(episode: Episode) -> dict[str, CameraTrack]:
    """The cameras that have colour pictures, by the names that people give them.

    Where a human-render camera is called like a sensor, ``_human`` follows its name.
    """
    seen = [camera for camera in episode.cameras if camera.rgb is not None and len(camera.rgb)]
    named: dict[str, CameraTrack] = {}
    for camera in sorted(seen, key=lambda camera: camera.info.kind != "sensor"):
        name = camera.info.name
        while name in named:
            name += f"_{camera.info.kind}"
        named[name] = camera
    return named


def camera_of(episode: Episode, name: str) -> CameraTrack:
    """The camera of that name.

    Raises:
        ValueError: there is none with pictures; the message says which there are.
    """
    cameras = cameras_by_name(episode)
    if name not in cameras:
        there = f"it has {', '.join(cameras)}" if cameras else "it was recorded without pictures"
        raise ValueError(f"The recording of {episode.info.task} has no camera {name!r}: {there}.")
    return cameras[name]


def picture_index(camera: CameraTrack, state: int) -> int:
    """The newest picture at `state`; the first where there is none yet."""
    return max(int(np.searchsorted(camera.frame, state, side="right")) - 1, 0)


def frames(episode: Episode, camera: CameraTrack) -> Iterator[NDArray[np.uint8]]:
    """One picture (H, W, 3) a state; a state of which there is none shows the one before."""
    assert camera.rgb is not None, "`cameras_by_name` gives only cameras that have colour"
    last, picture = -1, None
    for state in range(episode.length + 1):
        index = picture_index(camera, state)
        if picture is None or index != last:
            last, picture = index, camera.rgb[index]
        yield picture


def enlarged(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """`picture` with every pixel repeated until its smaller side has `SMALLEST_SIDE` pixels or more."""
    times = -(-SMALLEST_SIDE // min(picture.shape[:2]))
    return picture if times <= 1 else picture.repeat(times, axis=0).repeat(times, axis=1)
