from __future__ import annotations

import base64
import io
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image

from workbench.envs.camera_data import Picture
from workbench.page.widgets.modality_colours import (
    MAX_LEGEND_ENTRIES,
    MODALITIES,
    NOTHING,
    VIRIDIS,
    DepthRange,
    colour_depth,
    colour_normal,
    colour_position,
    colour_segmentation,
    data_address,
    depth_range,
    depth_span,
    image_format,
    in_colours,
    narrowed,
    segment_colour,
    segments_seen,
)


def test_the_ends_of_the_depth_range_use_the_ends_of_the_scale() -> None:
    depth = np.array([[1.0, 2.0, 3.0, 0.0, 99.0]], np.float32)
    coloured = colour_depth(depth, DepthRange(1.0, 3.0))
    np.testing.assert_array_equal(coloured[0, 0], VIRIDIS[0].astype(np.uint8))
    np.testing.assert_array_equal(coloured[0, 2], VIRIDIS[-1].astype(np.uint8))
    np.testing.assert_array_equal(coloured[0, 3], NOTHING)
    np.testing.assert_array_equal(coloured[0, 4], VIRIDIS[-1].astype(np.uint8))


@given(hnp.arrays(np.float32, hnp.array_shapes(min_dims=2, max_dims=2, max_side=12)))
def test_any_depth_gives_a_picture(depth: np.ndarray) -> None:
    span = depth_range(depth)
    coloured = colour_depth(depth, span or DepthRange(0.0, 1.0))
    assert coloured.shape == (*depth.shape, 3)
    assert coloured.dtype == np.uint8
    if span is not None:
        assert 0 < span.near < span.far


def test_a_floor_to_the_horizon_does_not_reduce_contrast_on_the_table() -> None:
    depth = np.full((100, 100), 1.0, np.float32)
    depth[:20] = 80.0
    depth[60:, :] = 0.5
    span = depth_range(depth)
    assert span is not None
    assert span.near == pytest.approx(0.5)
    assert span.far == pytest.approx(3.0)


def test_a_segment_id_has_one_colour_everywhere_and_neighbours_differ() -> None:
    coloured = colour_segmentation(np.array([[0, 1], [2, 1]], np.int32))
    np.testing.assert_array_equal(coloured[0, 1], coloured[1, 1])
    np.testing.assert_array_equal(coloured[0, 0], NOTHING)
    colours = {segment_colour(identity) for identity in range(1, 60)}
    assert len(colours) == 59
    apart = [
        np.abs(np.subtract(segment_colour(identity), segment_colour(identity + 1))).sum()
        for identity in range(1, 60)
    ]
    assert min(apart) > 60


def test_legend_names_the_largest_first_and_counts_the_rest() -> None:
    picture = np.repeat(np.arange(MAX_LEGEND_ENTRIES + 4), np.arange(MAX_LEGEND_ENTRIES + 4, 0, -1)).astype(
        np.int32
    )
    legend, more = segments_seen(picture[None], {1: "cube"})
    assert [name for _, name in legend][:3] == ["background", "cube", "id 2"]
    assert len(legend) == MAX_LEGEND_ENTRIES
    assert more == 4


def test_normals_are_drawn_as_normal_maps_and_background_is_dark() -> None:
    normal = np.array([[[1, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, 0]]], np.float32)
    wanted = [[255, 128, 128], [128, 0, 128], [128, 128, 255], NOTHING.tolist()]
    assert colour_normal(normal)[0].tolist() == wanted


@given(hnp.arrays(np.float32, (5, 7, 3), elements=st.floats(-100, 100, width=32)))
def test_positions_use_the_whole_scale_and_the_background_is_dark(position: np.ndarray) -> None:
    met = position[..., 2] < 0
    coloured = colour_position(position)
    assert (coloured[~met] == NOTHING).all()
    farthest_right = np.where(met, position[..., 0], -np.inf)
    if met.sum() > 1 and np.ptp(position[met][:, 0]) > 0.1:
        assert (coloured[farthest_right == farthest_right.max()][:, 0] == 255).all()


PICTURE = Picture("eye", "sensor", 0, np.zeros(7, np.float32))
DEPTH = np.linspace(1, 2, 12, dtype=np.float32).reshape(3, 4)


def test_a_picture_is_shown_in_each_modality_that_it_has() -> None:
    ids = np.array([[0, 1], [1, 1]], np.int32)
    normal, position = np.zeros((2, 2, 3), np.float32), np.full((2, 2, 3), -1.0, np.float32)
    position[0, 0] = 3.0
    grey = np.full((2, 2, 3), 7, np.uint8)
    has = {
        "rgb": grey,
        "depth": DEPTH[:2, :2],
        "segmentation": ids,
        "position": position,
        "normal": normal,
        "albedo": grey + 1,
    }
    for modality in MODALITIES:
        assert in_colours(PICTURE, modality, {}, None) is None
        shown = in_colours(
            replace(PICTURE, **{modality: has[modality]}), modality, {1: "cube"}, DepthRange(0.5, 4.25)
        )
        assert shown is not None and shown[0].shape == (2, 2, 3)
        if modality == "depth":
            np.testing.assert_array_equal(shown[0], colour_depth(DEPTH[:2, :2], DepthRange(0.5, 4.25)))
            assert "0.50" in shown[1] and "4.25" in shown[1]
        if modality == "segmentation":
            assert "cube" in shown[1] and "background" in shown[1]
            assert "rgb({},{},{})".format(*segment_colour(1)) in shown[1]
        if modality in ("rgb", "albedo"):
            np.testing.assert_array_equal(shown[0], has[modality])
    assert {modality for modality in MODALITIES if image_format(modality) == "png"} == {"segmentation"}


def test_the_range_of_depth_widens_and_never_narrows() -> None:
    near, far = replace(PICTURE, depth=DEPTH), replace(PICTURE, depth=DEPTH + 3)
    first = depth_span(None, near)
    assert first is not None and depth_span(first, PICTURE) is first and depth_span(None, PICTURE) is None
    both = depth_span(first, far)
    assert both is not None and (both.near, both.far > 4.5) == (first.near, True)
    assert depth_span(both, near) == both and depth_span(depth_span(None, far), near) == both


def test_a_large_picture_is_averaged_to_the_longest_side_and_a_small_one_is_not() -> None:
    stripes = np.zeros((60, 200, 3), np.uint8)
    stripes[:, ::2] = 200
    for pixels, longest, size in (
        (stripes, 100, (100, 30)),
        (np.swapaxes(stripes, 0, 1), 100, (30, 100)),
        (stripes, 200, (200, 60)),
    ):
        kind, _, data = data_address(pixels, longest).partition(",")
        image = Image.open(io.BytesIO(base64.b64decode(data)))
        assert kind == "data:image/jpeg;base64" and image.size == size
        assert np.asarray(image).mean() == pytest.approx(100, abs=3)
    half = narrowed(stripes, 100, smooth=True)
    assert half.shape == (30, 100, 3) and (half == 100).all()
    assert set(np.unique(narrowed(stripes, 100, smooth=False))) <= {0, 200}
    assert narrowed(stripes, 200, smooth=True) is stripes
