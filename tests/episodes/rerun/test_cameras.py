"""Recorded cameras agree with ManiSkill's own camera matrices."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tests.episodes.read_rrd import Column, read_rrd


@pytest.fixture(scope="module")
def entities(recorded: Any, tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Column]]:
    return read_rrd(recorded.episode.write(tmp_path_factory.mktemp("recordings")).rrd)


def at(column: Column, state: int) -> NDArray:
    """The value that the viewer shows at `state`: the latest row up to that state."""
    if column.steps is None:
        return column.values[0][0]
    return column.values[np.searchsorted(column.steps, state, side="right") - 1][0]


@pytest.mark.parametrize("camera", ["base_camera", "hand_camera"])
def test_a_point_projects_to_the_pixel_that_opencv_computes(
    recorded: Any, entities: dict[str, dict[str, Column]], camera: str
) -> None:
    read = entities[f"/world/cameras/{camera}"]
    # RDF (right, down, forward) in rerun's numbering of directions.
    assert at(read["Pinhole:camera_xyz"], 0).tolist() == [3, 2, 5]
    names = recorded.episode.geometry.body_names
    points = recorded.episode.poses[:, [names.index("cube"), names.index("goal_site")], :3]
    seen = 0
    for state in range(len(points)):
        rotation = Rotation.from_quat(at(read["Transform3D:quaternion"], state))
        in_camera = rotation.inv().apply(points[state] - at(read["Transform3D:translation"], state))
        # Rerun stores matrices column-major.
        pixel = in_camera @ at(read["Pinhole:image_from_camera"], state).reshape(3, 3)
        extrinsic, intrinsic = recorded.extrinsic_cv[camera][state], recorded.intrinsic_cv[camera][state]
        expected = (points[state] @ extrinsic[:, :3].T + extrinsic[:, 3]) @ intrinsic.T
        np.testing.assert_allclose(pixel, expected, atol=2e-4)
        seen += int((expected[:, 2] > 0).sum())
    assert seen > 0, "both points were always behind the camera"
