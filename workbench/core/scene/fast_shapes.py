"""Simplified shapes beside the exact ones, for pictures that may differ a little and take a fraction of the time."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import sapien
import sapien.render
from numpy.typing import NDArray

from workbench.core.scene.mesh_levels import are_known, within
from workbench.core.scene.read_scene import exact_part
from workbench.core.scene.shapes import Mesh
from workbench.core.scene.simplify import drop_uvs

HEAVY = 500
"""Bodies with meshes of more triangles are simplified; the others stay exact, and so do cylinders, spheres and the like: what
is layered of thin discs, as ManiSkill's targets are, would lose a layer."""
TOLERANCE = 0.6
"""Pixels that a surface may be off in a picture of `_SMALL` pixels; in larger ones more, since fewer of all pixels are edges."""
_SMALL = 128
_NEAREST = 0.02
"""Metres. Nothing is looked at from nearer for long, and a camera within its own mount would forbid any simplification."""
_FINEST = 1e-4
"""Metres. Tolerances are this times a power of two, so that poses that differ a little give the same meshes."""

Bodies = tuple[tuple[sapien.render.RenderBodyComponent, sapien.render.RenderBodyComponent], ...]
"""The exact component of each simplified body of an env, and the simplified one beside it."""


@contextmanager
def shown(bodies: Bodies) -> Iterator[None]:
    """Within this, the simplified shapes are drawn in place of the exact ones, hidden where those are hidden."""
    was = [exact.visibility for exact, _ in bodies]
    try:
        for (exact, fast), visibility in zip(bodies, was, strict=True):
            fast.visibility = visibility
            exact.visibility = 0.0
        yield
    finally:
        for (exact, fast), visibility in zip(bodies, was, strict=True):
            exact.visibility = visibility
            fast.visibility = 0.0


class FastShapes:
    """The simplified shapes of a scene, beside the exact ones and hidden, made for each camera at its first fast picture.

    How much a body is simplified is decided by its distance from the camera where both are then, by the lens and by the
    size in pixels. The shapes share the materials of the exact ones, so that a colour which is changed later changes in
    both; a body's id in segmentation pictures is that of its entity.
    """

    def __init__(self, sub_scenes: Sequence[sapien.Scene]) -> None:
        self._heavy = [[(body.entity, body) for body in heavy_bodies(scene)] for scene in sub_scenes]
        self._chosen = _Chosen()
        self._components: dict[tuple[int, float], tuple[Any, Any]] = {}
        """By the id of the exact one, which is kept beside it, and the tolerance."""
        self._of_camera: dict[Hashable, list[Bodies]] = {}

    def bodies(self, key: Hashable, camera: Sequence[sapien.render.RenderCameraComponent]) -> list[Bodies]:
        """Those of each env for the camera of this name.

        What the first call for a camera makes is where its bodies are after the next ``update_render``.

        Args:
            camera: its component in each env.
        """
        if key not in self._of_camera:
            tolerances = self._tolerances(camera)
            self._of_camera[key] = [
                tuple(
                    (body, fast)
                    for entity, body in of_env
                    if (fast := self._simplified(body, tolerances[_shared_name(entity, env)])) is not None
                )
                for env, of_env in enumerate(self._heavy)
            ]
        return self._of_camera[key]

    def remove(self) -> None:
        """Take them out of the scene."""
        for _, fast in self._components.values():
            if fast is not None:
                fast.entity.remove_component(fast)
        self._components.clear()
        self._of_camera.clear()

    def _tolerances(self, camera: Sequence[sapien.render.RenderCameraComponent]) -> dict[str, float]:
        """In metres, by the name of the body: the same in all envs, where equal states are to look alike."""
        finest: dict[str, float] = {}
        for env, (component, of_env) in enumerate(zip(camera, self._heavy, strict=True)):
            pixels_off = TOLERANCE * max(1.0, component.height / _SMALL) ** 0.5
            position, pixel = np.asarray(component.get_global_pose().p, np.float32), _pixel(component)
            for entity, body in of_env:
                name = _shared_name(entity, env)
                distance = _distance(position, np.asarray(body.get_global_aabb_fast()))
                off = pixels_off * pixel * max(distance, _NEAREST)
                finest[name] = min(finest.get(name, np.inf), off)
        return {name: _rounded(off) for name, off in finest.items()}

    def _simplified(self, body: Any, tolerance: float) -> sapien.render.RenderBodyComponent | None:
        key = (id(body), tolerance)
        if key not in self._components:
            made = _simplified(body, tolerance, self._chosen)
            self._components[key] = body, made
            if made is not None:
                made.visibility = 0.0
                body.entity.add_component(made)
        return self._components[key][1]


