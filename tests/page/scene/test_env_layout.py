from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.drive.panels import Panels
from tests.drive.scenes import box_mesh, table_scene, visual
from workbench.envs.scene.shapes import SceneGeometry
from workbench.page.scene.env_grid import (
    SelectionMark,
    acting_box,
    env_under_ray,
    grid_offsets,
    lay_out,
    place_of_plane,
    plane_normal,
)


def test_the_box_of_an_env_contains_its_bodies_but_not_its_floor() -> None:
    geometry, poses = table_scene(4)
    layout = lay_out(geometry, poses)
    np.testing.assert_allclose(layout.low, [-0.6, -1.2, -0.92], atol=1e-6)
    np.testing.assert_allclose(layout.high, [0.6, 1.2, 0.65], atol=1e-6)
    assert layout.has_floor
    poses[2, 3, :3] = [0.9, 0.0, 0.02]  # in one env the cube is beside the table
    np.testing.assert_allclose(lay_out(geometry, poses).high, [0.92, 1.2, 0.65], atol=1e-6)
    poses[1, 3, :3] = [0.0, -1.5, 0.02]
    np.testing.assert_allclose(lay_out(geometry, poses).low, [-0.6, -1.52, -0.92], atol=1e-6)
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
    behind = front - [20.0, 0.0, 0.0]
    last = int(np.where(layout.offsets[:, 1] == layout.offsets[0, 1], layout.offsets[:, 0], np.inf).argmin())
    assert last != 0 and env_under_ray(layout, behind, np.array([1.0, 0.0, 0.0])) == last


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


def test_the_first_envs_are_in_front_from_left_to_right() -> None:
    offsets = grid_offsets(6, np.array([1.0, 1.0]))
    assert offsets[:, 0].tolist() == [0.5, 0.5, 0.5, -0.5, -0.5, -0.5]
    assert offsets[:, 1].tolist() == [-1, 0, 1, -1, 0, 1] and not offsets[:, 2].any()
    assert grid_offsets(1, np.array([1.0, 2.0])).tolist() == [[0, 0, 0]]
    many = grid_offsets(100, np.array([1.0, 1.0]))
    deep, wide = np.ptp(many[:, :2], axis=0)
    assert 1.2 < wide / deep < 1.7


def test_a_scene_of_nothing_has_a_box_and_a_wall_belongs_to_its_own_side() -> None:
    geometry, poses = table_scene(2)
    nothing = lay_out(SceneGeometry(2, (), (), (), ()), np.zeros((2, 0, 7), np.float32))
    assert (nothing.high > nothing.low).all() and not nothing.has_floor
    layout = lay_out(*table_scene(9))
    for y, sign in ((2.0, 1), (-2.0, -1)):
        wall = visual("wall", box_mesh((40, 0.01, 20)), 9, 0)
        at = np.tile(np.array([0, y, 0, 1, 0, 0, 0], np.float32), (9, 1, 1))
        for normal in ([0.0, 1.0, 0.0], [0.0, -1.0, 0.0]):
            place = place_of_plane(np.array(normal), wall, at, layout)
            assert place[1] == pytest.approx(sign * layout.offsets[:, 1].max())
    assert place_of_plane(np.array([0.0, 0.1, 0.99]), geometry.visuals[0], poses, layout).tolist() == [
        0,
        0,
        0,
    ]


def test_the_acting_box_contains_robots_and_movable_bodies_within_the_env() -> None:
    geometry, poses = table_scene(3)
    layout = lay_out(geometry, poses)
    poses[:, 3, :3] = [[0.1, 0.2, 0.02], [0.3, -0.4, 0.02], [np.nan] * 3]
    low, high = acting_box(geometry, poses, layout)
    np.testing.assert_allclose(low, np.array([0, -0.4, 0.02]) - 0.08, atol=1e-6)
    np.testing.assert_allclose(high, np.array([0.3, 0.2, 0.5]) + 0.08, atol=1e-6)
    poses[0, 3, :3] = [50.0, 0.2, -30.0]
    low, high = acting_box(geometry, poses[:1], layout)
    np.testing.assert_allclose([low[2], high[0]], [layout.low[2] - 0.08, layout.high[0] + 0.08], atol=1e-6)
    poses[:, 2:] = np.nan
    assert acting_box(geometry, poses, layout) == (layout.low, layout.high)


def test_the_mark_frames_the_selected_env_at_the_height_of_the_table(panels: Panels) -> None:
    layout, mark = lay_out(*table_scene(4)), SelectionMark(panels.server)
    for env in (0, 3):
        mark.draw(layout, env, shown=True)
        (frame,) = panels.nodes("/selected/frame")
        corners = frame.points.reshape(-1, 3)
        low, high = layout.low + layout.offsets[env], layout.high + layout.offsets[env]
        assert (corners.min(axis=0)[:2] < low[:2]).all() and (corners.max(axis=0)[:2] > high[:2]).all()
        np.testing.assert_allclose(corners.mean(axis=0)[:2], ((low + high) / 2)[:2], atol=1e-5)
        np.testing.assert_allclose(corners[:, 2], 0.01, atol=1e-6)
        assert panels.labels() == [f"env {env}"]
    mark.draw(layout, 3, shown=True, name="B")
    assert panels.labels() == ["B"]
    before = panels.nodes("/selected/frame")[0].points.copy()
    mark.draw(layout, 0, shown=True, name="B")
    assert not np.array_equal(panels.nodes("/selected/frame")[0].points, before)
    mark.draw(layout, 3, shown=False)
    assert panels.labels() == [] and panels.nodes("/selected/frame") == []
    mark.draw(layout, 3, shown=True, name="B")
    assert panels.labels() == ["B"]
