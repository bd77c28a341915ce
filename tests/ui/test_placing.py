"""How far a camera looks: as its file says, as somebody set it, or as it did before."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

from tests.ui.scenes import camera
from workbench.core.camera_frames import LookAt, pose_from_look_at, with_pose
from workbench.core.camera_settings import CameraSettings
from workbench.session.studio_view import StudioCamera
from workbench.ui.camera_moves import Placing

EYE, TARGET = (0.45, 0.0, 0.6), (0.08, 0.0, 0.2)
"""It looks at something above the ground, which a line of sight does not tell."""
LENS = CameraSettings((0, 0, 0), (1, 0, 0, 0), 1.0, None, 128, 128, 0.01, 10.0, "minimal")
FILE = with_pose(LENS, pose_from_look_at(LookAt(EYE, TARGET, 0.0)))


def chosen(now: CameraSettings, target: tuple[float, float, float] | None = TARGET) -> StudioCamera:
    info = replace(camera(), settings=FILE, target=target)
    return StudioCamera(info.key, info, now, now != FILE, None)


def looks_at(placing: Placing, camera: StudioCamera) -> Any:
    assert camera.now is not None
    return pytest.approx(placing.target(camera, camera.now), abs=1e-6)


def test_the_target_is_the_one_that_the_file_gives_and_follows_it() -> None:
    """It was where the line of sight meets the ground."""
    placing = Placing(cast(Any, None))
    assert looks_at(placing, chosen(FILE)) == TARGET
    # The file names another point that is seen the same way.
    further = tuple(np.add(EYE, 1.5 * np.subtract(TARGET, EYE)))
    assert looks_at(placing, chosen(FILE, further)) == further


def test_moved_it_looks_as_far_as_it_did_and_back_in_its_place_at_what_the_file_gives() -> None:
    placing = Placing(cast(Any, None))
    moved = replace(FILE, position=(0.45, 0.3, 0.6))
    assert looks_at(placing, chosen(FILE)) == TARGET
    assert looks_at(placing, chosen(moved)) == (0.08, 0.3, 0.2)
    placing.set_distance(camera().key, moved, 2.0)
    assert placing.distance(chosen(moved)) == 2.0
    assert looks_at(placing, chosen(FILE)) == TARGET


def test_without_a_target_in_the_file_it_looks_at_the_ground() -> None:
    placing = Placing(cast(Any, None))
    assert looks_at(placing, chosen(FILE, None)) == (-0.105, 0, 0)
