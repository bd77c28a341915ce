"""Axes of the env's origin, of its objects and of the selected body."""

from __future__ import annotations

import numpy as np

from tests.drive.panels import Panels
from tests.drive.scenes import table_scene
from workbench.page.scene.frames import BodyFrames

GEOMETRY, POSES = table_scene(3)
HAND, TABLE, CUBE = (GEOMETRY.body_names.index(name) for name in ("arm/hand", "table", "cube"))


def test_the_origin_the_objects_and_the_selected_body_have_axes_at_their_poses(panels: Panels) -> None:
    frames, offset = BodyFrames(panels.server), np.array([10.0, 0, 0])

    def drawn(selected: str, poses: np.ndarray = POSES) -> list[list[float]]:
        frames.draw(GEOMETRY, poses, 1, selected, offset)
        (axes,) = panels.nodes("/frames")
        assert len(axes.batched_wxyzs) == len(axes.batched_positions)
        return (axes.batched_positions - offset).tolist()

    origin, (table, cube, hand) = [0.0, 0.0, 0.0], POSES[1, [TABLE, CUBE, HAND], :3].tolist()
    np.testing.assert_allclose(drawn(""), [origin, table, cube], atol=1e-6)
    np.testing.assert_allclose(drawn("arm/hand"), [origin, table, hand, cube], atol=1e-6)
    lacking = POSES.copy()
    lacking[1, CUBE] = np.nan
    np.testing.assert_allclose(drawn("", lacking), [origin, table], atol=1e-6)
    frames.clear()
    assert panels.nodes("/frames") == []
