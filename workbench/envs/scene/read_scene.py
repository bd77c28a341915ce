"""Reads meshes, materials and instances of a built scene."""

from __future__ import annotations

import hashlib
import os
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import sapien.physx as physx
import sapien.render
import trimesh
from numpy.typing import NDArray
from PIL import Image

from workbench.envs import maniskill_private
from workbench.envs.scene.mesh_levels import cached_reduced_mesh
from workbench.envs.scene.normals import with_normals
from workbench.envs.scene.scene_index import SceneIndex, scene_index
from workbench.envs.scene.shapes import BodyKind, Material, Mesh, SceneGeometry, Visual, srgb
from workbench.envs.scene.simplify import drop_uvs, flat_rectangle, share_vertices
from workbench.envs.simulation.hiding import shown_visibility

_FLAT_FACES = 100
"""Number of faces above which a mesh is tested for being a flat rectangle."""
_MAX_KEPT_MESHES = 1000
MAX_FACES = 375
"""Maximum faces of a visual: a Panda of 136,000 triangles becomes 9,000 and looks the same."""
MAX_SIDE_TEXELS = 1024
"""Maximum texels on the longest side of a texture."""


_COLLISION_COLOURS: dict[BodyKind, tuple[float, float, float]] = {
    "link": (0.12, 0.3, 0.75),
    "dynamic": (0.85, 0.3, 0.05),
    "kinematic": (0.35, 0.12, 0.6),
    "static": (0.12, 0.12, 0.12),
}
"""Linear RGB of collision shapes by the kind of their body: robot blue, objects orange, kinematic bodies violet."""
_PLANE_HALF_SIZE_METRES = 50.0
"""Half size at which PhysX's infinite planes are drawn: half the default width of ManiSkill's ground."""
_X_FROM_Z = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])


@dataclass(frozen=True)
class MeshPart:
    """A mesh with its material on one body of one env; read on demand."""

    key: Hashable
    """Parts with equal keys look the same."""
    read: Callable[[], tuple[Mesh, Material]]


def read_geometry(env: Any, max_faces: int = MAX_FACES, max_texels: int = MAX_SIDE_TEXELS) -> SceneGeometry:
    """Read meshes, materials and instances of all bodies of a scene.

    The scene is walked by cheap keys (file, scale, pose, colour), and triangles are read only for a new key: 16 envs of a
    Panda cost little more than one. Reduced meshes of files are cached for the life of the process, for the next reload.

    Bodies that are hidden now are included; `SceneGeometry.body_hidden` marks those that the task
    hides from its sensors. Without a render device the visuals are the collision shapes; bodies without collision
    shapes (goal markers) are then missing.
    """
    index = scene_index(env)
    walk = _RenderWalk(max_faces, max_texels, maniskill_private.hidden_objects(env))
    collisions = _visuals(index, _collision_parts)
    rendered = env.scene.can_render()
    return SceneGeometry(
        num_envs=env.num_envs,
        body_names=index.names,
        body_kinds=index.kinds,
        body_hidden=index.hidden,
        visuals=_visuals(index, lambda entity, kind: walk.parts(entity)) if rendered else collisions,
        collisions=collisions if rendered else (),
    )


def _visuals(
    index: SceneIndex, parts_of: Callable[[Any, BodyKind], Iterator[MeshPart]]
) -> tuple[Visual, ...]:
    """One visual for each distinct part of all entities, with the envs and bodies that have it."""
    instances: dict[Hashable, list[tuple[int, int]]] = {}
    first: dict[Hashable, MeshPart] = {}
    for body, kind in enumerate(index.kinds):
        for env_index, entity in enumerate(index.entities[:, body]):
            if entity is None:
                continue
            for part in parts_of(entity, kind):
                first.setdefault(part.key, part)
                instances.setdefault(part.key, []).append((env_index, body))
    visuals = []
    count: dict[int, int] = {}
    for key, places in instances.items():
        mesh, material = first[key].read()
        if len(mesh.faces) == 0 or material.base_color[3] == 0.0:
            continue
        body = places[0][1]
        number = count[body] = count.get(body, -1) + 1
        where = np.array(places, dtype=np.int32)
        visuals.append(
            Visual(
                name=f"{index.names[body]}/{number}",
                mesh=mesh,
                material=material,
                envs=where[:, 0].copy(),
                bodies=where[:, 1].copy(),
            )
        )
    return tuple(visuals)


