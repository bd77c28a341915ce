"""Pictures of 16-bit numbers as PNG, in a fifth of the time that an image library takes.

A recording writes two such pictures a camera and step, depth and segmentation. Libraries try five filters on each line of a PNG and keep
the one that looks best, one byte at a time: 0.2 to 0.5 ms for 128 x 128, more than all else that the step is recorded with. Here every
line is the difference to the one above, which is what surfaces want, in one numpy call; the files come out smaller besides, and zlib
lets other threads run meanwhile.

The format is that of the PNG specification (third edition): signature, IHDR, one IDAT, IEND, each chunk with its length and CRC-32
(section 5); filter type 2, "up", before each line (section 9); numbers with the high byte first (section 7.1).
"""

from __future__ import annotations

import struct
import zlib

import numpy as np
from numpy.typing import NDArray

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_GREYSCALE = 0
_UP = 2
_LEVEL = 3
"""Of zlib. The fastest level makes files no smaller and takes longer on smooth depth (measured); the usual 6 takes three times as long."""


def encode_png16(pixels: NDArray[np.uint16]) -> bytes:
    """(H, W), both above 0, as greyscale PNG of 16 bits."""
    height, width = pixels.shape
    lines = pixels.astype(">u2").view(np.uint8).reshape(height, 2 * width)
    filtered = np.empty((height, 1 + 2 * width), np.uint8)
    filtered[:, 0] = _UP
    filtered[0, 1:] = lines[0]
    np.subtract(lines[1:], lines[:-1], out=filtered[1:, 1:])
    header = struct.pack(">IIBBBBB", width, height, 16, _GREYSCALE, 0, 0, 0)
    parts = (
        _chunk(b"IHDR", header),
        _chunk(b"IDAT", zlib.compress(filtered.data, _LEVEL)),
        _chunk(b"IEND", b""),
    )
    return _SIGNATURE + b"".join(parts)


def _chunk(kind: bytes, content: bytes) -> bytes:
    return b"".join(
        (
            struct.pack(">I", len(content)),
            kind,
            content,
            struct.pack(">I", zlib.crc32(content, zlib.crc32(kind))),
        )
    )
