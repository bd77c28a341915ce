"""A picture that was encoded is the picture, as far as its format goes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis.extra import numpy as hnp

from workbench.recording.encoded_pictures import EncodedPictures, encode

SHAPE = hnp.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=9)


@settings(max_examples=50, deadline=None)
@given(SHAPE.flatmap(lambda shape: hnp.arrays(np.int32, shape)))
def test_ids_come_back_whatever_they_are(ids: np.ndarray) -> None:
    (found,) = EncodedPictures("segmentation", [encode("segmentation", ids)])
    assert found.dtype == np.int32
    np.testing.assert_array_equal(found, ids)


@settings(max_examples=50, deadline=None)
@given(SHAPE.flatmap(lambda shape: hnp.arrays(np.uint16, shape)))
def test_whole_millimetres_come_back(millimetres: np.ndarray) -> None:
    depth = (millimetres / 1000).astype(np.float32)
    found = EncodedPictures("depth", [encode("depth", depth)])[0]
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, depth)


def test_what_is_no_distance_is_nothing_and_the_farthest_stays() -> None:
    depth = np.array([[np.nan, np.inf], [-1.0, 70.0]], dtype=np.float32)
    np.testing.assert_array_equal(
        EncodedPictures("depth", [encode("depth", depth)])[0], np.array([[0, 0], [0, 65.535]], np.float32)
    )


def test_colour_keeps_rows_and_channels_apart() -> None:
    image = np.zeros((16, 24, 3), dtype=np.uint8)
    image[:8, :, 0] = 250
    image[:, 12:, 2] = 200
    found = EncodedPictures("rgb", [encode("rgb", image)])[-1]
    assert found.shape == image.shape
    assert np.abs(found.astype(int) - image).max() < 12


def test_what_is_no_picture_is_an_error() -> None:
    with pytest.raises(OSError):
        EncodedPictures("rgb", [b"not a picture"])[0]
