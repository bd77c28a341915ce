"""Determines which motions a page can see: poses that moved by less than a pixel are not sent again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import viser
from numpy.typing import NDArray

AT_REST = 0.15
"""Seconds without a change after which the exact pose is sent."""
NEAREST = 0.05
"""Minimum distance in metres from an eye, as the near plane: nearer bodies are not drawn."""
COARSEST = 2.0**-6
"""Maximum rounding step of a quaternion's components."""


@dataclass(frozen=True)
class Eye:
    """Eye point of a page in the scene."""

    position: NDArray[np.float64]
    """(3,) position in metres."""
    pixel: float
    """Size in metres that a pixel covers, for each metre of distance."""


def eyes_of(server: viser.ViserServer) -> tuple[Eye, ...]:
    """Eye points of the open pages."""
    cameras = [client.camera for client in server.get_clients().values()]
    # A page whose view is folded away has no height.
    return tuple(
        Eye(camera.position, 2 * float(np.tan(camera.fov / 2)) / max(camera.image_height, 1))
        for camera in cameras
    )


def pixel_sizes(
    eyes: tuple[Eye, ...], positions: NDArray[np.float32], reach: NDArray[np.float32]
) -> NDArray[np.float32]:
    """(R,) metres of a pixel at the nearest point of each body, for the page that sees most of it; 0 without an eye.

    Args:
        eyes: Of the pages.
        positions: (R, 3) of the bodies' frames.
        reach: (R,) of the bodies around their frames, metres.
    """
    sizes = np.full(len(positions), np.inf if eyes else 0.0, np.float32)
    for eye in eyes:
        away = np.linalg.norm(positions - eye.position, axis=1) - reach
        np.minimum(sizes, eye.pixel * np.maximum(away, NEAREST), out=sizes)
    return sizes


def displacements(
    poses: NDArray[np.float32], others: NDArray[np.float32], reach: NDArray[np.float32]
) -> NDArray[np.float32]:
    """(R,) largest distance in metres between a point of each body in two poses (R, 7); NaN for an absent body."""
    turned = np.minimum(
        np.linalg.norm(poses[:, 3:] - others[:, 3:], axis=1),
        np.linalg.norm(poses[:, 3:] + others[:, 3:], axis=1),
    )
    return np.linalg.norm(poses[:, :3] - others[:, :3], axis=1) + 2 * reach * turned


class SentPoses:
    """The poses of some bodies as the pages have them.

    A pose stays as it was sent until it is a pixel off; it is then sent rounded to a part of a pixel. Both make messages
    repeat what came before, which compression finds (`server.line`): viser sends a whole batch when one of it moves. What
    stands still is sent exactly.

    Args:
        reach: (R,) metres of each body around its frame.
    """

    def __init__(self, reach: NDArray[np.float32]) -> None:
        self._reach = reach
        self._sent: NDArray[np.float32] | None = None
        self._last = self._sent
        self._since = np.zeros(len(reach))

    def update(
        self, poses: NDArray[np.float32], eyes: tuple[Eye, ...], now: float
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """The poses to send, and which of them differ from those sent last.

        Args:
            poses: (R, 7) of now, in the world; rows of absent bodies are NaN.
            eyes: Of the open pages.
            now: Seconds, monotonic.

        Returns:
            (R, 7), not to be changed, and (R,).
        """
        if self._sent is None or self._last is None:
            self._sent, self._last = poses.copy(), poses
            self._since[:] = now - AT_REST
            return self._sent, np.ones(len(poses), bool)
        self._since[(poses != self._last).any(axis=1)] = now
        self._last = poses
        pixels = pixel_sizes(eyes, poses[:, :3], self._reach)
        rests = now - self._since >= AT_REST
        # Not `>`, which is false for a body that comes or goes.
        changed = ~(displacements(poses, self._sent, self._reach) <= np.where(rests, 0.0, pixels))
        moves = changed & ~rests
        self._sent[changed & rests] = poses[changed & rests]
        self._sent[moves] = rounded(poses[moves], pixels[moves], self._reach[moves])
        return self._sent, changed


def rounded(
    poses: NDArray[np.float32], pixels: NDArray[np.float32], reach: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Poses (R, 7) in steps of a part of a pixel (R,) each; as they are where a pixel is 0."""
    steps = np.empty((len(poses), 7), np.float32)
    steps[:, :3] = pixels[:, None] / 2
    steps[:, 3:] = np.minimum(pixels / (4 * np.maximum(reach, NEAREST)), COARSEST)[:, None]
    with np.errstate(divide="ignore"):
        # Powers of two: floats of few digits.
        steps = np.exp2(np.floor(np.log2(steps)))
    return np.where(steps > 0, np.round(poses / np.where(steps > 0, steps, 1)) * steps, poses)
