"""Fewer triangles that look the same: what makes a robot fit into a browser.

The Panda that ManiSkill ships has 136,000 triangles, the camera on its wrist 425,000; a browser that
draws in software manages some 200,000 in all. Most of those triangles are far smaller than a pixel.
Quadric edge collapse (fast_simplification, Garland and Heckbert's method) takes them out, if the mesh is
first made whole: exporters write every triangle with three vertices of its own, and an edge that no
two triangles share is a border that the method will not move. So vertices at one place are welded,
the mesh is reduced, and normals are made anew, sharp where the surface has an edge and smooth
elsewhere. A texture's seams must stay seams: there, vertices are welded only where the uv agrees.

A floor is another case. ManiSkill builds it as a hundred by hundred grid of squares; a flat rectangle
whose uv is linear looks exactly the same as two triangles.
"""

from __future__ import annotations

from dataclasses import replace

import fast_simplification
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from workbench.core.geometry import Mesh

_CREASE_COSINE = float(np.cos(np.deg2rad(40.0)))
"""Neighbouring faces that bend less than this are shaded as one smooth surface."""
_DENSE = 60_000
"""Above so many faces a mesh is a whole CAD assembly: what is inside is left out, and vertices are
snapped to a grid first, where quadric collapse alone would take seconds."""
_CLUSTER_CELLS = 400
_WELD_CELLS = 1_000_000
_COARSEST_CELLS = 25


def reduce_mesh(mesh: Mesh, max_faces: int) -> Mesh:
    """`mesh` with about `max_faces` triangles at most; as it is when it has no more than that.

    A textured mesh may stay above: the edges of its pieces of texture are kept as they are.
    """
    if len(mesh.faces) <= max_faces:
        return mesh
    cells, source = _WELD_CELLS, mesh.faces
    if len(mesh.faces) > _DENSE and mesh.uvs is None:
        cells, source = _CLUSTER_CELLS, mesh.faces[_seen_from_outside(mesh)]
    vertices, faces, uvs = _weld(mesh.vertices, source, mesh.uvs, cells)
    while len(faces) > max_faces:
        count = len(faces)
        vertices, faces, uvs = _collapse(vertices, faces, uvs, max_faces)
        if len(faces) <= max_faces * 1.1 or mesh.uvs is not None:
            break
        if len(faces) > 0.7 * count:
            # Hundreds of loose pieces (screws, vents) that cannot shrink: only a coarser grid joins them.
            cells = min(cells, _CLUSTER_CELLS) // 2
            if cells < _COARSEST_CELLS:
                break
            vertices, faces, uvs = _weld(vertices, faces, uvs, cells)
    if len(faces) == 0:
        return mesh
    return with_normals(Mesh(vertices.astype(np.float32), faces.astype(np.uint32), uvs=uvs))


def with_normals(mesh: Mesh) -> Mesh:
    """`mesh` with normals made from its faces: smooth, but sharp at edges of more than 40 degrees.

    Vertices are split where faces that meet there get different normals.
    """
    corners = mesh.faces.reshape(-1).astype(np.int64)
    triangles = mesh.vertices[mesh.faces].astype(np.float64)
    weighted = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    length = np.linalg.norm(weighted, axis=1, keepdims=True)
    unit = weighted / np.maximum(length, 1e-20)

    # Every pair (a, b) of corners that share a vertex: b's face counts for a's normal if it bends
    # little against a's face.
    order = np.argsort(corners, kind="stable")
    counts = np.bincount(corners, minlength=len(mesh.vertices))
    start = np.concatenate([[0], np.cumsum(counts)])[:-1]
    sharing = counts[corners[order]]
    a = np.repeat(order, sharing)
    step = np.arange(len(a)) - np.repeat(np.cumsum(sharing) - sharing, sharing)
    b = order[np.repeat(start[corners[order]], sharing) + step]
    smooth = np.einsum("ij,ij->i", unit[a // 3], unit[b // 3]) >= _CREASE_COSINE
    normals = np.stack(
        [np.bincount(a[smooth], weighted[b[smooth] // 3, k], minlength=len(corners)) for k in range(3)], axis=1
    )
    # A face without area sums to nothing, and a zero normal is drawn black.
    empty = np.linalg.norm(normals, axis=1) < 1e-20
    normals[empty] = [0.0, 0.0, 1.0]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)

    key = np.concatenate([corners[:, None], np.round(normals * 64).astype(np.int64)], axis=1)
    _, first, inverse = np.unique(key, axis=0, return_index=True, return_inverse=True)
    chosen = corners[first]
    return Mesh(
        vertices=mesh.vertices[chosen],
        faces=inverse.reshape(-1, 3).astype(np.uint32),
        normals=normals[first].astype(np.float32),
        uvs=None if mesh.uvs is None else mesh.uvs[chosen],
    )


def flat_rectangle(mesh: Mesh) -> Mesh | None:
    """The same rectangle as two triangles, or None if `mesh` is not one.

    Only rectangles along the axes of the mesh's own frame, one layer, with uv linear in position.
    """
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    extent = high - low
    normal_axis = int(np.argmin(extent))
    u, v = [axis for axis in range(3) if axis != normal_axis]
    if extent[normal_axis] > 1e-5 * max(extent[u], extent[v]) or min(extent[u], extent[v]) <= 0:
        return None
    triangles = mesh.vertices[mesh.faces].astype(np.float64)
    areas = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])[:, normal_axis] / 2
    side = np.sign(areas.sum())
    if side == 0 or (np.sign(areas) == -side).any():
        return None
    if abs(abs(areas.sum()) - extent[u] * extent[v]) > 1e-4 * extent[u] * extent[v]:
        return None
    corners = np.tile(low, (4, 1))
    corners[[1, 2], u] = high[u]
    corners[[2, 3], v] = high[v]
    uvs = None
    if mesh.uvs is not None:
        at = np.column_stack([mesh.vertices[:, [u, v]], np.ones(len(mesh.vertices))]).astype(np.float64)
        linear = np.linalg.lstsq(at, mesh.uvs.astype(np.float64), rcond=None)[0]
        if np.abs(at @ linear - mesh.uvs).max() > 1e-3:
            return None
        uvs = (np.column_stack([corners[:, [u, v]], np.ones(4)]) @ linear).astype(np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.uint32)
    across = np.cross(corners[1] - corners[0], corners[3] - corners[0])[normal_axis]
    if np.sign(across) != side:
        faces = faces[:, ::-1].copy()
    normals = np.zeros((4, 3), dtype=np.float32)
    normals[:, normal_axis] = side
    return Mesh(corners.astype(np.float32), faces, normals, uvs)


def drop_uvs(mesh: Mesh) -> Mesh:
    """`mesh` without texture coordinates, for a material that has no texture."""
    return mesh if mesh.uvs is None else replace(mesh, uvs=None)


def _weld(
    vertices: NDArray[np.float32], faces: NDArray, uvs: NDArray[np.float32] | None, cells: int
) -> tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.float32] | None]:
    """One vertex for all that lie in one cell of a grid (and have one uv); faces that vanish are dropped."""
    extent = float(np.ptp(vertices, axis=0).max()) or 1.0
    grid = np.round((vertices - vertices.min(axis=0)) / extent * cells).astype(np.int64)
    key = (grid[:, 0] << 42) | (grid[:, 1] << 21) | grid[:, 2]
    if uvs is not None:
        texel = np.round(uvs.astype(np.float64) * 8192).astype(np.int64)
        key = np.unique(np.column_stack([key, texel]), axis=0, return_inverse=True)[1].reshape(-1)
    _, first, inverse = np.unique(key, return_index=True, return_inverse=True)
    welded = inverse.reshape(-1)[faces]
    whole = (welded[:, 0] != welded[:, 1]) & (welded[:, 1] != welded[:, 2]) & (welded[:, 2] != welded[:, 0])
    return vertices[first], welded[whole], None if uvs is None else uvs[first]


