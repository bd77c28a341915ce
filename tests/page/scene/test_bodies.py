from __future__ import annotations

import io
from dataclasses import replace
from typing import Any

import numpy as np
import trimesh
import viser

from tests.drive.panels import Panels
from tests.drive.scenes import table_scene
from workbench.envs.scene.shapes import Material, Mesh
from workbench.page.scene.bodies import REMOVAL_DELAY_SECONDS, DrawStyle, SceneView
from workbench.page.scene.env_grid import lay_out


def built(server: viser.ViserServer, num_envs: int, **more: Any) -> tuple[SceneView, Any, Any, Any]:
    """A drawn table scene: the view, the geometry, the layout, and the poses (num_envs, 4, 7)."""
    geometry, poses = table_scene(num_envs)
    layout, view = lay_out(geometry, poses), SceneView(server)
    view.build(geometry, layout, poses, **more)
    return view, geometry, layout, poses


def handle_named(view: SceneView, part: str) -> viser.BatchedGlbHandle:
    return next(handle for handle in view.handles if part in handle.name)


def test_bodies_are_at_their_pose_plus_the_env_offset(server: viser.ViserServer) -> None:
    view, _, layout, poses = built(server, 4)
    poses[:, 3, :3] += [0.1, 0.2, 0.3]
    poses[2, 3, 3:] = [0, 0, 0, 1]
    view.move(poses, layout, only_env=None)
    cube = handle_named(view, "cube")
    np.testing.assert_allclose(cube.batched_positions, poses[:, 3, :3] + layout.offsets, atol=1e-6)
    np.testing.assert_allclose(cube.batched_wxyzs, poses[:, 3, 3:])


def test_floor_is_drawn_once(server: viser.ViserServer) -> None:
    view, *_ = built(server, 9)
    assert handle_named(view, "ground").batched_positions.shape == (1, 3)


def test_a_single_env_view_sends_one_env_at_the_origin(server: viser.ViserServer) -> None:
    view, _, layout, poses = built(server, 9, only_env=5)
    np.testing.assert_allclose(handle_named(view, "cube").batched_positions, poses[5:6, 3, :3])
    view.move(poses, layout, only_env=None)
    assert handle_named(view, "cube").batched_positions.shape == (9, 3)


def test_an_absent_body_is_omitted_and_hidden_if_no_env_has_it(server: viser.ViserServer) -> None:
    view, _, layout, poses = built(server, 3)
    poses[1, 3] = np.nan
    view.move(poses, layout, None)
    cube = handle_named(view, "cube")
    assert cube.batched_positions.shape == (2, 3)
    assert np.isfinite(cube.batched_positions).all()
    poses[:, 3] = np.nan
    view.move(poses, layout, None)
    assert not cube.visible
    poses[:, 3] = poses[:, 2]
    view.move(poses, layout, None)
    assert cube.visible


def test_a_body_of_one_env_is_not_shown_in_another(server: viser.ViserServer) -> None:
    geometry, poses = table_scene(3)
    cube = replace(geometry.visuals[4], envs=np.array([0, 2], np.int32), bodies=np.full(2, 3, np.int32))
    geometry = replace(geometry, visuals=(*geometry.visuals[:4], cube))
    layout, view = lay_out(geometry, poses), SceneView(server)
    view.build(geometry, layout, poses, only_env=2)
    assert handle_named(view, "cube").visible
    view.move(poses, layout, only_env=1)
    assert not handle_named(view, "cube").visible
    view.move(poses, layout, only_env=None)
    assert handle_named(view, "cube").visible and len(handle_named(view, "cube").batched_positions) == 2


def test_a_reload_keeps_nodes_with_an_unchanged_look(server: viser.ViserServer) -> None:
    view, _, layout, poses = built(server, 4)
    before = view.handles
    again, _ = table_scene(4)
    blue = replace(again.visuals[4], material=Material((0.0, 0.0, 1.0, 1.0)))
    again = replace(again, visuals=(*again.visuals[:4], blue))
    view.build(again, layout, poses)
    assert all(new is old for new, old in zip(view.handles[:3], before[:3], strict=True))
    assert view.handles[3] is not before[3]


