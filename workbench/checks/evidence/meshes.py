"""Counts the triangles of mesh files, and finds hollow meshes."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

_BYTES_PER_TRIANGLE = 3.0
"""Minimum number of bytes of a triangle in an uncompressed mesh file."""
_RAYS = 162
"""Number of directions in which walls are looked for."""
_MAX_TRIANGLES = 50_000
_MIN_WALL_SHARE, _MIN_OPEN_SHARE = 0.6, 0.03
"""Minimum share of the rays from inside a hollow mesh that meet a wall, and minimum share that meet nothing."""


def triangles_in(file: str, more_than: int) -> int | None:
    """Number of triangles of a mesh file; 0 if the file is missing or too small to have more than `more_than`
    triangles, None if it cannot be read."""
    if not Path(file).is_file() or Path(file).stat().st_size < _BYTES_PER_TRIANGLE * more_than:
        return 0
    mesh = _read(file)
    return None if mesh is None else len(mesh.faces)


@lru_cache(maxsize=256)
def is_hollow(file: str) -> bool | None:
    """Whether a mesh is hollow, so that things could be put into it: from the middle of its convex hull, rays
    in most directions meet a wall, and the rays that meet nothing are on one side. None if the mesh cannot be
    read or has too many triangles."""
    mesh = _read(file)
    if mesh is None or len(mesh.faces) > _MAX_TRIANGLES:
        return None
    if len(mesh.faces) < 4:
        return False
    try:
        hull = mesh.convex_hull
    except Exception:  # qhull raises if all vertices are in one plane
        return False
    directions = trimesh.creation.icosphere(subdivisions=2).vertices[:_RAYS]
    hits = _crossings(np.asarray(mesh.triangles), np.asarray(hull.center_mass), np.asarray(directions))
    through = hits == 0
    if not _MIN_OPEN_SHARE <= through.mean() <= 1 - _MIN_WALL_SHARE:
        return False
    # An opening is on one side; gaps of a ring, a frame or a star are on several.
    return float(np.linalg.norm(directions[through].mean(axis=0))) > 0.5


def _crossings(
    triangles: NDArray[np.float64], origin: NDArray[np.float64], directions: NDArray[np.float64]
) -> NDArray[np.int64]:
    """(R,) number of the triangles (F, 3, 3) that each ray from `origin` meets (Moeller and Trumbore)."""
    first = triangles[:, 0]
    one, two = triangles[:, 1] - first, triangles[:, 2] - first
    to_origin = origin - first
    across = np.cross(to_origin, one)
    ahead = np.einsum("fi,fi->f", two, across)
    count = np.zeros(len(directions), np.int64)
    for row, direction in enumerate(directions):
        normal = np.cross(direction, two)
        volume = np.einsum("fi,fi->f", one, normal)
        flat = np.abs(volume) < 1e-15
        scale = 1 / np.where(flat, 1, volume)
        u = np.einsum("fi,fi->f", to_origin, normal) * scale
        v = across @ direction * scale
        count[row] = int((~flat & (u >= 0) & (v >= 0) & (u + v <= 1) & (ahead * scale > 0)).sum())
    return count


@lru_cache(maxsize=64)
def _read(file: str) -> trimesh.Trimesh | None:
    try:
        mesh = trimesh.load(file, force="mesh")
    except Exception:  # any of a dozen readers may raise; the rule missing-file reports a missing file
        return None
    return mesh if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces) else None
