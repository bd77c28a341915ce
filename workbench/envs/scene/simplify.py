"""Mesh simplification, so that a robot fits into a browser."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import fast_simplification
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from workbench.envs.scene.normals import ShadedSurface, with_normals
from workbench.envs.scene.shapes import Mesh

_DENSE_FACES = 60_000
"""A mesh with more faces counts as a CAD assembly: its vertices are first snapped to a grid, because quadric
collapse alone would take seconds and get stuck."""
_CLUSTER_CELLS = 64
_COARSEST_CELLS = 16
_WELD_CELLS = 1_000_000
_MAX_PIECES = 200
_MIN_FACES = 24
_SLOW_GROWTH, _USUAL_GROWTH = 3, 7
"""Growth of the collapse threshold (the method's ``agg``): the slower, the more cheap edges collapse before
costly ones."""


def reduce_mesh(mesh: Mesh, max_faces: int) -> Mesh:
    """`mesh` with about `max_faces` triangles; `mesh` itself if it has no more than `max_faces`.

    ManiSkill's Panda has 136,000 triangles and its wrist camera 425,000; a browser that draws in software
    manages some 200,000 in all. Quadric edge collapse (fast_simplification, Garland and Heckbert) does not
    move borders, and where every triangle has its own three vertices, as exporters write them, all edges are
    borders. So vertices at one place are welded first (in a textured mesh only if their uvs agree), and
    normals are computed again, sharp at edges and smooth elsewhere.

    A mesh of many loose pieces may keep up to twice `max_faces` triangles. A textured mesh may keep even
    more, because the borders of the pieces of its texture stay.
    """
    reduced = collapse_mesh(mesh, max_faces)
    if reduced is mesh:
        return mesh
    if mesh.normals is None or len(mesh.faces) > _DENSE_FACES:
        return share_vertices(reduced)
    return ShadedSurface(mesh).shade(reduced)


def collapse_mesh(mesh: Mesh, max_faces: int) -> Mesh:
    """Like `reduce_mesh`, with normals computed from the faces of the result."""
    if len(mesh.faces) <= max_faces or not np.ptp(mesh.vertices, axis=0).any():
        return mesh
    cells = _WELD_CELLS if mesh.uvs is not None or len(mesh.faces) <= _DENSE_FACES else _CLUSTER_CELLS
    welded = _weld(mesh.vertices, mesh.faces, mesh.uvs, cells)
    while True:
        vertices, faces, uvs = welded
        if len(faces) > max_faces:
            vertices, faces, uvs = _collapse(vertices, faces, uvs, max_faces)
        # Hundreds of loose pieces (screws, vents) cannot shrink; only a coarser grid joins them.
        if len(faces) <= 2 * max_faces or mesh.uvs is not None or cells <= _COARSEST_CELLS:
            break
        cells = min(int(0.7 * cells), _CLUSTER_CELLS)
        welded = _weld(*welded, cells)
    if len(faces) == 0:
        return mesh
    return with_normals(Mesh(vertices.astype(np.float32), faces.astype(np.uint32), uvs=uvs))


def coarsen_mesh(mesh: Mesh, max_faces: int, by_pieces: bool = False) -> Mesh:
    """`mesh` with about `max_faces` triangles, or more if so few cannot keep the shape. Slower than
    `reduce_mesh`, and nearer to the surface of `mesh`; the normals are computed from the faces of the result.

    Args:
        by_pieces: collapse each connected piece by itself, so that small pieces are not lost.
    """
    vertices, faces, uvs = _weld(mesh.vertices, mesh.faces, mesh.uvs, _WELD_CELLS)
    if len(faces) > max_faces:
        how = "by pieces" if by_pieces else "as a whole"
        vertices, faces, uvs = _collapse(vertices, faces, uvs, max_faces, how)
    if len(faces) == 0:
        return mesh
    return with_normals(Mesh(vertices.astype(np.float32), faces.astype(np.uint32), uvs=uvs))


def cluster_mesh(mesh: Mesh, max_faces: int, cells: int) -> Mesh:
    """`mesh`, without texture, with about `max_faces` triangles: merges the vertices in each cell of a grid.
    The normals are computed from the faces of the result.

    Loose pieces grow together, and details smaller than a cell are lost: for objects that are seen from afar.

    Args:
        cells: number of grid cells along the longest axis.
    """
    vertices, faces, _ = _weld(mesh.vertices, mesh.faces, None, cells)
    if len(faces) > max_faces:
        vertices, faces, _ = _collapse(vertices, faces, None, max_faces)
    if len(faces) == 0:
        return mesh
    return with_normals(Mesh(vertices.astype(np.float32), faces.astype(np.uint32)))


def share_vertices(mesh: Mesh) -> Mesh:
    """`mesh` with equal vertices merged: exporters give every triangle its own three. Normals that differ by up to half a
    degree count as equal."""
    rows = [np.ascontiguousarray(mesh.vertices)]
    if mesh.normals is not None:
        rows.append(np.round(mesh.normals, 2).astype(np.float32) + np.float32(0))
    if mesh.uvs is not None:
        rows.append(mesh.uvs)
    _, first, inverse = np.unique(
        np.concatenate(rows, axis=1), axis=0, return_index=True, return_inverse=True
    )
    return Mesh(
        mesh.vertices[first],
        inverse.reshape(-1)[mesh.faces].astype(np.uint32),
        None if mesh.normals is None else mesh.normals[first],
        None if mesh.uvs is None else mesh.uvs[first],
    )


def rounded(mesh: Mesh) -> Mesh:
    """`mesh` with positions on a grid of some 4000 cells along each axis, and normals turned by up to 1
    degree.

    In compressed files the rounded numbers take two thirds of the space.
    """
    extent = np.ptp(mesh.vertices, axis=0)
    cell = np.exp2(np.floor(np.log2(np.where(extent > 0, extent, 1.0) / 4096)))
    on_grid = (np.round(mesh.vertices / cell) * cell).astype(np.float32)
    # Keep the positions along an axis on which the mesh is flat.
    vertices = np.where(extent > 0, on_grid, mesh.vertices)
    normals = None if mesh.normals is None else (np.round(mesh.normals * 48) / 48).astype(np.float32)
    return replace(mesh, vertices=vertices, normals=normals)


def flat_rectangle(mesh: Mesh) -> Mesh | None:
    """`mesh` as two triangles, or None if it is not a flat rectangle. ManiSkill's floor is a grid of 100 x 100 squares.

    Finds only rectangles along the axes of the mesh's own frame, of one layer, with uv linear in position.
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
    """Merge vertices in one cell of a grid (with the same uv); drop faces that vanish."""
    extent = float(np.ptp(vertices, axis=0).max()) or 1.0
    grid = np.round((vertices - vertices.min(axis=0)) / extent * cells).astype(np.int64)
    key = (grid[:, 0] << 42) | (grid[:, 1] << 21) | grid[:, 2]
    if uvs is not None:
        texel = np.round(uvs.astype(np.float64) * 8192).astype(np.int64)
        key = np.unique(np.column_stack([key, texel]), axis=0, return_inverse=True)[1].reshape(-1)
    _, first, inverse = np.unique(key, return_index=True, return_inverse=True)
    welded = inverse.reshape(-1)[faces]
    if cells < _WELD_CELLS:
        # Drop duplicates: surfaces that coincide on a coarse grid would flicker.
        welded = welded[np.sort(np.unique(np.sort(welded, axis=1), axis=0, return_index=True)[1])]
    whole = (welded[:, 0] != welded[:, 1]) & (welded[:, 1] != welded[:, 2]) & (welded[:, 2] != welded[:, 0])
    return vertices[first], welded[whole], None if uvs is None else uvs[first]


def _collapse(
    vertices: NDArray[np.float32],
    faces: NDArray[np.int64],
    uvs: NDArray[np.float32] | None,
    max_faces: int,
    how: Literal["fast", "as a whole", "by pieces"] = "fast",
) -> tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.float32] | None]:
    # The method's thresholds are absolute: unscaled, a mesh of a few centimetres would collapse in any order.
    extent = float(np.ptp(vertices, axis=0).max())
    points = vertices.astype(np.float64) / extent
    triangles = np.ascontiguousarray(faces, dtype=np.int32)
    if uvs is None:
        if how == "as a whole":
            new_points, new_faces = _collapse_whole(points, triangles, max_faces)
        else:
            growth = _USUAL_GROWTH if how == "fast" else _SLOW_GROWTH
            new_points, new_faces = _collapse_pieces(points, triangles, max_faces, growth)
        # The optimum of a nearly singular quadric can be anywhere, and would be a spike out of the surface.
        distance, nearest = (np.asarray(x) for x in KDTree(points).query(new_points))
        spike = distance > 0.04
        new_points[spike] = points[nearest[spike]]
        return (new_points * extent).astype(np.float32), new_faces, None
    # The edge of a piece of texture is a border of the welded mesh: moving it would open a gap.
    collapses = fast_simplification.simplify(
        points,
        triangles,
        target_count=max_faces,
        agg=_USUAL_GROWTH if how == "fast" else _SLOW_GROWTH,
        return_collapses=True,
        preserve_border=True,
    )[-1]
    new_points, new_faces, new_index = fast_simplification.replay_simplification(points, triangles, collapses)
    # Each new vertex takes the uv of the nearest old vertex.
    order = np.argsort(-np.linalg.norm(points - new_points[new_index], axis=1), kind="stable")
    new_uvs = np.zeros((len(new_points), 2), dtype=np.float32)
    new_uvs[new_index[order]] = uvs[order]
    return (new_points * extent).astype(np.float32), new_faces.astype(np.int64), new_uvs


