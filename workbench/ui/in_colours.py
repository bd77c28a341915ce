"""What a camera saw as a picture that a person can read, a line on what its colours mean, and pictures in our own HTML.

viser's own pictures cannot be pressed, and stand one below the other; a table with a picture in each row carries them
as ``data:`` addresses, 3 to 6 kB for 128 x 128.
"""

from __future__ import annotations

import base64
import io
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from workbench.core.pictures import Picture
from workbench.ui.false_colour import (
    DepthRange,
    colour_depth,
    colour_normal,
    colour_position,
    colour_segmentation,
    depth_range,
    segments_seen,
)
from workbench.ui.fragments import render


def data_address(pixels: NDArray[np.uint8], longest: int) -> str:
    """``data:image/jpeg;base64,...`` of a picture.

    Args:
        pixels: (H, W, 3) RGB.
        longest: Pixels that its longer side has at most; what is larger is averaged down.
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
    """The depths that the scale is to cover now: only ever widened, or each picture would recolour what stands still."""
    span = None if picture.depth is None else depth_range(picture.depth)
    return before if span is None else span if before is None else before.widened(span)


def in_colours(
    picture: Picture, modality: str, names: dict[int, str], span: DepthRange | None
) -> tuple[NDArray[np.uint8], str] | None:
    """Pixels (H, W, 3) and a caption, of HTML; None if the picture has no such thing.

    Args:
        names: of the ids in a segmentation.
        span: of depth, see `depth_span`.
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


def image_format(modality: str) -> Literal["png", "jpeg"]:
    """Flat colours of a segmentation would get halos from JPEG."""
    return "png" if modality == "segmentation" else "jpeg"
