"""Collision shapes as meshes: what a scene looks like where nothing can be rendered.

Made without a render device, a ManiSkill env has no render bodies at all, so neither meshes from
files nor colours can be asked for. PhysX still knows what touches what. Bodies without collision
shapes (goal markers) do not appear. PhysX's capsules, cylinders and planes lie along x.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Hashable, Iterator
from typing import Any

import numpy as np
import sapien.physx as physx
import trimesh
from numpy.typing import NDArray

from workbench.core.geometry import BodyKind, Material, Mesh
from workbench.core.mesh_detail import with_normals

_GREY: dict[BodyKind, float] = {"link": 0.55, "dynamic": 0.32, "kinematic": 0.22, "static": 0.12}
"""Linear grey: what moves is lighter than what it stands on."""
_PLANE_HALF_SIZE = 50.0
"""PhysX planes have no end; this is half the width that ManiSkill's ground has by default."""
_X_FROM_Z = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])


def collision_parts(entity: Any, kind: BodyKind) -> Iterator[tuple[Hashable, Callable[[], Mesh], Material]]:
    """Key, a function that makes the mesh in the body's frame, and material of each collision shape."""
    body = entity.find_component_by_type(physx.PhysxRigidBaseComponent)
    if body is None:
        return
    grey = _GREY[kind]
    material = Material((grey, grey, grey, 1.0), roughness=0.8)
    for shape in body.collision_shapes:
        pose = shape.local_pose
        placed = (tuple(pose.p.tolist()), tuple(pose.q.tolist()))
        key, make = _shape(shape)

        def placed_mesh(make: Callable[[], Mesh] = make, pose: Any = pose) -> Mesh:
            return _moved(with_normals(make()), pose.to_transformation_matrix())

        yield (key, placed, kind), placed_mesh, material


def _shape(shape: Any) -> tuple[Hashable, Callable[[], Mesh]]:
    if isinstance(shape, physx.PhysxCollisionShapeBox):
        half = shape.half_size.tolist()
        return ("box", *half), lambda: _mesh(trimesh.creation.box(extents=2 * np.array(half)))
    if isinstance(shape, physx.PhysxCollisionShapeSphere):
        r = shape.radius
        return ("sphere", r), lambda: _mesh(trimesh.creation.icosphere(subdivisions=3, radius=r))
    if isinstance(shape, physx.PhysxCollisionShapeCapsule):
        r, length = shape.radius, 2 * shape.half_length
        return ("capsule", r, length), lambda: _along_x(
            trimesh.creation.capsule(height=length, radius=r, count=[24, 12])
        )
    if isinstance(shape, physx.PhysxCollisionShapeCylinder):
        r, length = shape.radius, 2 * shape.half_length
        return ("cylinder", r, length), lambda: _along_x(trimesh.creation.cylinder(radius=r, height=length))
    if isinstance(shape, physx.PhysxCollisionShapePlane):
        return ("plane",), _plane
    if isinstance(shape, physx.PhysxCollisionShapeConvexMesh | physx.PhysxCollisionShapeTriangleMesh):
        vertices, triangles, scale = shape.vertices, shape.get_triangles(), shape.scale
        digest = hashlib.blake2b(vertices.tobytes(), digest_size=16)
        digest.update(triangles.tobytes())
        return ("mesh", digest.hexdigest(), *scale.tolist()), lambda: _oriented(vertices * scale, triangles)
    raise TypeError(f"{type(shape).__name__} is a collision shape that the workbench does not know")


def _mesh(mesh: trimesh.Trimesh) -> Mesh:
    return Mesh(np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.uint32))


def _along_x(mesh: trimesh.Trimesh) -> Mesh:
    made = _mesh(mesh)
    return Mesh((made.vertices @ _X_FROM_Z.T).astype(np.float32), made.faces)


def _plane() -> Mesh:
    s = _PLANE_HALF_SIZE
    corners = np.array([[0, -s, -s], [0, s, -s], [0, s, s], [0, -s, s]], dtype=np.float32)
    return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.uint32))


def _oriented(vertices: NDArray[np.float32], triangles: NDArray[np.uint32]) -> Mesh:
    """Triangles turned outwards where the whole says they look in: a mirrored scale turns them round."""
    corners = vertices[triangles].astype(np.float64)
    volume = np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    faces = np.asarray(triangles, np.uint32)
    return Mesh(np.asarray(vertices, np.float32), faces[:, ::-1].copy() if volume < 0 else faces)


def _moved(mesh: Mesh, matrix: NDArray[np.float32]) -> Mesh:
    rotation, position = matrix[:3, :3], matrix[:3, 3]
    normals = None if mesh.normals is None else (mesh.normals @ rotation.T).astype(np.float32)
    return Mesh((mesh.vertices @ rotation.T + position).astype(np.float32), mesh.faces, normals)
