"""Skips motion that no page can see: poses that moved by less than a pixel are not sent again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import viser
from numpy.typing import NDArray

AT_REST_SECONDS = 0.15
"""Time without a change after which the exact pose is sent."""
NEAR_METRES = 0.05
"""Minimum distance from an eye, equal to the near plane: nearer bodies are not drawn."""
MAX_QUATERNION_STEP = 2.0**-6
"""Maximum rounding step of a quaternion's components."""


@dataclass(frozen=True)
class Eye:
    """Eye point of a page in the scene."""

    position: NDArray[np.float64]
    """(3,) position in metres."""
    pixel: float
    """Size in metres of a pixel at one metre of distance."""


def eyes_of(server: viser.ViserServer) -> tuple[Eye, ...]:
    """Eye points of the open pages."""
    cameras = [client.camera for client in server.get_clients().values()]
    # A page that has folded its view has height 0.
    return tuple(
        Eye(camera.position, 2 * float(np.tan(camera.fov / 2)) / max(camera.image_height, 1))
        for camera in cameras
    )


def pixel_sizes(
    eyes: tuple[Eye, ...], positions: NDArray[np.float32], reach: NDArray[np.float32]
) -> NDArray[np.float32]:
    """(R,) size of a pixel in metres at the nearest point of each body, for the page in which the body is
    largest; 0 if there are no eyes.

    Args:
        eyes: Eye points of the pages.
        positions: (R, 3) positions of the bodies' frames.
        reach: (R,) radii of the bodies around their frames, metres.
    """
    sizes = np.full(len(positions), np.inf if eyes else 0.0, np.float32)
    for eye in eyes:
        away = np.linalg.norm(positions - eye.position, axis=1) - reach
        np.minimum(sizes, eye.pixel * np.maximum(away, NEAR_METRES), out=sizes)
    return sizes


def displacements(
    poses: NDArray[np.float32], others: NDArray[np.float32], reach: NDArray[np.float32]
) -> NDArray[np.float32]:
    """(R,) largest displacement in metres of a point of each body between two poses (R, 7); NaN for an absent body."""
    turned = np.minimum(
        np.linalg.norm(poses[:, 3:] - others[:, 3:], axis=1),
        np.linalg.norm(poses[:, 3:] + others[:, 3:], axis=1),
    )
    return np.linalg.norm(poses[:, :3] - others[:, :3], axis=1) + 2 * reach * turned


class SentPoses:
    """The poses of bodies that were last sent to the pages.

    A pose is sent again, rounded to a fraction of a pixel, only when the last sent pose is more than a pixel
    off. viser sends a whole batch when one pose of it changes; as most values then equal previous ones,
    compression makes the message small (`door.send_pacing`). A body at rest gets its exact pose.

    Args:
        reach: (R,) radius of each body around its frame, metres.
    """

    def __init__(self, reach: NDArray[np.float32]) -> None:
        self._reach = reach
        self._sent: NDArray[np.float32] | None = None
        self._last = self._sent
        self._since = np.zeros(len(reach))

    def update(
        self, poses: NDArray[np.float32], eyes: tuple[Eye, ...], now: float
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """The poses to send, and which of them differ from the last sent ones.

        Args:
            poses: (R, 7) present world poses; rows of absent bodies are NaN.
            eyes: Eye points of the open pages.
            now: Monotonic time in seconds.

        Returns:
            (R, 7) poses, which must not be changed, and (R,) mask.
        """
        if self._sent is None or self._last is None:
            self._sent, self._last = poses.copy(), poses
            self._since[:] = now - AT_REST_SECONDS
            return self._sent, np.ones(len(poses), bool)
        self._since[(poses != self._last).any(axis=1)] = now
        self._last = poses
        pixels = pixel_sizes(eyes, poses[:, :3], self._reach)
        rests = now - self._since >= AT_REST_SECONDS
        # Not `>`, which is false for a body that appears or disappears (NaN).
        changed = ~(displacements(poses, self._sent, self._reach) <= np.where(rests, 0.0, pixels))
        moves = changed & ~rests
        self._sent[changed & rests] = poses[changed & rests]
        self._sent[moves] = rounded(poses[moves], pixels[moves], self._reach[moves])
        return self._sent, changed


def rounded(
    poses: NDArray[np.float32], pixels: NDArray[np.float32], reach: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Poses (R, 7) rounded to steps of a fraction of a pixel.

    Args:
        pixels: (R,) sizes of a pixel in metres; where it is 0, the pose is unchanged.
        reach: (R,) radii of the bodies around their frames, metres.
    """
    steps = np.empty((len(poses), 7), np.float32)
    steps[:, :3] = pixels[:, None] / 2
    steps[:, 3:] = np.minimum(pixels / (4 * np.maximum(reach, NEAR_METRES)), MAX_QUATERNION_STEP)[:, None]
    with np.errstate(divide="ignore"):
        # Powers of two give floats with few digits.
        steps = np.exp2(np.floor(np.log2(steps)))
    return np.where(steps > 0, np.round(poses / np.where(steps > 0, steps, 1)) * steps, poses)
