"""Simplified versions (levels) of a mesh, cached on disk, each with its distance from the exact surface."""

from __future__ import annotations

import hashlib
import io
import os
import threading
import zipfile
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from trimesh.triangles import closest_point

from workbench.envs.scene.normals import ShadedSurface, share_smooth
from workbench.envs.scene.shapes import Mesh
from workbench.envs.scene.simplify import (
    cluster_mesh,
    coarsen_mesh,
    collapse_mesh,
    flat_rectangle,
    reduce_mesh,
    rounded,
    share_vertices,
)
from workbench.machine.folders import cache_folder, read_private, write_private

_VERSION = 3
"""Version of the cached files; increase it when the levels change."""
_MIN_FACES = 24
_LOST_PIECE_ERROR, _USELESS_ERROR = 0.01, 0.1
"""Errors of a level, as shares of the mesh's longest side. Above the first, a piece of the mesh may be missing, so
coarsening by pieces is tried too. Above the second, neither this level nor a coarser one is used."""
_SIMPLE_FACES = 150
"""Triangles up to which a mesh stays exact: layered thin discs, such as ManiSkill's targets, would lose a layer (see
`from_afar`)."""
_AFAR_FACES = 32, 48, 72, 100, 144, 200, 280, 400, 800, 1600
"""Triangle counts that `from_afar` tries, fewest first: each by collapsing edges, then on grids with
`_AFAR_CELLS` cells along the longest axis."""
_AFAR_CELLS = 12, 24, 48
_LARGE_FACES = 20_000
"""Triangles above which a level is made from the previous level: making it from the exact mesh takes too long."""
_CHECKED_POINTS = 1500
"""Points on the exact surface at which the distance to a level is measured."""
_SEARCHED_POINTS = 10_000
"""Maximum `count` for `_points_on` on a level. The distance from a checked point is measured only to the
triangles of the points nearest to it."""
_MAX_MESHES = 500
"""Maximum number of meshes in memory."""
_MAX_CACHE_BYTES = 512 << 20
"""Limit of the cache in bytes, including files of other versions; the least recently used files are deleted first."""


@dataclass(frozen=True)
class Level:
    mesh: Mesh
    error: float
    """Distance from the level within which 99 % of the exact surface lies, in the mesh's own units."""


def content_hash(mesh: Mesh) -> str:
    """Digest of everything that determines the levels of a mesh."""
    digest = hashlib.blake2b(digest_size=16)
    for array in (mesh.vertices, mesh.faces, mesh.normals, mesh.uvs):
        digest.update(b"-" if array is None else np.ascontiguousarray(array).data)
        digest.update(b"|")
    return digest.hexdigest()


_kept: OrderedDict[str, tuple[Level, ...]] = OrderedDict()
_keeping = threading.Lock()


def levels_of(mesh: Mesh) -> tuple[Level, ...]:
    """Simplified versions of `mesh`, from fine to coarse, each with about half the triangles of the one before.

    The first call for a mesh takes some 0.1 s for each thousand triangles; later calls, also in other processes, read a
    file. Thread-safe.
    """
    name = content_hash(mesh)
    with _keeping:
        if name in _kept:
            _kept.move_to_end(name)
            return _kept[name]
    levels = _read(name)
    if levels is None:
        levels = tuple(_made(mesh))
        _write(name, levels)
    _keep(name, levels)
    return levels


def _keep(name: str, levels: tuple[Level, ...]) -> None:
    with _keeping:
        _kept[name] = levels
        if len(_kept) > _MAX_MESHES:
            _kept.popitem(last=False)


def cached_reduced_mesh(mesh: Mesh, max_faces: int) -> Mesh:
    """`mesh` reduced to about `max_faces` triangles, vertices rounded to a grid; cached on disk.

    Without the cache, opening a task would take 0.6 s longer for the meshes of a robot.
    """
    name = f"{content_hash(mesh)}-{max_faces}"
    kept = _read(name)
    if kept:
        return kept[0].mesh
    made = reduce_mesh(mesh, max_faces)
    made = share_vertices(made if made is mesh else rounded(share_smooth(made)))
    _write(name, (Level(made, 0.0),))
    return made


