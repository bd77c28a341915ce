"""Reduced meshes keep their shape, their edges and their texture."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from workbench.envs.scene.normals import with_normals
from workbench.envs.scene.shapes import Mesh
from workbench.envs.scene.simplify import flat_rectangle, reduce_mesh


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
