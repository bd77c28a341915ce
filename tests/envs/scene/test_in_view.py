"""View culling agrees with the pixels on which the points of boxes and triangles fall."""

# SAPIEN and ManiSkill annotate vectors and poses as what they become.
# pyright: reportArgumentType=false

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import sapien
import sapien.render

from tests.drive.scenes import box_mesh
from workbench.envs.rendering.in_view import cut_to_view, fixed_to, is_outside, outside_and_inside, planes_of


@pytest.fixture
def camera(renderer: None) -> Any:
    component = sapien.render.RenderCameraComponent(40, 30)
    component.set_perspective_parameters(0.1, 10.0, 30.0, 35.0, 15.0, 20.0, 0.0)  # type: ignore[call-arg]
    return component


def test_a_point_is_in_view_where_its_pixel_is_in_the_picture(camera: Any) -> None:
    points = np.random.default_rng(0).uniform([-1, -3, -3], [4, 3, 3], (2000, 3))
    x, y, z = points.T
    k = camera.get_intrinsic_matrix()
    column, row = k[0, 2] - k[0, 0] * y / x, k[1, 2] - k[1, 1] * z / x
    visible = (x > 0.1) & (column > 0) & (column < 40) & (row > 0) & (row < 30)
    planes = planes_of(camera)
    boxes = np.stack([points, points], axis=1).astype(np.float32)
    outside, inside = outside_and_inside(boxes, np.tile(planes, (2000, 1, 1)))
    np.testing.assert_array_equal(outside, ~inside, "a box of zero size is either outside or inside")
    assert visible.any() and not (outside & visible).any()
    np.testing.assert_array_equal([is_outside(point[None], planes) for point in points], outside)
    nearly = (x > 0.09) & (column > -2) & (column < 42) & (row > -2) & (row < 32)
    assert outside[~nearly].all()


def test_triangles_behind_the_camera_are_cut_and_the_rest_keeps_its_normals(camera: Any) -> None:
    mesh = box_mesh((4.0, 0.2, 0.2))
    cut = cut_to_view(mesh, planes_of(camera))
    assert 0 < len(cut.faces) < len(mesh.faces)
    kept = {tuple(corner) for corner in mesh.vertices[mesh.faces].reshape(-1, 9).round(4)}
    assert {tuple(corner) for corner in cut.vertices[cut.faces].reshape(-1, 9).round(4)} <= kept
    assert cut.normals is None or len(cut.normals) == len(cut.vertices)
    assert len(cut_to_view(box_mesh((1, 1, 1), (-3, 0, 0)), planes_of(camera)).faces) == 0


def test_links_are_fixed_to_those_that_only_fixed_joints_connect() -> None:
    scene = sapien.Scene([sapien.physx.PhysxCpuSystem()])
    builder = scene.create_articulation_builder()
    links, groups = {}, ["base", "base", "arm", "arm", "arm", "tip", "base"]
    for number, (parent, kind) in enumerate(
        [
            (None, "fixed"),
            (0, "fixed"),
            (1, "revolute"),
            (2, "fixed"),
            (3, "fixed"),
            (4, "revolute"),
            (1, "fixed"),
        ]
    ):
        link = links[number] = builder.create_link_builder(None if parent is None else links[parent])
        link.set_name(str(number))
        link.add_box_collision(half_size=[0.01] * 3)
        if parent is not None:
            link.set_joint_name(f"joint{number}")
            limits = [[-1, 1]] if kind == "revolute" else []
            link.set_joint_properties(kind, limits, sapien.Pose(), sapien.Pose())
    robot = builder.build(fix_root_link=True)
    entities = {int(link.name): link.entity for link in robot.links}  # kept alive: ids are compared
    for number, entity in entities.items():
        own = {id(other) for k, other in entities.items() if groups[k] == groups[number]}
        assert fixed_to(entity) == own, number
    ball = sapien.Entity()
    assert fixed_to(ball) == {id(ball)}
