"""Normals are sharp at edges and smooth elsewhere; reduced meshes are shaded like the full mesh."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray

from workbench.envs.scene.normals import ShadedSurface, with_normals
from workbench.envs.scene.shapes import Mesh


def shared(mesh: trimesh.Trimesh) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    return np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.uint32)


def strip(x: NDArray, z: NDArray, tilt: NDArray) -> Mesh:
    """Extrude a profile (x, z) along y, with normals tilted from +z towards +x by `tilt` radians."""
    count, k = len(x), np.arange(len(x) - 1)
    points = np.concatenate([np.stack([x, np.full(count, y), z], axis=1) for y in (-1.0, 1.0)])
    normals = np.tile(np.stack([np.sin(tilt), np.zeros(count), np.cos(tilt)], axis=1), (2, 1))
    faces = np.concatenate(
        [np.stack([k, k + 1, k + count], 1), np.stack([k + 1, k + count + 1, k + count], 1)]
    )
    return Mesh(points.astype(np.float32), faces.astype(np.uint32), normals.astype(np.float32))


def tile() -> Mesh:
    """A strip that is flat for a length of 1 and then bends down by 30 degrees over a length of 0.1."""
    bend = np.linspace(0, np.deg2rad(30), 20)
    x, z = 1 + 0.2 * np.sin(bend), 0.2 * np.cos(bend) - 0.2
    return strip(np.concatenate([[0, 0.5], x]), np.concatenate([[0, 0], z]), np.concatenate([[0, 0], bend]))


def simple_tile() -> Mesh:
    """`tile` reduced to two flat faces that meet in the middle of the bend."""
    x, _, z = tile().vertices[[0, 12, 21]].T
    flat = strip(x, z, np.zeros(3))
    return with_normals(Mesh(flat.vertices, flat.faces))


def degrees_from_up(mesh: Mesh) -> NDArray[np.float64]:
    assert mesh.normals is not None
    return np.rad2deg(np.arccos(np.minimum(mesh.normals[:, 2], 1)))


def test_a_flat_face_next_to_a_bend_is_shaded_flat() -> None:
    """The surface is tilted by 15 degrees at the face's end and must not tilt the shading of the whole face."""
    exact, simple = tile(), simple_tile()
    assert len(simple.faces) == 4
    shaded = ShadedSurface(exact).shade(simple)
    off = degrees_from_up(shaded)
    end = np.isclose(shaded.vertices[:, 0], exact.vertices[12, 0])
    assert off[shaded.vertices[:, 0] < 0.5].max() < 2
    assert off[end].max() < 5
    assert off[shaded.vertices[:, 0] > 1.09].min() > 20


def test_a_ball_of_few_triangles_is_shaded_round() -> None:
    fine, coarse = (trimesh.creation.icosphere(subdivisions=n) for n in (5, 1))
    shaded = ShadedSurface(Mesh(*shared(fine), np.asarray(fine.vertices, np.float32))).shade(
        with_normals(Mesh(*shared(coarse)))
    )
    assert shaded.normals is not None and len(shaded.vertices) == len(coarse.vertices)
    assert (shaded.normals * shaded.vertices).sum(axis=1).min() > 0.998
