"""Reduced meshes keep their shape, their edges and their texture."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from scipy.spatial import KDTree

from workbench.envs.scene.normals import with_normals
from workbench.envs.scene.shapes import Mesh
from workbench.envs.scene.simplify import cluster_mesh, flat_rectangle, reduce_mesh, rounded, share_vertices


def soup(mesh: trimesh.Trimesh) -> Mesh:
    """Give every triangle its own vertices, as some exporters do."""
    points = np.asarray(mesh.triangles, np.float32).reshape(-1, 3)
    normals = np.repeat(mesh.face_normals, 3, axis=0).astype(np.float32)
    return Mesh(points, np.arange(len(points), dtype=np.uint32).reshape(-1, 3), normals)


def as_trimesh(mesh: Mesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=True)


@pytest.mark.parametrize("size", [0.01, 1.0, 50.0])
def test_a_reduced_triangle_soup_keeps_its_volume(size: float) -> None:
    ball = trimesh.creation.icosphere(subdivisions=5, radius=size)
    reduced = reduce_mesh(soup(ball), 800)
    assert len(reduced.faces) <= 800
    assert as_trimesh(reduced).is_watertight
    assert as_trimesh(reduced).volume == pytest.approx(ball.volume, rel=0.02)
    assert reduced.normals is not None
    outwards = reduced.vertices / np.linalg.norm(reduced.vertices, axis=1, keepdims=True)
    assert np.quantile((reduced.normals * outwards).sum(axis=1), 0.02) > 0.95


def test_texture_coordinates_survive_reduction_and_the_seam_stays_closed() -> None:
    u, v = np.meshgrid(np.linspace(0, 1, 161), np.linspace(0, 1, 81))
    radius = 1 + 0.05 * np.sin(16 * np.pi * u) * np.sin(np.pi * v) ** 2
    x, y = (
        radius * np.sin(np.pi * v) * np.cos(2 * np.pi * u),
        radius * np.sin(np.pi * v) * np.sin(2 * np.pi * u),
    )
    points = np.stack([x, y, radius * np.cos(np.pi * v)], -1).reshape(-1, 3).astype(np.float32)
    i = np.arange(80 * 160)
    a = i // 160 * 161 + i % 160
    faces = np.concatenate([np.stack([a, a + 161, a + 1], 1), np.stack([a + 1, a + 161, a + 162], 1)])
    mesh = Mesh(points, faces.astype(np.uint32), uvs=np.stack([u, v], -1).reshape(-1, 2).astype(np.float32))
    reduced = reduce_mesh(mesh, 3000)
    assert len(reduced.faces) <= 3000 and reduced.uvs is not None
    p = reduced.vertices
    true_v = np.arccos(p[:, 2] / np.linalg.norm(p, axis=1)) / np.pi
    away = (true_v > 0.05) & (true_v < 0.95)  # at a pole u is arbitrary
    error = np.abs(reduced.uvs[:, 0] - np.arctan2(p[:, 1], p[:, 0]) / (2 * np.pi) % 1)[away]
    assert np.minimum(error, 1 - error).max() < 0.03
    np.testing.assert_allclose(reduced.uvs[:, 1], true_v, atol=0.03)
    # No face may cross the seam, where u jumps from 1 to 0.
    assert np.ptp(reduced.uvs[reduced.faces, 0], axis=1).max() < 0.5


@settings(max_examples=50)
@given(
    arrays(np.float32, (30, 3), elements=st.floats(-10, 10, width=32)),
    arrays(np.uint32, (60, 3), elements=st.integers(0, 29)),
    st.integers(1, 100),
)
def test_any_triangles_give_a_valid_mesh(points: NDArray, faces: NDArray, limit: int) -> None:
    """Files contain degenerate and duplicate faces, unused vertices and coincident points."""
    for mesh in (reduce_mesh(with_normals(Mesh(points, faces)), limit), with_normals(Mesh(points, faces))):
        assert len(mesh.faces) and mesh.faces.max() < len(mesh.vertices)
        assert np.isfinite(mesh.vertices).all() and mesh.normals is not None
        np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=1e-3)
        assert (mesh.vertices >= points.min(0) - 1.0).all() and (mesh.vertices <= points.max(0) + 1.0).all()


def grid(width: int, uv: NDArray | None = None) -> Mesh:
    x, y = np.meshgrid(np.arange(width + 1.0), np.arange(width + 1.0))
    points = np.stack([x, y, np.full_like(x, -0.9)], -1).reshape(-1, 3).astype(np.float32)
    i = np.arange(width * width)
    a = i // width * (width + 1) + i % width
    faces = np.concatenate(
        [np.stack([a, a + 1, a + width + 1], 1), np.stack([a + 1, a + width + 2, a + width + 1], 1)]
    )
    return Mesh(
        points, faces.astype(np.uint32), uvs=None if uv is None else (points[:, :2] @ uv).astype(np.float32)
    )


@pytest.mark.parametrize("turned", [False, True])
def test_a_flat_grid_becomes_two_triangles_with_the_same_texture(turned: bool) -> None:
    mesh = grid(20, np.array([[0.25, 0.1], [0.0, -0.5]]))
    faces = mesh.faces[:, ::-1] if turned else mesh.faces
    flat = flat_rectangle(Mesh(mesh.vertices, faces, uvs=mesh.uvs))
    assert flat is not None and len(flat.faces) == 2
    assert flat.normals is not None and flat.uvs is not None
    assert (flat.normals == [0, 0, -1 if turned else 1]).all()
    np.testing.assert_allclose(flat.uvs, flat.vertices[:, :2] @ [[0.25, 0.1], [0.0, -0.5]], atol=1e-4)
    corner = flat.vertices[flat.faces].astype(float)
    across = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    np.testing.assert_allclose(across[:, 2], -400 if turned else 400, rtol=1e-5)


def test_only_plain_rectangles_become_two_triangles() -> None:
    bent = grid(20)
    bent.vertices[5, 2] += 0.1
    assert flat_rectangle(bent) is None
    holed = grid(20)
    assert flat_rectangle(Mesh(holed.vertices, holed.faces[:-1])) is None
    swirled = grid(20, np.eye(2))
    assert swirled.uvs is not None
    swirled.uvs[7] += 0.2
    assert flat_rectangle(swirled) is None
    assert flat_rectangle(soup(trimesh.creation.box())) is None


def test_vertices_are_shared_where_place_normal_and_texture_agree() -> None:
    up, tilted = [0.0, 0.0, 1.0], [0.0, np.sin(0.1), np.cos(0.1)]
    places = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]] * 4, np.float32)
    normals = np.array([up] * 9 + [tilted] * 3, np.float32)
    uvs = np.array(
        [[0, 0], [1, 0], [0, 1]] * 2 + [[0.5, 0], [1, 0], [0, 1]] + [[0, 0], [1, 0], [0, 1]], np.float32
    )
    faces = np.arange(12, dtype=np.uint32).reshape(-1, 3)
    shared = share_vertices(Mesh(places, faces, normals, uvs))
    assert len(shared.vertices) == 3 + 1 + 3, "one other corner in the texture, three other normals"
    assert shared.normals is not None and shared.uvs is not None
    for now, was in ((shared.vertices, places), (shared.normals, normals), (shared.uvs, uvs)):
        np.testing.assert_array_equal(now[shared.faces], was[faces])
    assert len(share_vertices(Mesh(places, faces)).vertices) == 3


def test_normals_are_sharp_at_the_edges_of_a_box_and_keep_the_texture() -> None:
    box = trimesh.creation.box((1, 2, 3))
    uvs = np.arange(16, dtype=np.float32).reshape(8, 2)
    made = with_normals(Mesh(np.asarray(box.vertices, np.float32), np.asarray(box.faces, np.uint32), uvs=uvs))
    assert len(made.vertices) == 24 and made.normals is not None and made.uvs is not None
    np.testing.assert_allclose(made.normals[made.faces[:, 0]], box.face_normals, atol=1e-6)
    np.testing.assert_allclose(made.normals[made.faces[:, 2]], box.face_normals, atol=1e-6)
    np.testing.assert_array_equal(made.vertices[made.faces], box.vertices[box.faces].astype(np.float32))
    np.testing.assert_array_equal(made.uvs[made.faces], uvs[box.faces])


@pytest.mark.parametrize("size", [0.003, 40.0])
def test_rounding_moves_little_and_keeps_a_flat_axis(size: float) -> None:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=size)
    points = np.asarray(ball.vertices, np.float32)
    points[:, 2] = 0.1234567
    mesh = Mesh(points, np.asarray(ball.faces, np.uint32), np.asarray(ball.vertex_normals, np.float32))
    less = rounded(mesh)
    off = np.abs(less.vertices - points)
    assert off[:, 2].max() == 0 and 0 < off.max() <= 2 * size / 4096
    assert less.normals is not None and mesh.normals is not None
    agreement = (less.normals * mesh.normals).sum(axis=1) / np.linalg.norm(less.normals, axis=1)
    assert agreement.min() > np.cos(np.deg2rad(1.5)) and len(np.unique(less.normals)) < len(
        np.unique(mesh.normals)
    )


def test_pieces_in_one_cell_of_a_grid_grow_together() -> None:
    balls = [trimesh.creation.icosphere(subdivisions=2, radius=0.01) for _ in range(6)]
    for number, ball in enumerate(balls):
        ball.apply_translation((0.2 * (number % 2), 0.2 * (number // 2 % 2), 0.2 * (number // 4)))
    whole = trimesh.util.concatenate(balls)
    mesh = Mesh(np.asarray(whole.vertices, np.float32), np.asarray(whole.faces, np.uint32))  # type: ignore[union-attr]
    fine, coarse = cluster_mesh(mesh, 10_000, 200), cluster_mesh(mesh, 10_000, 24)
    assert len(mesh.faces) >= len(fine.faces) > 3 * len(coarse.faces) > 0
    for made, cells in ((fine, 200), (coarse, 24)):
        distance, _ = KDTree(mesh.vertices).query(made.vertices)
        assert np.max(distance) < 0.22 / cells
    assert len(cluster_mesh(mesh, 40, 200).faces) < 0.5 * len(fine.faces)
    assert cluster_mesh(mesh, 40, 1) is mesh, "nothing would be left"