def heavy_bodies(sub_scene: sapien.Scene) -> Iterator[sapien.render.RenderBodyComponent]:
    """The bodies with so many triangles that they are simplified; not those with normal maps."""
    for entity in sub_scene.entities:
        body: Any = entity.find_component_by_type(sapien.render.RenderBodyComponent)
        if body is not None and _faces(body) > HEAVY and not _has_tangents(body):
            yield body


def unknown_meshes(sub_scenes: Sequence[sapien.Scene]) -> list[Mesh]:
    """The meshes of heavy bodies that were never simplified on this machine: that takes seconds for a robot."""
    found: dict[int, Mesh] = {}
    for sub_scene in sub_scenes:
        for body in heavy_bodies(sub_scene):
            for shape in filter(_is_mesh, body.render_shapes):
                for index, part in enumerate(shape.parts):
                    mesh = exact_part(shape, part, index)[0]
                    found[id(mesh)] = mesh if _is_textured(part.material) else drop_uvs(mesh)
    return [mesh for mesh in found.values() if not are_known(mesh)]


def _has_tangents(body: Any) -> bool:
    """Whether a part has a normal map: SAPIEN makes the tangents that it needs of meshes in files alone."""
    return any(
        part.material.normal_texture is not None for shape in body.render_shapes for part in shape.parts
    )


class _Chosen:
    """Simplified meshes by the exact one, which is often that of all envs."""

    def __init__(self) -> None:
        self._made: dict[tuple[int, bool, float], tuple[Mesh, Mesh]] = {}

    def mesh(self, exact: Mesh, textured: bool, tolerance: float) -> Mesh:
        key = (id(exact), textured, tolerance)
        if key not in self._made:
            # With the exact one, whose id would else be another's.
            self._made[key] = exact, within(exact if textured else drop_uvs(exact), tolerance)
        return self._made[key][1]


def _is_textured(material: Any) -> bool:
    kinds = ("base_color", "roughness", "metallic", "normal", "emission", "transmission")
    return any(getattr(material, f"{kind}_texture") is not None for kind in kinds)


def _simplified(body: Any, tolerance: float, chosen: _Chosen) -> sapien.render.RenderBodyComponent | None:
    """None where nothing of it can be simplified."""
    shapes, fewer = [], False
    for shape in body.render_shapes:
        for index, part in enumerate(shape.parts):
            exact, scale = exact_part(shape, part, index)
            largest = max(map(abs, scale))
            mesh = exact
            if largest > 0 and _is_mesh(shape):
                mesh = chosen.mesh(exact, _is_textured(part.material), tolerance / largest)
            fewer |= len(mesh.faces) < len(exact.faces)
            shapes.append(_shape(mesh, scale, shape, part.material))
    if not fewer:
        return None
    made = sapien.render.RenderBodyComponent()
    made.shading_mode = body.shading_mode
    for shape in shapes:
        made.attach(shape)
    if body.is_render_id_disabled:
        made.disable_render_id()
    return made


def _shape(mesh: Mesh, scale: tuple[float, float, float], like: Any, material: Any) -> Any:
    uvs = np.zeros((len(mesh.vertices), 2), np.float32) if mesh.uvs is None else mesh.uvs
    normals: Any = mesh.normals
    shape = sapien.render.RenderShapeTriangleMesh(mesh.vertices, mesh.faces, normals, uvs, material)
    shape.set_scale(scale)
    shape.local_pose = like.local_pose
    shape.front_face = like.front_face if hasattr(like, "front_face") else "counterclockwise"
    shape.name = like.name
    return shape


def _faces(body: Any) -> int:
    return sum(len(part.triangles) for shape in body.render_shapes if _is_mesh(shape) for part in shape.parts)


def _is_mesh(shape: Any) -> bool:
    return isinstance(shape, sapien.render.RenderShapeTriangleMesh)


def _shared_name(entity: Any, env: int) -> str:
    """The name without ManiSkill's prefix of the env, so that a body is equally fine in all envs."""
    return entity.name.removeprefix(f"scene-{env}-").removeprefix(f"scene-{env}_")


def _pixel(camera: sapien.render.RenderCameraComponent) -> float:
    """Radians of a pixel in the middle of the picture."""
    k = camera.get_intrinsic_matrix()
    return 1.0 / float(max(k[0, 0], k[1, 1]))


def _distance(point: NDArray[np.float32], box: NDArray[np.float32]) -> float:
    return float(np.linalg.norm(np.maximum(0.0, np.maximum(box[0] - point, point - box[1]))))


def _rounded(tolerance: float) -> float:
    if tolerance < _FINEST:
        return tolerance
    return _FINEST * 2.0 ** np.floor(np.log2(tolerance / _FINEST))
