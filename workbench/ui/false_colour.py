"""Depth, segmentation, positions and normals as pictures that a person can read, with what their colours mean."""

from __future__ import annotations

import colorsys
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

VIRIDIS = np.array(
    [
        (253, 231, 37), (181, 222, 43), (110, 206, 88), (53, 183, 121), (31, 158, 137),
        (38, 130, 142), (49, 104, 142), (62, 74, 137), (72, 40, 120), (68, 1, 84),
    ],
    np.float32,
)  # fmt: skip
"""Ten colours of matplotlib's viridis (CC0), near first: bright is near, as on most depth viewers."""
NOTHING = np.array((24, 24, 27), np.uint8)
LONGEST_LEGEND = 10


@dataclass(frozen=True)
class DepthRange:
    """Metres that the ends of the colour scale stand for."""

    near: float
    far: float

    def widened(self, other: DepthRange) -> DepthRange:
        return DepthRange(min(self.near, other.near), max(self.far, other.far))


def depth_range(depth: NDArray[np.float32]) -> DepthRange | None:
    """Where most of what was met lies, or None where nothing was met.

    From the 1st to the 98th percentile and no further than three times the median: a floor that runs
    to the horizon behind a table would otherwise leave the whole table one colour.
    """
    met = depth[np.isfinite(depth) & (depth > 0)]
    if not met.size:
        return None
    near, median, far = np.percentile(met, (1, 50, 98))
    return DepthRange(float(near), float(max(min(far, 3 * median), near * 1.001 + 1e-3)))


def colour_depth(depth: NDArray[np.float32], span: DepthRange) -> NDArray[np.uint8]:
    """(H, W) metres as (H, W, 3) RGB; what is out of the span takes the colour of its end."""
    met = np.isfinite(depth) & (depth > 0)
    metres = np.where(met, depth, span.near).astype(np.float64)
    place = np.clip((metres - span.near) / (span.far - span.near), 0, 1)
    place = place * (len(VIRIDIS) - 1)
    below = np.minimum(place.astype(np.int64), len(VIRIDIS) - 2)
    part = (place - below)[..., None]
    colours = VIRIDIS[below] * (1 - part) + VIRIDIS[below + 1] * part
    return np.where(met[..., None], colours.round().astype(np.uint8), NOTHING)


def colour_position(position: NDArray[np.float32]) -> NDArray[np.uint8]:
    """(H, W, 3) metres of the camera's frame as RGB: x, y and z from the 1st to the 98th percentile of each."""
    met = np.isfinite(position).all(axis=-1) & (position[..., 2] < 0)
    if not met.any():
        return np.broadcast_to(NOTHING, position.shape).copy()
    low, high = np.percentile(position[met], (1, 98), axis=0)
    place = np.clip((np.nan_to_num(position) - low) / np.maximum(high - low, 1e-3), 0, 1)
    return np.where(met[..., None], (255 * place).round().astype(np.uint8), NOTHING)


def colour_normal(normal: NDArray[np.float32]) -> NDArray[np.uint8]:
    """(H, W, 3) unit vectors as RGB, as normal maps are drawn: -1 is 0 and 1 is 255."""
    met = np.isfinite(normal).all(axis=-1) & (np.abs(normal).max(axis=-1) > 0)
    colours = np.clip((np.nan_to_num(normal) + 1) * 127.5, 0, 255).round().astype(np.uint8)
    return np.where(met[..., None], colours, NOTHING)


def segment_colour(identity: int) -> tuple[int, int, int]:
    """A colour of this segmentation id, the same in every picture; 0, the background, is dark.

    Hues go round by the golden ratio, so that ids that follow each other differ well; lightness
    alternates so that many ids stay apart.
    """
    if identity == 0:
        return int(NOTHING[0]), int(NOTHING[1]), int(NOTHING[2])
    hue = (identity * 0.6180339887) % 1.0
    value = (0.95, 0.78, 0.62)[identity % 3]
    saturation = (0.62, 0.75, 0.5)[(identity // 3) % 3]
    red, green, blue = colorsys.hsv_to_rgb(hue, saturation, value)
    return round(red * 255), round(green * 255), round(blue * 255)


def colour_segmentation(segmentation: NDArray[np.int32]) -> NDArray[np.uint8]:
    """(H, W) ids as (H, W, 3) RGB."""
    identities, places = np.unique(segmentation, return_inverse=True)
    palette = np.array([segment_colour(int(i)) for i in identities], np.uint8)
    return palette[places.reshape(segmentation.shape)]


def segments_seen(
    segmentation: NDArray[np.int32], names: dict[int, str]
) -> tuple[list[tuple[str, str]], int]:
    """The legend of a picture: (CSS colour, name) by size, and how many more there are."""
    identities, counts = np.unique(segmentation, return_counts=True)
    order = np.argsort(-counts, kind="stable")
    seen = [int(identities[i]) for i in order]
    legend = [
        ("rgb({},{},{})".format(*segment_colour(i)), "background" if i == 0 else names.get(i, f"id {i}"))
        for i in seen[:LONGEST_LEGEND]
    ]
    return legend, max(0, len(seen) - LONGEST_LEGEND)
