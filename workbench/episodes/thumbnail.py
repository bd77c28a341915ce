"""Thumbnails of episodes: written into the description, and read from recordings of any program."""

from __future__ import annotations

import base64
import io
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from workbench.episodes.encoded_pictures import open_picture, small_jpeg
from workbench.episodes.episode import Episode

if TYPE_CHECKING:
    from workbench.episodes.maniskill.safe_h5 import H5Group

WRITTEN_PIXELS = 160
"""Longer side of a thumbnail in a description."""
LISTED_PIXELS = 96
"""Longer side of a thumbnail in the library."""
UNCHANGED_BYTES = 8192
"""Size up to which recorded thumbnails are used unchanged."""
MAX_BYTES = 64 << 10
"""Maximum size of a thumbnail that the page gets."""

_MAX_PICTURE_PIXELS = 4096
"""Thumbnails are made only from pictures whose longer side has at most this many pixels."""
_JPEG_START = b"\xff\xd8\xff"


def of_episode(episode: Episode) -> str | None:
    """The episode's last picture, from a human-render camera if there is one, scaled down: a JPEG in base64."""
    seen = [camera for camera in episode.cameras if camera.rgb is not None]
    if not seen:
        return None
    pictures = max(seen, key=lambda camera: (camera.info.kind == "human", camera.frame[-1])).rgb
    picture = None if pictures is None else pictures.blob(-1)
    if picture is None:
        return None
    with Image.open(io.BytesIO(picture)) as image:
        return base64.b64encode(small_jpeg(image, WRITTEN_PIXELS)).decode()


def from_description(encoded: object) -> bytes | None:
    """A small JPEG from the base64 in a description; None if it is not a picture."""
    if not isinstance(encoded, str):
        return None
    try:
        content = base64.b64decode(encoded.partition("base64,")[2] or encoded)
        with open_picture(content) as image:
            if image.format == "JPEG" and max(image.size) <= 2 * LISTED_PIXELS:
                if len(content) <= UNCHANGED_BYTES:
                    return content
            return small_jpeg(image, LISTED_PIXELS)
    except (ValueError, OSError):
        return None


def from_trajectory(group: H5Group) -> bytes | None:
    """A small JPEG of the last colour picture of the first camera in a ManiSkill trajectory; None if there is none."""
    # Imported late: the processes that write episodes do not need h5py.
    from workbench.episodes.maniskill.safe_h5 import H5Dataset

    cameras = group.group("obs/sensor_data")
    for name in cameras or ():
        camera = None if cameras is None else cameras.group(name)
        rgb = None if camera is None else camera.get("rgb")
        if isinstance(rgb, H5Dataset) and rgb.dtype == np.uint8 and rgb.ndim == 4 and len(rgb):
            if rgb.shape[3] == 3 and max(rgb.shape[1:3]) <= _MAX_PICTURE_PIXELS:
                return small_jpeg(Image.fromarray(rgb.row(len(rgb) - 1)), LISTED_PIXELS)
    return None


def checked(jpeg: bytes | None) -> bytes | None:
    """`jpeg` if it is a JPEG that is small enough for the browser; else None."""
    return jpeg if jpeg is not None and jpeg.startswith(_JPEG_START) and len(jpeg) <= MAX_BYTES else None
