from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from workbench.page.widgets.modality_colours import (
    MAX_LEGEND_ENTRIES,
    NOTHING,
    VIRIDIS,
    DepthRange,
    colour_depth,
    colour_normal,
    colour_position,
    colour_segmentation,
    depth_range,
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
