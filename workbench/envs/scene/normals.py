"""Computes normals of a mesh: from its faces, or so that a simplified mesh is shaded like the exact one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import cg
from scipy.spatial import KDTree

from workbench.envs.scene.shapes import Mesh

_CREASE_COSINE = float(np.cos(np.deg2rad(40.0)))
"""Cosine of the angle (40 degrees) below which neighbouring faces are shaded as one smooth surface."""
_EXACT_POINTS = 2_000, 10, 20_000
"""Points sampled on an exact surface by area, in addition to one on each triangle: a constant, a number per triangle,
and the limit of their sum."""
_COARSE_POINTS = 2_000
"""Points sampled on a coarse surface by area, in addition to some on each triangle."""
_NEIGHBOURS = 8
"""Number of nearest points on the exact surface that are searched for one that faces the same way."""
_MIN_FACING_COSINE = 0.3
_SHARED_DEGREES = 20.0
"""Faces of a coarse mesh share one normal at a vertex if their normals there differ by less than this.
Sharing saves a seventh of the vertices, and makes the shading error a twentieth larger."""
_OWN_WEIGHT = 0.02
"""Weight of a vertex's own normal, relative to the normals of the exact surface around it. The own normal
matters only where the surface determines none."""


def with_normals(mesh: Mesh) -> Mesh:
    """`mesh` with normals made from its faces: smooth, but sharp at edges of more than 40 degrees.

    Vertices are split where faces that meet there get different normals.
    """
    corners = mesh.faces.reshape(-1).astype(np.int64)
    triangles = mesh.vertices[mesh.faces].astype(np.float64)
    weighted = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    length = np.linalg.norm(weighted, axis=1, keepdims=True)
    unit = weighted / np.maximum(length, 1e-20)

    # Every pair (a, b) of corners that share a vertex: b's face counts for a's normal if the angle is small.
    order = np.argsort(corners, kind="stable")
    counts = np.bincount(corners, minlength=len(mesh.vertices))
    start = np.concatenate([[0], np.cumsum(counts)])[:-1]
    sharing = counts[corners[order]]
    a = np.repeat(order, sharing)
    step = np.arange(len(a)) - np.repeat(np.cumsum(sharing) - sharing, sharing)
    b = order[np.repeat(start[corners[order]], sharing) + step]
    smooth = np.einsum("ij,ij->i", unit[a // 3], unit[b // 3]) >= _CREASE_COSINE
    normals = np.stack(
        [np.bincount(a[smooth], weighted[b[smooth] // 3, k], minlength=len(corners)) for k in range(3)],
        axis=1,
    ).astype(np.float64)
    # A face without area has a zero normal, which would be drawn black.
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


def share_smooth(mesh: Mesh, degrees: float = 10.0) -> Mesh:
    """`mesh` with vertices of equal position (and uv) merged where their normals differ by less than `degrees`.

    The corners of a reduced mesh take normals from different vertices of its source. Merging saves a sixth of the memory in
    files and browsers.
    """
    if mesh.normals is None:
        return mesh
    rows = mesh.vertices if mesh.uvs is None else np.concatenate([mesh.vertices, mesh.uvs], axis=1)
    _, place = np.unique(rows, axis=0, return_inverse=True)
    place = place.reshape(-1)
    leader = np.arange(len(place))
    left, least = leader, np.cos(np.deg2rad(degrees))
    while len(left):
        # The first remaining vertex at each place absorbs those that are like it.
        _, first, of = np.unique(place[left], return_index=True, return_inverse=True)
        takes = left[first][of.reshape(-1)]
        alike = np.einsum("vk,vk->v", mesh.normals[left], mesh.normals[takes]) >= least
        alike |= left == takes
        leader[left[alike]] = takes[alike]
        left = left[~alike]
    kept, index = np.unique(leader, return_inverse=True)
    index = index.reshape(-1)
    normals = np.stack([np.bincount(index, mesh.normals[:, axis]) for axis in range(3)], axis=1)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)
    return Mesh(
        mesh.vertices[kept],
        index[mesh.faces].astype(np.uint32),
        normals.astype(np.float32),
        None if mesh.uvs is None else mesh.uvs[kept],
    )


class ShadedSurface:
    """Shading of an exact mesh that has normals: points on the mesh, with the normals there."""

    def __init__(self, mesh: Mesh) -> None:
        assert mesh.normals is not None
        triangles = mesh.vertices[mesh.faces].astype(np.float64)
        some, of_each, most = _EXACT_POINTS
        which, weights = _points(triangles, 1, min(some + of_each * len(triangles), most))
        self._tree = KDTree(np.einsum("sk,skd->sd", weights, triangles[which]))
        # A normal with NaN or infinity counts as missing: it would spread to everything that is fitted to it.
        normals = np.nan_to_num(mesh.normals.astype(np.float64), posinf=0.0, neginf=0.0)
        self._normals = _unit(np.einsum("sk,skd->sd", weights, normals[mesh.faces[which]]))

    def normals_at(
        self, points: NDArray[np.float64], facing: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """(P, 3) a normal of the surface near each of `points` (P, 3), if possible along `facing` (P, 3); and
        (P,) whether each normal faces that way."""
        count = min(_NEIGHBOURS, self._tree.n)
        near = np.asarray(self._tree.query(points, k=count)[1]).reshape(-1, count)
        candidates = self._normals[near]
        alike = np.einsum("skd,sd->sk", candidates, facing)
        # Take the nearest point that faces the same way. On a folded face there is none: take the point whose
        # normal is most similar.
        agrees = alike > _MIN_FACING_COSINE
        choice = np.where(agrees.any(axis=1), agrees.argmax(axis=1), alike.argmax(axis=1))
        every = np.arange(len(points))
        return candidates[every, choice], alike[every, choice] > 0

    def shade(self, coarse: Mesh) -> Mesh:
        """Copy of `coarse`, which must have normals, with the normals that shade its triangles most like this
        surface. Vertices with nearly the same normal are merged.

        The normals minimise the squared difference between the interpolated normal of a triangle and the
        normal of the surface, over points sampled by area. So a vertex at the end of a large flat face takes
        the normal of the face, although the surface bends right there. (The normals of the nearest vertices
        would shade such a face as if it were round, and make twice as many pixels wrong as the simpler
        outline does.)
        """
        coarse = share_smooth(coarse, _SHARED_DEGREES)
        assert coarse.normals is not None
        triangles = coarse.vertices[coarse.faces].astype(np.float64)
        across = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        area = np.linalg.norm(across, axis=1)
        each = 6 if len(triangles) < 4_000 else 3 if len(triangles) < 20_000 else 1
        which, weights = _points(triangles, each, _COARSE_POINTS)
        wanted, known = self.normals_at(
            np.einsum("sk,skd->sd", weights, triangles[which]), _unit(across)[which]
        )
        stands_for = (area / np.bincount(which, minlength=len(area)))[which] * known
        own = coarse.normals.astype(np.float64)
        rows = np.repeat(np.arange(len(which)), 3)
        at = csr_array((weights.ravel(), (rows, coarse.faces[which].ravel())), (len(which), len(own)))
        normal = at.T @ diags_array(stands_for) @ at
        diagonal = normal.diagonal()
        kept = _OWN_WEIGHT * diagonal + 1e-6 * diagonal.mean() + 1e-30
        normal = (normal + diags_array(kept)).tocsr()
        right = at.T @ (stands_for[:, None] * wanted) + kept[:, None] * own
        # Well conditioned once scaled: takes some ten iterations.
        scale = diags_array(1.0 / normal.diagonal())
        found = [cg(normal, b, x0=x, M=scale, rtol=1e-3, maxiter=60)[0] for b, x in zip(right.T, own.T)]
        fitted = np.stack(found, axis=1)
        # Normals of surfaces that face each other cancel out where they meet in a point.
        none = np.linalg.norm(fitted, axis=1) < 0.1
        fitted[none] = own[none]
        return share_smooth(replace(coarse, normals=_unit(fitted).astype(np.float32)))


def _unit(vectors: NDArray) -> NDArray[np.float64]:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-20)


def _points(
    triangles: NDArray[np.float64], each: int, by_area: int
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Random points, `each` on every triangle (F, 3, 3) and `by_area` more by area: their triangles, and (P, 3) corner weights."""
    random = np.random.default_rng(0)
    across = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    area = np.linalg.norm(across, axis=1) + 1e-30
    every = np.repeat(np.arange(len(triangles)), each)
    which = np.concatenate([every, random.choice(len(triangles), by_area, p=area / area.sum())])
    return which, random.dirichlet((1.0, 1.0, 1.0), len(which))