def from_afar(mesh: Mesh, error: float) -> Mesh:
    """`mesh` with few triangles, such that 99 % of its surface is within `error` of them; cached on disk.

    For objects a few pixels large: unlike in `levels_of`, vertices may be joined on a coarse grid, because
    hundreds of loose pieces would keep their triangles. Simple and textured meshes stay exact. The first call
    for a mesh takes some 0.2 s.
    """
    if len(mesh.faces) <= _SIMPLE_FACES or mesh.uvs is not None or error <= 0:
        return mesh
    name = f"{content_hash(mesh)}-afar-{error:.3g}"
    with _keeping:
        kept = _kept.get(name)
    kept = kept or _read(name)
    if not kept:
        kept = (Level(_few_faces(mesh, error), error),)
        _write(name, kept)
    _keep(name, kept)
    return kept[0].mesh


def _few_faces(mesh: Mesh, error: float) -> Mesh:
    """The coarsest mesh whose `deviation` is at most `error`; `mesh` itself if there is none."""
    for faces in (count for count in _AFAR_FACES if count < 0.8 * len(mesh.faces)):
        for coarser in (
            collapse_mesh(mesh, faces),
            *(cluster_mesh(mesh, faces, cells) for cells in _AFAR_CELLS),
        ):
            if len(coarser.faces) <= 1.5 * faces and deviation(mesh, coarser) <= error:
                return _shaded(coarser, None if mesh.normals is None else ShadedSurface(mesh))
    return mesh


def _shaded(coarser: Mesh, surface: ShadedSurface | None) -> Mesh:
    return share_vertices(coarser) if surface is None else surface.shade(coarser)


def are_known(mesh: Mesh) -> bool:
    """Whether the levels of this mesh are in memory or on disk, so that `levels_of` takes no time."""
    name = content_hash(mesh)
    with _keeping:
        return name in _kept or (_folder() / f"{name}.npz").exists()


def within(mesh: Mesh, error: float) -> Mesh:
    """The coarsest level whose `Level.error` is at most `error`; `mesh` itself if there is none."""
    good = [level.mesh for level in levels_of(mesh) if level.error <= error]
    return good[-1] if good else mesh


def _made(mesh: Mesh) -> Iterator[Level]:
    if len(mesh.faces) <= _MIN_FACES:
        return
    flat = flat_rectangle(mesh)
    if flat is not None:
        yield Level(flat, 0.0)
        return
    surface = None if mesh.normals is None else ShadedSurface(mesh)
    finer, faces, worst = mesh, len(mesh.faces), 0.0
    extent = float(np.ptp(mesh.vertices, axis=0).max())
    while faces // 2 >= _MIN_FACES:
        faces //= 2
        # A level made from the exact mesh is nearest to the surface; for a very large mesh that takes too long.
        source = mesh if len(mesh.faces) <= _LARGE_FACES else finer
        coarser = coarsen_mesh(source, faces)
        error = deviation(mesh, coarser)
        if error > _LOST_PIECE_ERROR * extent and mesh.uvs is None:
            by_pieces = coarsen_mesh(source, faces, by_pieces=True)
            fewer = len(by_pieces.faces) < 0.9 * len(finer.faces)
            if fewer and (other := deviation(mesh, by_pieces)) < error:
                coarser, error = by_pieces, other
        if len(coarser.faces) >= 0.9 * len(finer.faces) or error > _USELESS_ERROR * extent:
            break
        # The error of a level is at least that of the finer level before it.
        finer, worst = coarser, max(worst, error)
        yield Level(_shaded(coarser, surface), worst)


