"""The body under a click, and its mark."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from viser.transforms import SO3

from tests.drive.panels import Panels
from tests.drive.scenes import table_scene
from workbench.page.scene.body_pick import BodyMark, body_under_ray, box_of_body

GEOMETRY, POSES = table_scene(2)
NAMES = GEOMETRY.body_names
DOWN = np.array([0.0, 0.0, -1.0])
CUBE = NAMES.index("cube")


def name_at(x: float, y: float, env: int = 0, poses: np.ndarray = POSES) -> str | None:
    body = body_under_ray(GEOMETRY, poses, env, np.array([x, y, 5.0]), DOWN)
    return None if body is None else NAMES[body]


def test_the_nearest_surface_counts_and_a_floor_is_no_body() -> None:
    poses = POSES.copy()
    poses[:, CUBE, :2] = 0.3, 0.4
    assert name_at(0.3, 0.4, poses=poses) == "cube"
    assert name_at(0.0, 0.0, poses=poses) == "arm/hand", "it is above the table"
    assert name_at(-0.5, 1.0, poses=poses) == "table"
    assert name_at(5.0, 5.0, poses=poses) is None
    assert name_at(500.0, 0.0, poses=poses) is None


def test_a_body_that_an_env_lacks_is_not_hit() -> None:
    poses = POSES.copy()
    poses[:, CUBE, :2] = 0.3, 0.4
    poses[1, CUBE] = np.nan
    assert name_at(0.3, 0.4, env=1, poses=poses) == "table"


@given(
    st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: sum(x * x for x in q) > 0.1),
    st.tuples(*[st.floats(-0.019, 0.019)] * 3),
    st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda d: sum(x * x for x in d) > 0.1),
)
@settings(max_examples=60)
def test_a_ray_towards_a_point_inside_a_turned_body_hits_it(
    turn: tuple[float, ...], inside: tuple[float, ...], away: tuple[float, ...]
) -> None:
    poses = POSES.copy()
    poses[:, [row for row in range(len(NAMES)) if row != CUBE]] = np.nan
    quaternion = np.array(turn) / np.linalg.norm(turn)
    poses[0, CUBE] = np.concatenate([[1.0, 2.0, 3.0], quaternion])
    aim = SO3(quaternion).apply(np.array(inside)) + poses[0, CUBE, :3]
    origin = aim + 3 * np.array(away) / np.linalg.norm(away)
    assert body_under_ray(GEOMETRY, poses, 0, origin, aim - origin) == CUBE
    assert body_under_ray(GEOMETRY, poses, 0, origin, origin - aim) is None, "it is behind the eye"


@pytest.mark.parametrize("broken", [np.nan, np.inf])
def test_a_ray_that_is_not_finite_hits_nothing(broken: float) -> None:
    assert body_under_ray(GEOMETRY, POSES, 0, np.array([broken, 0, 5.0]), DOWN) is None
    assert body_under_ray(GEOMETRY, POSES, 0, np.array([0, 0, 5.0]), np.array([broken, 0, -1.0])) is None


def test_the_mark_is_the_box_of_the_body_at_its_pose(panels: Panels) -> None:
    mark = BodyMark(panels.server)
    mark.draw(GEOMETRY, POSES, 1, "cube", np.array([10.0, 0, 0]))
    (edges,) = panels.nodes("/selected_body/box")
    low, high = edges.points.reshape(-1, 3).min(axis=0), edges.points.reshape(-1, 3).max(axis=0)
    at = POSES[1, CUBE, :3] + [10, 0, 0]
    np.testing.assert_allclose([low, high], [at - 0.02, at + 0.02], atol=1e-6)
    assert len(edges.points) == 12 and panels.labels() == ["cube"]
    mark.draw(GEOMETRY, POSES, 1, "arm/hand", np.zeros(3))
    (edges,) = panels.nodes("/selected_body/box")
    np.testing.assert_allclose(np.ptp(edges.points.reshape(-1, 3), axis=0), [0.1, 0.1, 0.3], atol=1e-6)
    mark.draw(GEOMETRY, POSES, 1, "no such body", np.zeros(3))
    assert panels.nodes("/selected_body/box") == [] and panels.labels() == []
    box = box_of_body(GEOMETRY, 0, NAMES.index("arm/hand"))
    assert box is not None
    np.testing.assert_allclose(box, [[-0.05, -0.05, -0.15], [0.05, 0.05, 0.15]], atol=1e-6)
