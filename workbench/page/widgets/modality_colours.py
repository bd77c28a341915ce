"""Camera data as RGB pictures with captions, and as ``data:`` addresses for HTML."""

from __future__ import annotations

import base64
import colorsys
import io
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from workbench.envs.camera_data import Picture
from workbench.page.widgets.templates import render

VIRIDIS = np.array(
    [
        (253, 231, 37), (181, 222, 43), (110, 206, 88), (53, 183, 121), (31, 158, 137),
        (38, 130, 142), (49, 104, 142), (62, 74, 137), (72, 40, 120), (68, 1, 84),
    ],
    np.float32,
)  # fmt: skip
"""Ten colours of matplotlib's viridis (CC0), reversed: bright is near, as in most depth viewers."""
NOTHING = np.array((24, 24, 27), np.uint8)
"""RGB of a pixel without a value, and of the background."""
MAX_LEGEND_ENTRIES = 10


@dataclass(frozen=True)
class DepthRange:
    """Depth in metres at the two ends of the colour scale."""

    near: float
    far: float

    def widened(self, other: DepthRange) -> DepthRange:
        return DepthRange(min(self.near, other.near), max(self.far, other.far))


def depth_range(depth: NDArray[np.float32]) -> DepthRange | None:
    """The range of most finite positive depths; None if there are none.

    It goes from the 1st to the 98th percentile, but at most to three times the median: in a range up to a
    floor's horizon, the whole table in front would have one colour.
    """
    met = depth[np.isfinite(depth) & (depth > 0)]
    if not met.size:
        return None
    near, median, far = np.percentile(met, (1, 50, 98))
    return DepthRange(float(near), float(max(min(far, 3 * median), near * 1.001 + 1e-3)))


def colour_depth(depth: NDArray[np.float32], span: DepthRange) -> NDArray[np.uint8]:
    """(H, W) metres as (H, W, 3) RGB, clamped to the span."""
    met = np.isfinite(depth) & (depth > 0)
    metres = np.where(met, depth, span.near).astype(np.float64)
    place = np.clip((metres - span.near) / (span.far - span.near), 0, 1)
    place = place * (len(VIRIDIS) - 1)
    below = np.minimum(place.astype(np.int64), len(VIRIDIS) - 2)
    part = (place - below)[..., None]
    colours = VIRIDIS[below] * (1 - part) + VIRIDIS[below + 1] * part
    return np.where(met[..., None], colours.round().astype(np.uint8), NOTHING)


def colour_position(position: NDArray[np.float32]) -> NDArray[np.uint8]:
    """(H, W, 3) metres in the camera's frame as RGB: x, y and z, each from its 1st to its 98th percentile."""
    met = np.isfinite(position).all(axis=-1) & (position[..., 2] < 0)
    if not met.any():
        return np.broadcast_to(NOTHING, position.shape).copy()
    low, high = np.percentile(position[met], (1, 98), axis=0)
    place = np.clip((np.nan_to_num(position) - low) / np.maximum(high - low, 1e-3), 0, 1)
    return np.where(met[..., None], (255 * place).round().astype(np.uint8), NOTHING)


def colour_normal(normal: NDArray[np.float32]) -> NDArray[np.uint8]:
    """(H, W, 3) unit vectors as RGB, like normal maps: -1 is 0 and 1 is 255."""
    met = np.isfinite(normal).all(axis=-1) & (np.abs(normal).max(axis=-1) > 0)
    colours = np.clip((np.nan_to_num(normal) + 1) * 127.5, 0, 255).round().astype(np.uint8)
    return np.where(met[..., None], colours, NOTHING)