def deviation(exact: Mesh, reduced: Mesh) -> float:
    """The distance from `reduced` within which 99 % of the surface of `exact` is, measured at random points."""
    random = np.random.default_rng(0)
    points = _points_on(exact, _CHECKED_POINTS, random)[0][-_CHECKED_POINTS:]
    samples, which = _points_on(reduced, min(_SEARCHED_POINTS, 20 * len(reduced.faces) + 2000), random)
    triangles = reduced.vertices[reduced.faces].astype(np.float64)
    near = np.asarray(KDTree(samples).query(points, k=min(4, len(samples)))[1]).reshape(len(points), -1)
    best = np.full(len(points), np.inf)
    for column in near.T:
        on_it = closest_point(triangles[which[column]], points)
        best = np.minimum(best, np.linalg.norm(on_it - points, axis=1))
    return float(np.quantile(best, 0.99))


def _points_on(
    mesh: Mesh, count: int, random: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Random points (P, 3) on the surface, and their triangles.

    One is on each triangle. `count` are on triangles drawn in proportion to their longest edge, and `count`
    on triangles drawn in proportion to their area.
    """
    triangles = mesh.vertices[mesh.faces].astype(np.float64)
    across = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    area = np.linalg.norm(across, axis=1) + 1e-30
    longest = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2).max(axis=1) + 1e-30
    # By length too: with few points, most of a long thin triangle would be far from all of them.
    by_length = random.choice(len(triangles), count, p=longest / longest.sum())
    by_area = random.choice(len(triangles), count, p=area / area.sum())
    which = np.concatenate([np.arange(len(triangles)), by_length, by_area])
    weights = random.dirichlet((1.0, 1.0, 1.0), len(which))
    return np.einsum("sk,skd->sd", weights, triangles[which]), which


# --- on disk -----------------------------------------------------------------------------------------


def _folder() -> Path:
    return cache_folder() / f"meshes-{_VERSION}"


def _read(name: str) -> tuple[Level, ...] | None:
    """The cached levels; None where there is no file, or it is invalid."""
    try:
        content = read_private(f"{name}.npz", _folder())
        if content is None:
            return None
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            levels = tuple(_level(file, number) for number in range(len(file["errors"])))
        os.utime(_folder() / f"{name}.npz")
        return levels
    except (OSError, EOFError, ValueError, KeyError, IndexError, zipfile.BadZipFile):
        return None


def _level(file: np.lib.npyio.NpzFile, number: int) -> Level:
    arrays = [file.get(f"{part}{number}") for part in ("vertices", "faces", "normals", "uvs")]
    vertices, faces, normals, uvs = arrays
    if vertices is None or faces is None or faces.max(initial=0) >= len(vertices):
        raise ValueError("not a mesh")
    return Level(Mesh(vertices, faces, normals, uvs), float(file["errors"][number]))


def _write(name: str, levels: tuple[Level, ...]) -> None:
    arrays: dict[str, NDArray] = {"errors": np.array([level.error for level in levels])}
    for number, level in enumerate(levels):
        mesh = level.mesh
        named = {"vertices": mesh.vertices, "faces": mesh.faces, "normals": mesh.normals, "uvs": mesh.uvs}
        arrays |= {f"{part}{number}": array for part, array in named.items() if array is not None}
    content = io.BytesIO()
    np.savez(content, **arrays)  # type: ignore[arg-type]
    try:
        write_private(f"{name}.npz", content.getvalue(), _folder())
        _make_room()
    except OSError:
        pass  # a full disk or a folder of another user: the next process makes the levels again


def _make_room() -> None:
    files = []
    for path in cache_folder().glob("meshes-*/*.npz"):
        status = path.stat()
        files.append((status.st_mtime, status.st_size, path))
    over = sum(size for _, size, _ in files) - _MAX_CACHE_BYTES
    for _, size, path in sorted(files):
        if over <= 0:
            return
        path.unlink(missing_ok=True)
        over -= size
