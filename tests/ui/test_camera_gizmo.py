"""The handles of the eye and of the target: how large they are in the view."""

from __future__ import annotations

import math

import numpy as np
import pytest

from workbench.ui.camera_gizmo import PIXELS, TARGET_PIXELS, pixels_apart, sizes


def test_two_points_are_so_many_pixels_apart_as_a_camera_sees_them() -> None:
    viewer, a, b = np.zeros(3), np.array([2.0, 0, 0]), np.array([2.0, 0.1, 0])
    focal = 500 / math.tan(0.5)
    assert pixels_apart(viewer, 1.0, 1000, a, b) == pytest.approx(focal * 0.05, rel=0.1)
    assert pixels_apart(viewer, 1.0, 1000, a, a) == 0


@pytest.mark.parametrize("apart", range(0, 400, 10))
def test_handles_that_are_near_are_small_enough_and_can_still_be_taken(apart: float) -> None:
    eye, target = sizes(apart)
    assert 32 <= eye <= PIXELS and 24 <= target <= TARGET_PIXELS
    assert eye + target <= max(56, apart)
    assert apart < 160 or (eye, target) == (PIXELS, TARGET_PIXELS)
