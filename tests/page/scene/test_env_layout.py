from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.drive.scenes import box_mesh, table_scene, visual
from workbench.envs.scene.shapes import SceneGeometry
from workbench.page.scene.env_grid import env_under_ray, grid_offsets, lay_out, place_of_plane, plane_normal


def test_the_box_of_an_env_contains_its_bodies_but_not_its_floor() -> None:
    geometry, poses = table_scene(4)
    layout = lay_out(geometry, poses)
    np.testing.assert_allclose(layout.low, [-0.6, -1.2, -0.92], atol=1e-6)
    np.testing.assert_allclose(layout.high, [0.6, 1.2, 0.65], atol=1e-6)
    assert layout.has_floor
    assert layout.floor_height == pytest.approx(-0.92, abs=1e-3)


@given(
    num_envs=st.integers(1, 300),
    depth=st.floats(0.3, 12.0),
    width=st.floats(0.3, 12.0),
)
@settings(max_examples=60)
def test_envs_of_a_grid_do_not_touch(num_envs: int, depth: float, width: float) -> None:
    offsets = grid_offsets(num_envs, np.array([depth, width]))
    assert offsets.shape == (num_envs, 3)
    apart = np.abs(offsets[:, None] - offsets[None])
    clear = (apart[..., 0] > depth * 0.999) | (apart[..., 1] > width * 0.999)
    assert clear[~np.eye(num_envs, dtype=bool)].all()


def test_neither_a_wide_table_nor_a_moving_plate_is_a_floor() -> None:
    geometry, poses = table_scene(1)
    normal = plane_normal(geometry.visuals[0], geometry, poses)
    assert normal is not None
    np.testing.assert_allclose(normal, [0, 0, 1], atol=1e-9)
    assert plane_normal(geometry.visuals[1], geometry, poses) is None
    plate = visual("p", box_mesh((40, 40, 0.01)), 1, 0)
    moving = SceneGeometry(1, ("plate",), ("dynamic",), (False,), (plate,))
    assert plane_normal(plate, moving, poses[:, :1]) is None


def test_a_wall_belongs_to_no_box_and_stands_behind_the_whole_grid() -> None:
    geometry, poses = table_scene(9)
    wall = visual("wall/0", box_mesh((40, 0.01, 20)), 9, len(geometry.body_names))
    geometry = SceneGeometry(
        9,
        (*geometry.body_names, "wall"),
        (*geometry.body_kinds, "static"),
        (False,) * 5,
        (*geometry.visuals, wall),
    )
    poses = np.concatenate([poses, np.tile(np.array([0, 2, 0, 1, 0, 0, 0], np.float32), (9, 1, 1))], axis=1)
    layout = lay_out(geometry, poses)
    assert layout.high[1] == pytest.approx(1.2)
    normal = plane_normal(wall, geometry, poses)
    assert normal is not None
    place = place_of_plane(normal, wall, poses, layout)
    assert place[1] + 2 > (layout.high + layout.offsets)[:, 1].max()
    np.testing.assert_allclose(place[[0, 2]], 0, atol=1e-6)


def test_a_click_selects_the_env_under_it() -> None:
    geometry, poses = table_scene(9)
    layout = lay_out(geometry, poses)
    for env in range(9):
        above = layout.offsets[env] + [0.1, 0.1, 5.0]
        assert env_under_ray(layout, above, np.array([0.0, 0.0, -1.0])) == env


def test_a_click_selects_the_nearer_of_two_envs_in_a_row() -> None:
    geometry, poses = table_scene(9)
    layout = lay_out(geometry, poses)
    front = layout.offsets[0] + [10.0, 0.0, 0.0]
    assert env_under_ray(layout, front, np.array([-1.0, 0.0, 0.0])) == 0


def test_a_click_between_or_behind_envs_or_with_invalid_numbers_selects_none() -> None:
    geometry, poses = table_scene(4)
    layout = lay_out(geometry, poses)
    above, down = layout.offsets[0] + [0.1, 0.1, 5.0], np.array([0.0, 0.0, -1.0])
    assert env_under_ray(layout, above, down) == 0
    assert env_under_ray(layout, above, -down) is None, "the env is behind the eye"
    between = (layout.offsets[0] + layout.offsets[1]) / 2 + [0.1, 0.0, 5.0]
    assert env_under_ray(layout, between, down) is None
    edge = layout.offsets[0] + [layout.high[0], 0.0, 5.0]
    assert env_under_ray(layout, edge - [0.01, 0, 0], down) == 0
    assert env_under_ray(layout, edge + [0.01, 0, 0], down) is None
    for broken in (np.nan, np.inf):
        assert env_under_ray(layout, above, np.array([broken, 0.0, -1.0])) is None
        assert env_under_ray(layout, np.array([0.0, broken, 5.0]), down) is None


def test_the_box_of_a_body_rotates_with_it_by_the_right_hand_rule() -> None:
    arm = visual("arm", box_mesh((1.0, 0.2, 0.4), (0.5, 0, 0)), 2, 0)
    geometry = SceneGeometry(2, ("arm",), ("dynamic",), (False,), (arm,))
    quarter_about_z = [0.1, 0, 0, np.sqrt(0.5), 0, 0, np.sqrt(0.5)]
    layout = lay_out(geometry, np.array([[quarter_about_z], [quarter_about_z]], np.float32))
    np.testing.assert_allclose(layout.low, [0, 0, -0.2], atol=1e-6)
    np.testing.assert_allclose(layout.high, [0.2, 1.0, 0.2], atol=1e-6)
    wall = visual("wall", box_mesh((40, 0.01, 20)), 2, 0)
    standing = SceneGeometry(2, ("wall",), ("static",), (False,), (wall,))
    normal = plane_normal(wall, standing, np.array([[quarter_about_z]], np.float32))
    assert normal is not None
    np.testing.assert_allclose(normal, [-1, 0, 0], atol=1e-6)