def _collapse_whole(
    points: NDArray[np.float64], faces: NDArray[np.int32], max_faces: int
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    # The quadric error of losing a flat lid is zero, unless the lid's border is kept. So borders may collapse
    # only if there are too many faces otherwise.
    new_points, new_faces = points, faces
    for growth, keep_borders in ((_SLOW_GROWTH, True), (_SLOW_GROWTH, False), (_USUAL_GROWTH, False)):
        new_points, new_faces = fast_simplification.simplify(
            points, faces, target_count=max_faces, agg=growth, preserve_border=keep_borders
        )[:2]
        if len(new_faces) <= 1.1 * max_faces:
            break
    return new_points, new_faces.astype(np.int64)


def _collapse_pieces(
    points: NDArray[np.float64], faces: NDArray[np.int32], max_faces: int, growth: int
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Collapse each connected piece by itself, to a share of the triangles in proportion to its area.

    The quadric error of losing a flat disc is zero: in a collapse of a whole round housing, its lid would
    vanish first.
    """
    count = len(points)
    edges = coo_matrix(
        (np.ones(2 * len(faces)), (faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel())), (count, count)
    )
    pieces, label = connected_components(edges, directed=False)
    label = label[faces[:, 0]]
    corner = points[faces]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    share = np.bincount(label, area, minlength=pieces) / max(area.sum(), 1e-20)
    new_points, new_faces, used = [], [], 0
    for piece in np.unique(label) if pieces <= _MAX_PIECES else [None]:
        own = faces if piece is None else faces[label == piece]
        target = max_faces if piece is None else max(_MIN_FACES, int(share[piece] * max_faces))
        index, flat = np.unique(own, return_inverse=True)
        vertices, triangles = points[index], flat.reshape(-1, 3).astype(np.int32)
        if len(triangles) > target:
            simpler = fast_simplification.simplify(vertices, triangles, target_count=target, agg=_SLOW_GROWTH)
            if growth > _SLOW_GROWTH and len(simpler[1]) > 1.2 * target:
                simpler = fast_simplification.simplify(vertices, triangles, target_count=target, agg=growth)
            vertices, triangles = simpler[0], simpler[1]
        new_points.append(vertices)
        new_faces.append(triangles.astype(np.int64) + used)
        used += len(vertices)
    return np.concatenate(new_points), np.concatenate(new_faces)