def test_a_dark_floor_is_lighter_in_the_light_theme_and_nothing_else_is_sent(
    server: viser.ViserServer,
) -> None:
    geometry, poses = table_scene(4)
    layout = lay_out(geometry, poses)
    ground = next(visual for visual in geometry.visuals if "ground" in visual.name)
    dark = replace(ground, material=Material((0.05, 0.05, 0.06, 1.0)))
    geometry = replace(geometry, visuals=tuple(dark if v is ground else v for v in geometry.visuals))
    view = SceneView(server)
    view.build(geometry, layout, poses)
    before = {handle.name: handle.glb_data for handle in view.handles}
    view.build(geometry, layout, poses, looks=DrawStyle(dark=False))
    new = [handle for handle in view.handles if handle.name not in before]
    assert len(new) == 1 and "ground" in new[0].name and len(view.handles) == len(before)
    scene: Any = trimesh.load(io.BytesIO(new[0].glb_data), file_type="glb", force="scene")
    (floor,) = scene.geometry.values()
    assert floor.visual.material.baseColorFactor[:3].min() > 200
    view.build(geometry, layout, poses)
    assert {handle.glb_data for handle in view.handles} == set(before.values())


def test_simplified_meshes_replace_the_finer_ones_with_a_delay(server: viser.ViserServer) -> None:
    now = 0.0
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.05)
    mesh = Mesh(ball.vertices.astype(np.float32), ball.faces.astype(np.uint32))
    geometry, poses = table_scene(4)
    cube = next(visual for visual in geometry.visuals if "cube" in visual.name)
    visuals = tuple(replace(visual, mesh=mesh) if visual is cube else visual for visual in geometry.visuals)
    geometry = replace(geometry, visuals=visuals)
    layout = lay_out(geometry, poses)
    view = SceneView(server, clock=lambda: now)
    view.build(geometry, layout, poses)
    fine = handle_named(view, "cube")
    rest = [handle.name for handle in view.handles if handle is not fine]
    view.build(geometry, layout, poses, looks=DrawStyle(error=0.01))
    simple = handle_named(view, "cube")
    assert len(simple.glb_data) < 0.5 * len(fine.glb_data)
    assert [handle.name for handle in view.handles if handle is not simple] == rest
    poses[:, 3, 0] += 0.1
    view.move(poses, layout, None)
    # Both are moved, so that the replacement is not visible.
    np.testing.assert_array_equal(fine.batched_positions, simple.batched_positions)
    assert server.scene.get_handle_by_name(fine.name) is fine
    now = REMOVAL_DELAY_SECONDS
    view.move(poses, layout, None)
    assert server.scene.get_handle_by_name(fine.name) is None
    assert server.scene.get_handle_by_name(simple.name) is simple


def test_hidden_bodies_stay_in_the_browser_and_cleared_ones_do_not(panels: Panels) -> None:
    view, geometry, layout, poses = built(panels.server, 2)
    handles = view.handles
    view.hide()
    assert not any(handle.visible for handle in handles) and len(panels.nodes("/envs/")) == len(handles)
    view.build(geometry, layout, poses)
    assert view.handles == handles and all(handle.visible for handle in handles)
    view.clear()
    assert panels.nodes("/envs/") == [] and view.handles == ()
    view.build(geometry, layout, poses)
    assert all(handle.visible for handle in view.handles) and len(panels.nodes("/envs/")) == len(handles)


def test_a_scene_without_a_floor_stands_on_a_grid_around_all_envs(panels: Panels) -> None:
    geometry, poses = table_scene(4)
    bare = replace(geometry, visuals=geometry.visuals[1:])
    layout, view = lay_out(bare, poses), SceneView(panels.server)
    view.build(bare, layout, poses)
    (grid,) = panels.nodes("/floor")
    low, high = layout.box_of_all()
    assert grid.width > high[0] - low[0] and grid.height > high[1] - low[1]
    assert grid.position[2] == layout.floor_height == layout.low[2]
    view.build(geometry, lay_out(geometry, poses), poses)
    assert panels.nodes("/floor") == []


def test_a_new_scene_replaces_the_shapes_of_the_old_one_at_once(panels: Panels) -> None:
    """Only finer or coarser shapes of the same scene overlap for a moment."""
    view, geometry, layout, poses = built(panels.server, 2)
    fewer = replace(geometry, visuals=geometry.visuals[:3])
    view.build(fewer, layout, poses)
    assert len(panels.nodes("/envs/")) == len(view.handles) == 3
    view.build(geometry, layout, poses, only_env=1)
    cube = handle_named(view, "cube")
    np.testing.assert_allclose(cube.batched_positions, poses[1:, 3, :3])


def test_a_body_that_moves_only_in_one_env_moves_there(server: viser.ViserServer) -> None:
    view, _, layout, poses = built(server, 3)
    for env in (2, 0):
        poses = poses.copy()
        poses[env, 3, 1] += 0.5
        view.move(poses, layout, None)
        np.testing.assert_allclose(
            handle_named(view, "cube").batched_positions, poses[:, 3, :3] + layout.offsets, atol=1e-6
        )
