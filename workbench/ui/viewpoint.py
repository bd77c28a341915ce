"""Where the page looks from when it first shows a scene.

The view must frame the whole grid (or the one env) on its own, whatever the size of the task, and
must then belong to the person: a reload of the file, a new seed or another env never moves it. Only
a scene of another size, or a choice that changes what is shown, frames it anew.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from workbench.core.pictures import Picture
from workbench.ui.env_layout import EnvLayout, rotate

FOV = 0.75
"""Vertical, radians. viser's own 75 degrees bends what stands at the edge of a grid."""
USUAL_ASPECT = 1.25
"""Of the view beside the panel in a 1280 x 720 window, before a page has said its own."""
FROM_THE_FRONT = np.array([1.0, 0.12, 1.1])
"""ManiSkill's robots look along +x, so their front is seen from there; a little from the side."""


@dataclass(frozen=True)
class Viewpoint:
    """A camera in the page: metres, z up, always upright."""

    position: NDArray[np.float64]
    look_at: NDArray[np.float64]


def frame_box(low: NDArray, high: NDArray, aspect: float = USUAL_ASPECT) -> Viewpoint:
    """The nearest upright view from the front and above that has the whole box in it.

    For a camera at ``target - d * forward`` a corner c stays inside the picture when
    ``|right . (c - target)| <= tan(fov_x / 2) * (d + forward . (c - target))``, and likewise for up;
    so d is the largest of the bounds that the corners give.
    """
    target = (np.asarray(low, np.float64) + high) / 2
    forward = -FROM_THE_FRONT / np.linalg.norm(FROM_THE_FRONT)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    picks = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), -1).reshape(-1, 3)
    corners = np.where(picks == 0, low, high) - target
    tall = np.tan(FOV / 2)
    wide = tall * float(np.clip(aspect, 0.3, 4.0))
    ahead = corners @ forward
    distance = max(
        float((np.abs(corners @ right) / wide - ahead).max()),
        float((np.abs(corners @ up) / tall - ahead).max()),
        0.3,
    )
    return Viewpoint(position=target - forward * distance * 1.04, look_at=target)


def frame_all(layout: EnvLayout, aspect: float = USUAL_ASPECT) -> Viewpoint:
    return frame_box(*layout.box_of_all(), aspect)


def frame_one(layout: EnvLayout, picture: Picture | None, aspect: float = USUAL_ASPECT) -> Viewpoint:
    """The view of one env at the origin: the task's own human camera where there is one."""
    if picture is None:
        return frame_box(layout.low, layout.high, aspect)
    position = picture.pose[:3].astype(np.float64)
    forward = rotate(picture.pose[3:].astype(np.float64), np.array([1.0, 0.0, 0.0]))
    centre = (layout.low + layout.high) / 2
    # The page turns about what it looks at, so that has to be at the depth of the env.
    depth = max(float((centre - position) @ forward), 0.2)
    return Viewpoint(position=position, look_at=position + forward * depth)
