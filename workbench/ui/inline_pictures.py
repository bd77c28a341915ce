"""Pictures inside of our own HTML, as ``data:`` addresses.

viser's own pictures cannot be pressed, and stand one below the other. A table with a picture in each row, or a sheet
of sixty-four small ones, has to carry them in its HTML. A picture of 128 x 128 is 3 to 6 kB so.
"""

from __future__ import annotations

import base64
import io

import numpy as np
from numpy.typing import NDArray
from PIL import Image


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
    return "data:image/jpeg;base64," + base64.b64encode(written.getvalue()).decode("ascii")
