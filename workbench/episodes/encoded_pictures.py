"""Encodes and decodes camera pictures: JPEG for colour, 16-bit PNG for depth and segmentation."""

from __future__ import annotations

import contextlib
import io
import struct
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

Modality = Literal["rgb", "depth", "segmentation"]
MODALITIES: tuple[Modality, ...] = ("rgb", "depth", "segmentation")

JPEG_QUALITY = 85
MILLIMETRES_PER_METRE = 1000.0
MAX_PIXELS = 1 << 24
"""Maximum size of one picture: 4096 x 4096. A PNG of 100 kB can claim a hundred times as many pixels."""
_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_GREYSCALE = 0
_UP = 2
_ZLIB_LEVEL = 3
"""Compression level of zlib. Level 1 has no advantage: its files are not smaller, and smooth depth takes
longer. The default 6 takes three times as long (measured)."""


@dataclass(frozen=True)
class EncodedPictures:
    """Pictures of one camera in one modality; ``pictures[i]`` decodes picture `i`.

    Ten thousand steps with four cameras are a few hundred megabytes encoded and several gigabytes as arrays, so
    pictures stay encoded from the camera through the journal into the recording, and are decoded only when shown.
    """

    modality: Modality
    blobs: Sequence[bytes]
    decoded: Callable[[int], NDArray] | None = None
    """Decodes picture `i` in another process; may raise OSError. None to decode it in this process."""

    def __len__(self) -> int:
        return len(self.blobs)

    def blob(self, index: int) -> bytes:
        """Picture `index` encoded: JPEG (rgb), 16-bit PNG in millimetres (depth), PNG of ids (segmentation)."""
        return self.blobs[index]

    def __getitem__(self, index: int) -> NDArray:
        """Picture `index`: rgb (H, W, 3) uint8; depth (H, W) float32 metres; segmentation (H, W) int32.

        Raises:
            IndexError: there is no such picture.
            OSError: it cannot be decoded.
        """
        if self.decoded is not None:
            return self.decoded(range(len(self))[index])
        return decode(self.modality, self.blobs[index])


class LazyPictures(Sequence[bytes]):
    """Encoded pictures that are read on access; slices are lists."""

    def __init__(self, count: int, one: Callable[[int], bytes]) -> None:
        """`one` returns picture `i`, 0 <= i < count; it may raise OSError."""
        self._count, self._one = count, one

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: Any) -> Any:
        numbers = range(self._count)[index]
        return self._one(numbers) if isinstance(numbers, int) else [self._one(number) for number in numbers]


def encode(modality: Modality, picture: NDArray) -> bytes:
    """Encode `picture`, shaped as in ``EncodedPictures.__getitem__``; depth may be integer millimetres >= 0."""
    if modality == "rgb":
        return encode_jpeg(picture)
    if modality == "depth":
        return encode_png16(picture) if picture.dtype.kind in "iu" else encode_depth_png(picture)
    return encode_segmentation_png(picture)


def decode(modality: Modality, blob: bytes) -> NDArray:
    """The inverse of `encode`, up to the loss of JPEG and the rounding to millimetres. Raises OSError if it cannot decode."""
    with open_picture(blob) as image:
        if modality == "rgb":
            return np.array(image.convert("RGB"))
        pixels = np.array(image)
    if pixels.ndim == 3 and (pixels.shape[2] != 4 or modality != "segmentation"):
        raise OSError(f"it is a picture with {pixels.shape[2]} channels, not {modality}")
    if modality == "depth":
        return (pixels / MILLIMETRES_PER_METRE).astype(np.float32)
    return pixels.view(np.int32)[..., 0] if pixels.ndim == 3 else pixels.astype(np.int32)


@contextlib.contextmanager
def open_picture(blob: bytes) -> Iterator[Image.Image]:
    """Open a JPEG, PNG or WebP of at most `MAX_PIXELS`. Raises OSError if it is invalid; the ``with`` block
    raises it too, if decoding fails there."""
    try:
        with Image.open(io.BytesIO(blob), formats=("JPEG", "PNG", "WEBP")) as image:
            if image.width * image.height > MAX_PIXELS:
                raise OSError(f"it claims {image.width} x {image.height} pixels")
            yield image
    except UnidentifiedImageError as error:
        raise OSError("it is not a picture") from error
    except (ValueError, SyntaxError, struct.error, zlib.error, Image.DecompressionBombError) as error:
        raise OSError(f"it is not a picture ({error})") from error


def encode_jpeg(image: NDArray[np.uint8]) -> bytes:
    """(H, W, 3) as JPEG with colour at full resolution: subsampled colour blurs the edges of small pictures."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="JPEG", quality=JPEG_QUALITY, subsampling=0)
    return buffer.getvalue()


def small_jpeg(image: Image.Image, longest: int) -> bytes:
    """`image` as JPEG, scaled down until no side is longer than `longest` pixels."""
    small = image.convert("RGB")
    small.thumbnail((longest, longest))
    buffer = io.BytesIO()
    small.save(buffer, format="JPEG", quality=80)
    return buffer.getvalue()


def encode_depth_png(depth: NDArray[np.float32]) -> bytes:
    """(H, W) metres as 16-bit PNG in millimetres.

    NaN, infinite and negative values become 0 ("nothing"); distances beyond the maximum of 16 bits, 65.535 m, become
    65.535 m.
    """
    millimetres = np.nan_to_num(depth * MILLIMETRES_PER_METRE, nan=0.0, posinf=0.0, neginf=0.0)
    return encode_png16(np.rint(np.clip(millimetres, 0, 0xFFFF)).astype(np.uint16))


def encode_segmentation_png(ids: NDArray[np.int32]) -> bytes:
    """(H, W) ids as 16-bit PNG, or as the four bytes of RGBA if an id is negative or beyond 65535."""
    if ids.min() >= 0 and ids.max() <= 0xFFFF:
        return encode_png16(ids.astype(np.uint16))
    buffer = io.BytesIO()
    bytes_of = np.ascontiguousarray(ids, dtype=np.int32)[..., None].view(np.uint8)
    Image.fromarray(bytes_of).save(buffer, format="PNG", compress_level=3)
    return buffer.getvalue()


def encode_png16(pixels: NDArray[np.uint16]) -> bytes:
    """(H, W), both above 0, as greyscale PNG of 16 bits.

    Libraries try five filters per line, byte by byte: 0.2 to 0.5 ms for 128 x 128, more than everything else that
    recording a step costs, and a step has two such pictures per camera. Here every line is stored as the
    difference from the line above, which one numpy call computes. This takes a fifth of the time and makes
    smaller files, and zlib releases the GIL.

    PNG specification (third edition): signature, IHDR, one IDAT, IEND, each chunk with its length and CRC-32
    (section 5); filter type 2, "up", before each line (section 9); numbers big-endian (7.1).
    """
    height, width = pixels.shape
    lines = pixels.astype(">u2").view(np.uint8).reshape(height, 2 * width)
    filtered = np.empty((height, 1 + 2 * width), np.uint8)
    filtered[:, 0] = _UP
    filtered[0, 1:] = lines[0]
    np.subtract(lines[1:], lines[:-1], out=filtered[1:, 1:])
    header = struct.pack(">IIBBBBB", width, height, 16, _GREYSCALE, 0, 0, 0)
    parts = (
        _chunk(b"IHDR", header),
        _chunk(b"IDAT", zlib.compress(filtered.data, _ZLIB_LEVEL)),
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