def _seen_from_outside(mesh: Mesh) -> NDArray[np.bool_]:
    """(F,) False for faces that others hide from 26 directions: screws and boards in a camera's housing.

    A depth image of the faces' centres, of 256 cells a side, for each direction.
    """
    centres = mesh.vertices[mesh.faces].mean(axis=1)
    cell = float(np.ptp(centres, axis=0).max()) / 256
    seen = np.zeros(len(centres), dtype=bool)
    for direction in np.stack(np.meshgrid(*3 * [[-1.0, 0.0, 1.0]]), axis=-1).reshape(-1, 3):
        if not direction.any():
            continue
        forward = direction / np.linalg.norm(direction)
        right = np.cross(forward, np.eye(3)[np.argmin(np.abs(forward))])
        right /= np.linalg.norm(right)
        at = centres @ np.stack([right, np.cross(forward, right), forward], axis=1)
        pixel = np.round((at[:, :2] - at[:, :2].min(axis=0)) / cell).astype(np.int64)
        number = pixel[:, 0] * (pixel[:, 1].max() + 1) + pixel[:, 1]
        nearest = np.full(number.max() + 1, np.inf)
        np.minimum.at(nearest, number, at[:, 2])
        seen |= at[:, 2] <= nearest[number] + 2 * cell
    return seen


def _collapse(
    vertices: NDArray[np.float32],
    faces: NDArray[np.int64],
    uvs: NDArray[np.float32] | None,
    max_faces: int,
) -> tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.float32] | None]:
    points = vertices.astype(np.float64)
    triangles = np.ascontiguousarray(faces, dtype=np.int32)
    if uvs is None:
        new_points, new_faces = fast_simplification.simplify(points, triangles, target_count=max_faces)
        # Where a quadric is nearly singular its optimum can lie anywhere: a spike out of the surface.
        distance, nearest = cKDTree(points).query(new_points)
        spike = distance > 0.04 * np.ptp(points, axis=0).max()
        new_points[spike] = points[nearest[spike]]
        return new_points.astype(np.float32), new_faces.astype(np.int64), None
    # The edge of a piece of texture is a border of the welded mesh; moved, it would open a gap.
    _, _, collapses = fast_simplification.simplify(
        points, triangles, target_count=max_faces, return_collapses=True, preserve_border=True
    )
    new_points, new_faces, new_index = fast_simplification.replay_simplification(points, triangles, collapses)
    # The old vertex that lies nearest to where its group ended up lends its uv.
    order = np.argsort(-np.linalg.norm(points - new_points[new_index], axis=1), kind="stable")
    new_uvs = np.zeros((len(new_points), 2), dtype=np.float32)
    new_uvs[new_index[order]] = uvs[order]
    return new_points.astype(np.float32), new_faces.astype(np.int64), new_uvs