def _collision_parts(entity: Any, kind: BodyKind) -> Iterator[MeshPart]:
    body = entity.find_component_by_type(physx.PhysxRigidBaseComponent)
    material = Material((*_COLLISION_COLOURS[kind], 1.0), roughness=0.8)
    for shape in () if body is None else body.collision_shapes:
        place = _Placement.of(shape)
        key, make = _collision_shape(shape)

        def read(make: Callable[[], Mesh] = make, place: _Placement = place) -> tuple[Mesh, Material]:
            return place.apply(with_normals(make())), material

        yield MeshPart((key, place.key, kind), read)


class _RenderWalk:
    """One walk over the render bodies of a scene; collects their textures."""

    def __init__(self, max_faces: int, max_texels: int, hidden: Sequence[Any]) -> None:
        self._max_faces, self._max_texels, self._hidden = max_faces, max_texels, hidden
        self._textures: list[tuple[Any, NDArray[np.uint8] | None]] = []

    def parts(self, entity: Any) -> Iterator[MeshPart]:
        body = entity.find_component_by_type(sapien.render.RenderBodyComponent)
        if body is None:
            return
        visibility = shown_visibility(self._hidden, body)
        for shape in body.render_shapes:
            place = _Placement.of(shape)
            for index, part in enumerate(shape.parts):
                material, texture = self._material(part.material, visibility)
                source = _source(shape, part, index)
                key = (source.key, place.key, _material_key(material), texture)
                yield MeshPart(key, lambda s=source, p=place, m=material, t=texture: self._read(s, p, m, t))

    def _read(
        self, source: _Source, place: _Placement, material: Material, texture: int | None
    ) -> tuple[Mesh, Material]:
        mesh = _reduced(source, texture is not None, self._max_faces)
        if texture is None:
            return place.apply(mesh), material
        return place.apply(mesh), replace(material, texture=self._pixels(texture))

    def _material(self, material: Any, visibility: float) -> tuple[Material, int | None]:
        color = material.base_color
        texture = self._texture_index(material.base_color_texture)
        if texture is not None:
            # SAPIEN's shaders replace the colour by the texture; glTF multiplies the two.
            color = [1.0, 1.0, 1.0, 1.0]
        rgba = (float(color[0]), float(color[1]), float(color[2]), float(color[3]) * visibility)
        return Material(rgba, float(material.metallic), float(material.roughness)), texture

    def _texture_index(self, texture: Any) -> int | None:
        if texture is None:
            return None
        for index, (known, _) in enumerate(self._textures):
            if known == texture:
                return index
        self._textures.append((texture, None))
        return len(self._textures) - 1

    def _pixels(self, index: int) -> NDArray[np.uint8]:
        texture, pixels = self._textures[index]
        if pixels is None:
            pixels = _rgba(texture, self._max_texels)
            self._textures[index] = (texture, pixels)
        return pixels


@dataclass(frozen=True)
class _Source:
    """Triangles before scale and pose: from a file, a primitive, or made in code."""

    key: Hashable
    part: Any
    dimensions: tuple[float, float, float]
    """Scale factors of the vertices: SAPIEN stores primitives as unit shapes."""
    keep: bool
    """Whether to keep the reduced mesh for the next scene."""


