"""Encoded pictures decode to the original, within the precision of their format."""

from __future__ import annotations

import io
import struct
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis.extra import numpy as hnp
from PIL import Image

from workbench.episodes.encoded_pictures import EncodedPictures, LazyPictures, encode

SHAPE = hnp.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=9)


@settings(max_examples=50)
@given(SHAPE.flatmap(lambda shape: hnp.arrays(np.int32, shape)))
def test_any_ids_are_decoded_exactly(ids: np.ndarray) -> None:
    (found,) = EncodedPictures("segmentation", [encode("segmentation", ids)])
    assert found.dtype == np.int32
    np.testing.assert_array_equal(found, ids)


@settings(max_examples=50)
@given(SHAPE.flatmap(lambda shape: hnp.arrays(np.uint16, shape)))
def test_whole_millimetres_are_decoded_exactly(millimetres: np.ndarray) -> None:
    depth = (millimetres / 1000).astype(np.float32)
    found = EncodedPictures("depth", [encode("depth", depth)])[0]
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, depth)


@pytest.mark.parametrize(
    ("depth", "metres"),
    [
        (np.array([[np.nan, np.inf], [-1.0, 70.0]], np.float32), [[0, 0], [0, 65.535]]),
        (np.array([[0, 1500], [65_535, 7]], np.int32), [[0, 1.5], [65.535, 0.007]]),
    ],
    ids=["metres", "whole millimetres"],
)
def test_invalid_distances_become_zero_and_the_largest_is_kept(
    depth: np.ndarray, metres: list[list[float]]
) -> None:
    found = EncodedPictures("depth", [encode("depth", depth)])[0]
    np.testing.assert_array_equal(found, np.array(metres, np.float32))


def test_colour_keeps_rows_channels_and_neighbouring_columns_apart() -> None:
    areas, stripes = np.zeros((2, 16, 24, 3), np.uint8)
    areas[:8, :, 0] = 250
    areas[:, 12:, 2] = 200
    stripes[:, ::2, 0] = stripes[:, 1::2, 2] = 220
    pictures = EncodedPictures("rgb", [encode("rgb", areas), encode("rgb", stripes)])
    assert pictures[0].shape == areas.shape and np.abs(pictures[0].astype(int) - areas).max() < 12
    assert np.abs(pictures[-1].astype(int) - stripes).mean() < 12


def test_pictures_are_read_by_any_index_and_no_more_than_asked() -> None:
    asked: list[int] = []

    def one(number: int) -> bytes:
        asked.append(number)
        return encode("segmentation", np.full((2, 3), number, np.int32))

    pictures = EncodedPictures("segmentation", LazyPictures(5, one))
    assert [int(pictures[index][0, 0]) for index in (3, -1, 0, -5)] == [3, 4, 0, 0] and asked == [3, 4, 0, 0]
    assert len(pictures) == 5 and pictures.blob(-2) == one(3) and len(pictures.blobs[1:4]) == 3
    far = EncodedPictures("segmentation", LazyPictures(5, one), lambda index: np.array([index]))
    assert [far[index].tolist() for index in (2, -1)] == [[2], [4]]
    for index in (5, -6):
        for held in (pictures, far):
            with pytest.raises(IndexError):
                held[index]


def test_a_picture_with_too_many_pixels_or_of_another_format_is_refused() -> None:
    def png(width: int, height: int) -> bytes:
        header = struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)
        chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(bytes(1000))), (b"IEND", b""))
        return b"\x89PNG\r\n\x1a\n" + b"".join(
            struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))
            for kind, content in chunks
        )

    for width, height in ((5000, 5000), (60_000, 60_000), (0, 5)):
        with pytest.raises(OSError, match="pixels|not a picture"):
            EncodedPictures("depth", [png(width, height)])[0]
    written = io.BytesIO()
    Image.new("RGB", (4, 4)).save(written, "GIF")
    with pytest.raises(OSError):
        EncodedPictures("rgb", [written.getvalue()])[0]
    with pytest.raises(OSError, match="not depth"):
        EncodedPictures("depth", [encode("rgb", np.zeros((4, 4, 3), np.uint8))])[0]