def segment_colour(identity: int) -> tuple[int, int, int]:
    """RGB of a segmentation id, the same in every picture; 0, the background, is dark.

    Hues advance by the golden ratio and lightness alternates, so that neighbouring ids differ clearly.
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
    """The legend of a picture: (CSS colour, name), largest first, and the number of segments left out."""
    identities, counts = np.unique(segmentation, return_counts=True)
    order = np.argsort(-counts, kind="stable")
    seen = [int(identities[i]) for i in order]
    legend = [
        ("rgb({},{},{})".format(*segment_colour(i)), "background" if i == 0 else names.get(i, f"id {i}"))
        for i in seen[:MAX_LEGEND_ENTRIES]
    ]
    return legend, max(0, len(seen) - MAX_LEGEND_ENTRIES)


def data_address(pixels: NDArray[np.uint8], longest: int) -> str:
    """``data:image/jpeg;base64,...`` of a picture.

    Args:
        pixels: (H, W, 3) RGB.
        longest: Maximum pixels of the longer side; a larger picture is downsampled by averaging. A picture
            with a side of 128 takes 3 to 6 kB.
    """
    image = Image.fromarray(np.ascontiguousarray(pixels))
    if max(image.size) > longest:
        scale = longest / max(image.size)
        size = (max(1, round(image.width * scale)), max(1, round(image.height * scale)))
        image = image.resize(size, Image.Resampling.BOX)
    written = io.BytesIO()
    image.save(written, "JPEG", quality=78)
    return address_of_jpeg(written.getvalue())


def address_of_jpeg(jpeg: bytes) -> str:
    return "data:image/jpeg;base64," + base64.b64encode(jpeg).decode("ascii")


COLOUR = "rgb"
MODALITIES = (COLOUR, "depth", "segmentation", "position", "normal", "albedo")
_POSITION = "red, green, blue: right, up, towards the camera; each over its own range in this picture"
_NORMAL = "red, green, blue: right, up, towards the camera"


def depth_span(before: DepthRange | None, picture: Picture) -> DepthRange | None:
    """The depth range of the colour scale: `before`, widened to contain this picture. The range never
    narrows, so that a body at rest keeps its colour."""
    span = None if picture.depth is None else depth_range(picture.depth)
    return before if span is None else span if before is None else before.widened(span)


def in_colours(
    picture: Picture, modality: str, names: dict[int, str], span: DepthRange | None
) -> tuple[NDArray[np.uint8], str] | None:
    """Pixels (H, W, 3) and a caption in HTML; None if the picture lacks this modality.

    Args:
        names: names of the ids in a segmentation.
        span: depth range, see `depth_span`.
    """
    if modality == COLOUR and picture.rgb is not None:
        return picture.rgb, ""
    if modality == "depth" and picture.depth is not None:
        shown = span or DepthRange(0.0, 1.0)
        caption = render("depth_caption", near=f"{shown.near:.2f}", far=f"{shown.far:.2f}")
        return colour_depth(picture.depth, shown), caption
    if modality == "segmentation" and picture.segmentation is not None:
        legend, more = segments_seen(picture.segmentation, names)
        caption = render("segmentation_caption", legend=legend, more=more)
        return colour_segmentation(picture.segmentation), caption
    if modality == "position" and picture.position is not None:
        return colour_position(picture.position), render("note", text=_POSITION)
    if modality == "normal" and picture.normal is not None:
        return colour_normal(picture.normal), render("note", text=_NORMAL)
    if modality == "albedo" and picture.albedo is not None:
        return picture.albedo, ""
    return None


def narrowed(pixels: NDArray[np.uint8], width: int, smooth: bool) -> NDArray[np.uint8]:
    """A picture, scaled down if it is wider than `width` pixels.

    Args:
        smooth: Average colours; if False, use only colours of the picture.
    """
    high, wide = pixels.shape[:2]
    if wide <= width:
        return pixels
    how = Image.Resampling.BOX if smooth else Image.Resampling.NEAREST
    return np.asarray(Image.fromarray(pixels).resize((width, max(1, round(high * width / wide))), how))


def image_format(modality: str) -> Literal["png", "jpeg"]:
    """PNG for a segmentation, whose flat colours would get halos from JPEG."""
    return "png" if modality == "segmentation" else "jpeg"