@dataclass(frozen=True)
class _Placement:
    """Scale and local pose of a shape within its body."""

    scale: tuple[float, float, float]
    position: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]
    clockwise: bool

    @staticmethod
    def of(shape: Any) -> _Placement:
        p, q = shape.local_pose.p.tolist(), shape.local_pose.q.tolist()
        scaled = isinstance(shape, sapien.render.RenderShapeTriangleMesh)
        x, y, z = shape.scale.tolist() if scaled else (1.0, 1.0, 1.0)
        return _Placement(
            (x, y, z),
            (p[0], p[1], p[2]),
            (q[0], q[1], q[2], q[3]),
            getattr(shape, "front_face", "") == "clockwise",
        )

    @property
    def key(self) -> Hashable:
        return (self.scale, self.position, self.quaternion, self.clockwise)

    def apply(self, mesh: Mesh) -> Mesh:
        rotation = sapien.Pose(q=self.quaternion).to_transformation_matrix()[:3, :3].astype(np.float64)
        scale = np.array(self.scale)
        vertices = (mesh.vertices * scale) @ rotation.T + np.array(self.position)
        normals = None
        if mesh.normals is not None:
            # Normals transform by the inverse transpose: a non-uniform scale would tilt them.
            normals = (mesh.normals / np.where(scale == 0, 1.0, scale)) @ rotation.T
            normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)
            normals = normals.astype(np.float32)
        faces = np.ascontiguousarray(mesh.faces[:, ::-1]) if self.clockwise else mesh.faces
        return Mesh(vertices.astype(np.float32), faces, normals, mesh.uvs)


def _source(shape: Any, part: Any, index: int) -> _Source:
    one = (1.0, 1.0, 1.0)
    if isinstance(shape, sapien.render.RenderShapeTriangleMesh):
        if shape.filename:
            return _Source(("file", shape.filename, _file_version(shape.filename), index), part, one, True)
        return _Source(
            ("made", _content_hash(part.vertices, part.triangles, part.get_vertex_uv())), part, one, False
        )
    if isinstance(shape, sapien.render.RenderShapeBox):
        x, y, z = shape.half_size.tolist()
        return _Source(("box", x, y, z), part, (x, y, z), False)
    if isinstance(shape, sapien.render.RenderShapeSphere):
        r = shape.radius
        return _Source(("sphere", r), part, (r, r, r), False)
    if isinstance(shape, sapien.render.RenderShapeCylinder):
        r, length = shape.radius, shape.half_length
        return _Source(("cylinder", r, length), part, (length, r, r), False)
    if isinstance(shape, sapien.render.RenderShapeCapsule):
        return _Source(("capsule", shape.radius, shape.half_length), part, one, False)
    if isinstance(shape, sapien.render.RenderShapePlane):
        x, y, z = shape.scale.tolist()
        return _Source(("plane", x, y, z), part, (x, y, z), False)
    raise TypeError(f"{type(shape).__name__} is a render shape that the workbench does not know")


def _file_version(filename: str) -> tuple[int, int] | None:
    """Value that changes when the file changes, since authors edit meshes too; None if it cannot be read."""
    try:
        stat = os.stat(filename)
    except OSError:
        return None
    return stat.st_mtime_ns, stat.st_size


def _content_hash(*arrays: NDArray[Any]) -> str:
    digest = hashlib.blake2b(digest_size=16)
    for array in arrays:
        digest.update(array.tobytes())
    return digest.hexdigest()


def _material_key(material: Material) -> Hashable:
    return (material.base_color, material.metallic, material.roughness)


_kept_meshes: OrderedDict[Hashable, Mesh] = OrderedDict()
_kept_exact: OrderedDict[Hashable, Mesh] = OrderedDict()


def _reduced(source: _Source, textured: bool, max_faces: int) -> Mesh:
    key = (source.key, textured, max_faces)
    if key in _kept_meshes:
        _kept_meshes.move_to_end(key)
        return _kept_meshes[key]
    mesh = _read_part(source)
    if not textured:
        mesh = drop_uvs(mesh)
    flat = flat_rectangle(mesh) if len(mesh.faces) > _FLAT_FACES else None
    if flat is not None:
        mesh = flat
    else:
        mesh = share_vertices(mesh) if len(mesh.faces) <= max_faces else cached_reduced_mesh(mesh, max_faces)
    if source.keep:
        _kept_meshes[key] = mesh
        if len(_kept_meshes) > _MAX_KEPT_MESHES:
            _kept_meshes.popitem(last=False)
    return mesh


