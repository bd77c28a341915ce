"""Reduced meshes and their disk cache."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from workbench.envs.scene.mesh_levels import (
    are_known,
    cached_reduced_mesh,
    deviation,
    from_afar,
    levels_of,
    within,
)
from workbench.envs.scene.shapes import Mesh


def test_a_reduced_mesh_is_cached_and_a_corrupt_file_is_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    sphere = trimesh.creation.icosphere(subdivisions=4)
    mesh = Mesh(
        sphere.vertices.astype(np.float32), sphere.faces.astype(np.uint32), sphere.vertices.astype(np.float32)
    )
    reduced = cached_reduced_mesh(mesh, 400)
    assert 200 < len(reduced.faces) <= 800
    assert np.abs(np.linalg.norm(reduced.vertices, axis=1) - 1).max() < 0.05
    assert reduced.normals is not None
    np.testing.assert_allclose(np.linalg.norm(reduced.normals, axis=1), 1, atol=0.02)
    (file,) = tmp_path.rglob("*.npz")
    written = file.read_bytes()
    for content in (written, b"no file of ours", b""):
        file.write_bytes(content)
        again = cached_reduced_mesh(mesh, 400)
        np.testing.assert_array_equal(again.vertices, reduced.vertices)
        np.testing.assert_array_equal(again.faces, reduced.faces)
        np.testing.assert_array_equal(again.normals, reduced.normals)
    assert cached_reduced_mesh(mesh, 100) is not None and len(list(tmp_path.rglob("*.npz"))) == 2


def test_a_distant_mesh_has_few_triangles_near_the_surface_and_is_cached(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    # Small separate parts, such as screws, which edge collapse alone would keep.
    balls = [trimesh.creation.icosphere(subdivisions=2, radius=0.004) for _ in range(15)]
    for number, ball in enumerate(balls):
        ball.apply_translation((0.1 * np.cos(number), 0.1 * np.sin(number), 0.0))
    solid: Any = trimesh.util.concatenate([trimesh.creation.icosphere(subdivisions=3, radius=0.1), *balls])
    mesh = Mesh(solid.vertices.astype(np.float32), solid.faces.astype(np.uint32))
    counts = [len(from_afar(mesh, error).faces) for error in (0.01, 0.03)]
    assert len(mesh.faces) > 5 * counts[0] > 5 * counts[1] > 0
    assert deviation(mesh, from_afar(mesh, 0.01)) <= 0.01
    assert len(list(tmp_path.rglob("*.npz"))) == 2
    assert from_afar(mesh, 0.0) is mesh


def test_simple_and_textured_meshes_are_not_reduced_for_distance() -> None:
    disc = trimesh.creation.cylinder(0.1, 0.0005, sections=32)
    thin = Mesh(disc.vertices.astype(np.float32), disc.faces.astype(np.uint32))
    assert from_afar(thin, 0.1) is thin
    ball = trimesh.creation.icosphere(subdivisions=3)
    uvs = np.zeros((len(ball.vertices), 2), np.float32)
    textured = Mesh(ball.vertices.astype(np.float32), ball.faces.astype(np.uint32), uvs=uvs)
    assert from_afar(textured, 0.1) is textured


def test_levels_have_ever_fewer_triangles_and_the_distance_that_they_claim(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    solid = trimesh.creation.icosphere(subdivisions=3, radius=0.137)
    mesh = Mesh(solid.vertices.astype(np.float32), solid.faces.astype(np.uint32))
    assert not are_known(mesh)
    levels = levels_of(mesh)
    counts = [len(level.mesh.faces) for level in levels]
    errors = [level.error for level in levels]
    assert len(levels) >= 3 and counts == sorted(counts, reverse=True) and counts[0] < len(mesh.faces)
    assert errors == sorted(errors) and 0 < errors[0] < errors[-1]
    for level in levels:
        assert deviation(mesh, level.mesh) <= level.error * 1.001
    assert are_known(mesh) and levels_of(mesh) is levels
    for level, finer in zip(levels, (None, *levels), strict=False):
        assert within(mesh, level.error) is level.mesh
        assert within(mesh, level.error * 0.999) is (mesh if finer is None else finer.mesh)
    with_normals = Mesh(mesh.vertices, mesh.faces, mesh.vertices / np.float32(0.137))
    textured = Mesh(mesh.vertices, mesh.faces, uvs=np.zeros((len(mesh.vertices), 2), np.float32))
    assert not are_known(with_normals) and not are_known(textured)
    flat = Mesh(mesh.vertices * [1, 1, 0], mesh.faces)
    assert deviation(mesh, flat) == pytest.approx(0.137, rel=0.05) and deviation(flat, mesh) > 0
    assert deviation(mesh, mesh) == pytest.approx(0, abs=2e-3)
