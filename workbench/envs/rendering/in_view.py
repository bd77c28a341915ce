"""Finds what a camera cannot see (boxes and triangles outside its field of view), and what never moves relative to it."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import sapien
import sapien.render
from numpy.typing import NDArray
from sapien import physx
from scipy.spatial import QhullError
from trimesh.convex import hull_points

from workbench.envs.scene.shapes import Mesh

_MARGIN_PIXELS = 1.0
"""Margin around the picture that counts as in view: a tolerance for poses that changed since they were measured."""

Planes = NDArray[np.float64]
"""(5, 4) left, right, top, bottom and near: a point is in view where all of ``planes @ (x, y, z, 1)`` are positive."""


def planes_of(camera: sapien.render.RenderCameraComponent) -> Planes:
    """View planes of a camera, in its own frame: x forward, y left, z up."""
    k = np.asarray(camera.get_intrinsic_matrix(), np.float64)
    # Column and row of a point's pixel, multiplied by x.
    column, row, x = (
        np.array([k[0, 2], -k[0, 0], -k[0, 1], 0]),
        np.array([k[1, 2], 0, -k[1, 1], 0]),
        np.eye(4)[0],
    )
    planes = [
        column + _MARGIN_PIXELS * x,
        (camera.width + _MARGIN_PIXELS) * x - column,
        row + _MARGIN_PIXELS * x,
        (camera.height + _MARGIN_PIXELS) * x - row,
        x - [0, 0, 0, 0.99 * camera.near],
    ]
    return np.array(planes)


def outside_and_inside(
    boxes: NDArray[np.float32], planes: NDArray[np.float64]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """(B,) whether each box is entirely outside one of its planes; and (B,) whether it is entirely inside all
    of them.

    Args:
        boxes: (B, 2, 3) lowest and highest corner.
        planes: (B, 5, 4) the view planes in the frame of each box.
    """
    sides = planes[:, :, None, :3] * boxes[:, None]
    farthest = sides.max(axis=2).sum(axis=-1) + planes[..., 3]
    nearest = sides.min(axis=2).sum(axis=-1) + planes[..., 3]
    return farthest.min(axis=1) < 0, nearest.min(axis=1) >= 0


def is_outside(points: NDArray[np.float64], planes: Planes) -> bool:
    """Whether all points (P, 3), and so everything between them, are outside the same plane. Points and
    planes are in the same frame."""
    return bool((planes[:, :3] @ points.T + planes[:, 3:]).max(axis=1).min() < 0)


def corners_of(points: NDArray[np.floating]) -> NDArray[np.float64]:
    """(P, 3) corners of the points' convex hull; corners of the box around the points if they have no hull
    (they lie in one plane, or are not finite)."""
    try:
        return np.asarray(hull_points(points), np.float64)
    except (QhullError, ValueError):
        return box_corners(points)


def box_corners(points: NDArray[np.floating]) -> NDArray[np.float64]:
    """(8, 3) corners of the box around the points."""
    return np.array(list(product(*zip(points.min(axis=0), points.max(axis=0)))), np.float64)


def cut_to_view(mesh: Mesh, planes: Planes) -> Mesh:
    """`mesh` without the triangles that are entirely outside one of the planes (in the mesh's frame)."""
    outside = (mesh.vertices @ planes[:, :3].T + planes[:, 3] < 0) @ (1 << np.arange(len(planes)))
    of_faces = outside[mesh.faces]
    kept = mesh.faces[(of_faces[:, 0] & of_faces[:, 1] & of_faces[:, 2]) == 0]
    index, faces = np.unique(kept, return_inverse=True)
    return replace(
        mesh,
        vertices=mesh.vertices[index],
        faces=faces.reshape(-1, 3).astype(np.uint32),
        normals=None if mesh.normals is None else mesh.normals[index],
        uvs=None if mesh.uvs is None else mesh.uvs[index],
    )


def fixed_to(entity: sapien.Entity) -> set[int]:
    """Ids of the entities that never move relative to `entity`: itself, and links that are fixed to it."""
    link: Any = entity.find_component_by_type(physx.PhysxArticulationLinkComponent)
    found, left = {id(entity)}, [] if link is None else [link]
    while left:
        link = left.pop()
        neighbours = [child for child in link.children if child.joint.type == "fixed"]
        if link.parent is not None and link.joint.type == "fixed":
            neighbours.append(link.parent)
        for other in neighbours:
            if id(other.entity) not in found:
                found.add(id(other.entity))
                left.append(other)
    return found