def exact_part(shape: Any, part: Any, index: int) -> tuple[Mesh, tuple[float, float, float]]:
    """The mesh of a part of a render shape with all its triangles, and the scale to apply before the shape's
    local pose.

    Meshes of files are cached for the life of the process.
    """
    source = _source(shape, part, index)
    scale = _Placement.of(shape).scale
    if not source.keep:
        return _read_part(source), scale
    key = (source.key, "exact")
    if key not in _kept_exact:
        _kept_exact[key] = _read_part(source)
        if len(_kept_exact) > _MAX_KEPT_MESHES:
            _kept_exact.popitem(last=False)
    _kept_exact.move_to_end(key)
    return _kept_exact[key], scale


def _read_part(source: _Source) -> Mesh:
    dimensions = np.array(source.dimensions)
    vertices = (source.part.vertices * dimensions).astype(np.float32)
    faces = np.array(source.part.triangles, dtype=np.uint32)
    normals = np.array(source.part.get_vertex_normal(), dtype=np.float32)
    uvs = np.array(source.part.get_vertex_uv(), dtype=np.float32)
    mesh = Mesh(vertices, faces, None, uvs if len(uvs) == len(vertices) else None)
    if len(normals) != len(vertices) or not np.linalg.norm(normals, axis=1).all():
        return with_normals(mesh)
    return replace(mesh, normals=normals)


def _rgba(texture: Any, max_size: int) -> NDArray[np.uint8]:
    """(H, W, 4) pixels of a ``RenderTexture2D``, converted to sRGB."""
    pixels = np.asarray(texture.download())
    if pixels.dtype == np.uint8 and pixels.shape[-1] == 4 and texture.is_srgb:
        return _at_most(pixels, max_size)
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    if np.issubdtype(pixels.dtype, np.floating):
        values = np.clip(pixels.astype(np.float32), 0.0, 1.0)
    else:
        values = pixels.astype(np.float32) / np.iinfo(pixels.dtype).max
    channels = values.shape[-1]
    if channels < 3:
        values = np.concatenate([np.repeat(values[..., :1], 3, axis=-1), values[..., 1:]], axis=-1)
    if values.shape[-1] == 3:
        values = np.concatenate([values, np.ones_like(values[..., :1])], axis=-1)
    if not texture.is_srgb:
        values[..., :3] = srgb(values[..., :3])
    return _at_most(np.round(values * 255).astype(np.uint8), max_size)


def _at_most(pixels: NDArray[np.uint8], max_size: int) -> NDArray[np.uint8]:
    longest = max(pixels.shape[:2])
    if longest <= max_size:
        return pixels
    height, width = (max(1, round(side * max_size / longest)) for side in pixels.shape[:2])
    return np.asarray(Image.fromarray(pixels).resize((width, height), Image.Resampling.BOX))


# --- collision shapes --------------------------------------------------------------------------------


def _collision_shape(shape: Any) -> tuple[Hashable, Callable[[], Mesh]]:
    """Key, and the function that makes the mesh. PhysX's capsules, cylinders and planes are along x."""
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
        return ("mesh", _content_hash(vertices, triangles), *scale.tolist()), lambda: _oriented(
            vertices * scale, triangles
        )
    raise TypeError(f"{type(shape).__name__} is a collision shape that the workbench does not know")


def _mesh(mesh: trimesh.Trimesh) -> Mesh:
    return Mesh(np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.uint32))


def _along_x(mesh: trimesh.Trimesh) -> Mesh:
    made = _mesh(mesh)
    return Mesh((made.vertices @ _X_FROM_Z.T).astype(np.float32), made.faces)


def _plane() -> Mesh:
    s = _PLANE_HALF_SIZE_METRES
    corners = np.array([[0, -s, -s], [0, s, -s], [0, s, s], [0, -s, s]], dtype=np.float32)
    return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.uint32))


def _oriented(vertices: NDArray[np.float32], triangles: NDArray[np.uint32]) -> Mesh:
    """A mesh whose triangles face outwards: a mirrored scale (negative volume) turns them inwards."""
    corners = vertices[triangles].astype(np.float64)
    volume = np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    faces = np.asarray(triangles, np.uint32)
    return Mesh(np.asarray(vertices, np.float32), faces[:, ::-1].copy() if volume < 0 else faces)
