"""Simplified shapes for fast pictures, which may differ a little from exact ones."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np
import sapien
import sapien.render
from numpy.typing import NDArray

from workbench.envs.rendering.in_view import (
    Planes,
    box_corners,
    corners_of,
    cut_to_view,
    fixed_to,
    is_outside,
    outside_and_inside,
    planes_of,
)
from workbench.envs.rendering.lean_materials import LeanBody, LeanMaterials
from workbench.envs.scene.mesh_levels import are_known, within
from workbench.envs.scene.read_scene import exact_part
from workbench.envs.scene.shapes import Mesh
from workbench.envs.scene.simplify import drop_uvs
from workbench.envs.simulation.drawn_poses import NOWHERE_ELSE, Places

HEAVY_FACES = 500
"""Triangles above which a body's mesh is simplified. Cylinders, spheres and the like always stay exact: layered thin
discs, such as ManiSkill's targets, would lose a layer."""
TOLERANCE_PIXELS = 0.6
"""Pixels that a surface may be off in a picture with sides of `_TOLERANCE_SIDE_PIXELS`; more in larger pictures, where a
smaller share of the pixels is on edges."""
_TOLERANCE_SIDE_PIXELS = 128
_MIN_DISTANCE_METRES = 0.02
"""Smallest distance that tolerances assume: no camera stays nearer for long, and a camera inside its own mount would
forbid any simplification."""
_TOLERANCE_UNIT_METRES = 1e-4
"""Tolerances above this value are rounded down to the value times a power of the fourth root of two, so that
similar poses give the same meshes."""

_MIN_LEAN_PIXELS = 256 * 256
"""In a picture with fewer pixels, leaving out textures saves less time than checking whether the author
changed the material."""
_SAME_POSE_TOLERANCES = 1e-5, 1e-4
"""Tolerances in metres and (roughly) radians: a body that moved less, as seen from a camera, counts as not moved."""

Bodies = tuple[tuple[sapien.render.RenderBodyComponent, sapien.render.RenderBodyComponent | None], ...]
"""For each body of an env that is drawn differently: its exact component, and the component to draw instead
(None for nothing)."""


@contextmanager
def shown(bodies: Bodies) -> Iterator[None]:
    """Context in which simplified shapes are drawn instead of the exact ones, with the same visibility."""
    was = [exact.visibility for exact, _ in bodies]
    try:
        for (exact, fast), visibility in zip(bodies, was, strict=True):
            if fast is not None:
                fast.visibility = visibility
            exact.visibility = 0.0
        yield
    finally:
        for (exact, fast), visibility in zip(bodies, was, strict=True):
            exact.visibility = visibility
            if fast is not None:
                fast.visibility = 0.0


class FastShapes:
    """The simplified shapes of a scene: hidden components next to the exact ones, made at each camera's first fast picture.

    How much a body is simplified depends on its distance from the camera at that moment, on the lens and on
    the picture's size in pixels. Bodies outside the camera's view are not drawn. A body that the camera is
    fixed to is cut to the triangles in view, since most of its triangles never come into view. The shapes
    share the materials of the exact ones, so that a later change of colour changes both; a body's id in
    segmentation pictures is that of its entity.
    """

    def __init__(self, sub_scenes: Sequence[sapien.Scene]) -> None:
        self._heavy = [[(body.entity, body) for body in heavy_bodies(scene)] for scene in sub_scenes]
        self._lean = _lean_bodies(sub_scenes)
        self._chosen = _Chosen()
        self._parts = {id(body): tuple(_parts_of(body)) for _, body in chain.from_iterable(self._heavy)}
        self._corner_points = [[self._corners_of_parts(body) for _, body in of_env] for of_env in self._heavy]
        """(P, 3) corner points of each body of each env, in the frame of the body."""
        self._boxes = [
            np.array([(points.min(axis=0), points.max(axis=0)) for points in of_env], np.float32)
            for of_env in self._corner_points
        ]
        """(B, 2, 3) bounding boxes of each env, in the frames of its bodies."""
        self._components: dict[Hashable, tuple[Any, Any]] = {}
        """Each exact component (kept alive), with the simplified one. The key is the id of the exact one, and
        the tolerance or the camera to whose view it is cut."""
        self._tolerances: dict[Hashable, dict[str, float]] = {}
        """Tolerances by camera and name of the body."""
        self._cut: dict[tuple[Hashable, str], _Cut] = {}
        """Cuts by camera and name of a body that the camera is fixed to."""
        self._corners: dict[tuple[int, float], NDArray[np.float64]] = {}
        """Corners by the id of an exact component and its tolerance."""
        self._of_camera: dict[tuple[Hashable, int], Bodies] = {}
        """Chosen bodies by camera and env."""

    def prepare(
        self,
        env: int,
        key: Hashable,
        camera: Sequence[sapien.render.RenderCameraComponent],
        places: Places = NOWHERE_ELSE,
    ) -> None:
        """Choose the shapes that this camera draws, by the present poses; call it before ``update_render``.

        Args:
            key: name of the camera.
            camera: the camera's component in each env.
            places: poses at which bodies of this env are drawn instead of their simulated poses; the cameras
                on these bodies are at `places` already.
        """
        if key not in self._tolerances:
            self._tolerances[key] = self._tolerances_of(camera)
        component, of_env = camera[env], self._heavy[env]
        drawn: list[tuple[Any, Any]] = []
        if component.width * component.height >= _MIN_LEAN_PIXELS:
            drawn += [(body, lean.component) for body, lean in self._lean[env] if lean.is_like_exact()]
        if of_env:
            drawn += self._drawn_of_heavy(env, key, component, places)
        self._of_camera[key, env] = tuple(drawn)

    def _drawn_of_heavy(
        self, env: int, key: Hashable, component: sapien.render.RenderCameraComponent, places: Places
    ) -> list[tuple[Any, Any]]:
        of_env = self._heavy[env]
        to_camera = component.get_global_pose().inv()
        poses = [to_camera * _pose(entity, places) for entity, _ in of_env]
        planes = planes_of(component)
        in_bodies = planes @ np.array([pose.to_transformation_matrix() for pose in poses])
        outside, inside = outside_and_inside(self._boxes[env], in_bodies)
        fixed = fixed_to(component.entity)
        drawn: list[tuple[Any, Any]] = []
        sides = zip(outside.tolist(), inside.tolist(), strict=True)
        for (entity, body), (is_out, is_in), pose, here in zip(of_env, sides, poses, in_bodies, strict=True):
            if is_out:
                drawn.append((body, None))
                continue
            name = _shared_name(entity, env)
            if id(entity) in fixed:
                cut = self._cut.get((key, name))
                if cut is None:
                    cut = self._cut[key, name] = _Cut(pose, self._nearest(body, pose, here), planes)
                if cut.is_for(pose, planes):
                    drawn.append((body, self._cut_body(body, key, cut, component, here)))
                    continue
            tolerance = self._tolerances[key][name]
            simplified = self._simplified(body, tolerance)
            # The box of a slanted link may reach into view although the link does not.
            if not is_in and is_outside(self._corners_of(body, tolerance), here):
                drawn.append((body, None))
            elif simplified is not None:
                drawn.append((body, simplified))
        return drawn

    def bodies(self, key: Hashable, env: int) -> Bodies:
        """The bodies that `prepare` chose last for this camera."""
        return self._of_camera.get((key, env), ())

    def remove(self) -> None:
        """Remove the shapes from the scene."""
        for _, fast in self._components.values():
            if fast is not None:
                fast.entity.remove_component(fast)
        for body, lean in chain.from_iterable(self._lean):
            body.entity.remove_component(lean.component)
        self._lean = [[] for _ in self._lean]
        self._components.clear()
        self._corners.clear()
        self._of_camera.clear()
        self._tolerances.clear()
        self._cut.clear()

    def _tolerances_of(self, camera: Sequence[sapien.render.RenderCameraComponent]) -> dict[str, float]:
        """Tolerances in metres, by body name; the same in all envs, so that equal states look the same."""
        finest: dict[str, float] = {}
        for env, (component, of_env) in enumerate(zip(camera, self._heavy, strict=True)):
            position = np.asarray(component.get_global_pose().p, np.float32)
            for (entity, _), points in zip(of_env, self._corner_points[env], strict=True):
                name = _shared_name(entity, env)
                # Faster than SAPIEN's `get_global_aabb_fast`, which visits all vertices each time: a millisecond per link.
                at = _moved(points, entity.pose.to_transformation_matrix())
                off = _tolerance(component, _distance(position, at.min(axis=0), at.max(axis=0)))
                finest[name] = min(finest.get(name, np.inf), off)
        return {name: _rounded(off) for name, off in finest.items()}

    def _corners_of_parts(self, body: Any) -> NDArray[np.float64]:
        """(P, 3) corners of the boxes around the parts of a drawn body, in its frame."""
        parts = self._parts[id(body)]
        return np.concatenate([_moved(self._chosen.box(part.exact), part.placed) for part in parts])

    def _corners_of(self, body: Any, tolerance: float) -> NDArray[np.float64]:
        """(P, 3) points around the body as drawn with this tolerance, in its frame."""
        by = (id(body), tolerance)
        if by not in self._corners:
            each = [
                _moved(self._chosen.corners(self._chosen.mesh(part, tolerance)), part.placed)
                for part in self._parts[id(body)]
            ]
            self._corners[by] = np.concatenate(each)
        return self._corners[by]

    def _nearest(self, body: Any, pose: sapien.Pose, planes: Planes) -> float:
        """Metres from the camera to the nearest vertex of a triangle in view; infinite if none is in view.

        Args:
            pose: pose of the body, in the camera's frame.
            planes: view planes of the camera, in the body's frame.
        """
        eye, nearest = np.asarray(pose.inv().p), np.inf
        for part in self._parts[id(body)]:
            seen = cut_to_view(part.exact, planes @ part.placed).vertices
            if len(seen):
                at = _moved(seen, part.placed)
                nearest = min(nearest, float(np.linalg.norm(at - eye, axis=1).min()))
        return nearest

    def _cut_body(self, body: Any, key: Hashable, cut: _Cut, camera: Any, planes: Planes) -> Any:
        if not np.isfinite(cut.nearest):
            return None
        by = (id(body), key)
        if by not in self._components:
            tolerance = _rounded(_tolerance(camera, cut.nearest))
            made = _simplified(body, self._parts[id(body)], tolerance, self._chosen, planes)
            self._add(by, body, made)
        return self._components[by][1]

    def _simplified(self, body: Any, tolerance: float) -> sapien.render.RenderBodyComponent | None:
        by = (id(body), tolerance)
        if by not in self._components:
            self._add(by, body, _simplified(body, self._parts[id(body)], tolerance, self._chosen))
        return self._components[by][1]

    def _add(self, by: Hashable, body: Any, made: sapien.render.RenderBodyComponent | None) -> None:
        self._components[by] = body, made
        if made is not None:
            _add_hidden(made, body)


def _add_hidden(component: Any, body: Any) -> None:
    component.visibility = 0.0
    body.entity.add_component(component)


def _lean_bodies(sub_scenes: Sequence[sapien.Scene]) -> list[list[tuple[Any, LeanBody]]]:
    """Bodies of each env that are not simplified, each with the `LeanBody` to draw instead."""
    materials, found = LeanMaterials(), []
    for sub_scene in sub_scenes:
        light = [body for body in _bodies(sub_scene) if not _is_heavy(body)]
        made = [(body, lean) for body in light if (lean := materials.lean_copy(body)) is not None]
        for body, lean in made:
            _add_hidden(lean.component, body)
        found.append(made)
    return found


@dataclass(frozen=True)
class _Cut:
    """Pose of a body relative to the camera when it was cut to the view."""

    pose: sapien.Pose
    nearest: float
    """Metres to the nearest point in view; infinite where nothing is in view."""
    planes: Planes

    def is_for(self, pose: sapien.Pose, planes: Planes) -> bool:
        """Whether the cut is still right for a body at this pose, seen through this lens."""
        off = np.abs(np.asarray(pose.p) - np.asarray(self.pose.p)).max()
        now, then = np.asarray(pose.q), np.asarray(self.pose.q)
        # A quaternion and its negative are one rotation.
        turned = min(np.abs(now - then).max(), np.abs(now + then).max())
        return (
            off <= _SAME_POSE_TOLERANCES[0]
            and turned <= _SAME_POSE_TOLERANCES[1]
            and np.array_equal(planes, self.planes)
        )


def _pose(entity: sapien.Entity, places: Places) -> sapien.Pose:
    """Pose at which an entity is drawn."""
    if id(entity) not in places:
        return entity.pose
    pose = places[id(entity)][1]
    return sapien.Pose(pose[:3], pose[3:])  # type: ignore[arg-type]


def heavy_bodies(sub_scene: sapien.Scene) -> Iterator[sapien.render.RenderBodyComponent]:
    """The bodies with so many triangles that they are simplified; not those with normal maps."""
    return filter(_is_heavy, _bodies(sub_scene))


def _is_heavy(body: Any) -> bool:
    return _faces(body) > HEAVY_FACES and not _has_tangents(body)


def _bodies(sub_scene: sapien.Scene) -> Iterator[Any]:
    for entity in sub_scene.entities:
        body = entity.find_component_by_type(sapien.render.RenderBodyComponent)
        if body is not None:
            yield body


def unknown_meshes(sub_scenes: Sequence[sapien.Scene]) -> list[Mesh]:
    """Meshes of heavy bodies that were not simplified on this machine yet. Simplifying those of a robot takes
    seconds."""
    found: dict[int, Mesh] = {}
    for sub_scene in sub_scenes:
        for body in heavy_bodies(sub_scene):
            for shape in filter(_is_mesh, body.render_shapes):
                for index, part in enumerate(shape.parts):
                    mesh = exact_part(shape, part, index)[0]
                    found[id(mesh)] = mesh if _is_textured(part.material) else drop_uvs(mesh)
    return [mesh for mesh in found.values() if not are_known(mesh)]


def _has_tangents(body: Any) -> bool:
    """Whether a part has a normal map, whose tangents SAPIEN makes only for meshes from files."""
    return any(
        part.material.normal_texture is not None for shape in body.render_shapes for part in shape.parts
    )


@dataclass(frozen=True)
class _Part:
    """Part of a drawn body: its shape, exact mesh and scale."""

    shape: Any
    part: Any
    """SAPIEN's shape part; the author may exchange its material."""
    exact: Mesh
    scale: tuple[float, float, float]
    placed: NDArray[np.float64]
    """(4, 4) transform from points of the mesh, including its scale, to the body's frame."""

    @property
    def material(self) -> Any:
        return self.part.material


def _parts_of(body: Any) -> Iterator[_Part]:
    for shape in body.render_shapes:
        frame = shape.local_pose.to_transformation_matrix().astype(np.float64)
        for index, part in enumerate(shape.parts):
            exact, scale = exact_part(shape, part, index)
            yield _Part(shape, part, exact, scale, frame @ np.diag([*scale, 1.0]))


def _moved(points: NDArray[np.floating], by: NDArray[np.floating]) -> NDArray[np.float64]:
    return points @ by[:3, :3].T + by[:3, 3]


class _Chosen:
    """Cache of simplified meshes by exact mesh, which all envs often share."""

    def __init__(self) -> None:
        self._made: dict[tuple[int, bool, float], tuple[Mesh, Mesh]] = {}
        self._boxes: dict[int, tuple[Mesh, NDArray[np.float64]]] = {}
        self._corners: dict[int, tuple[Mesh, NDArray[np.float64]]] = {}

    def box(self, exact: Mesh) -> NDArray[np.float64]:
        """(8, 3) corners of the mesh's bounding box."""
        if id(exact) not in self._boxes:
            self._boxes[id(exact)] = exact, box_corners(exact.vertices)
        return self._boxes[id(exact)][1]

    def corners(self, mesh: Mesh) -> NDArray[np.float64]:
        """(P, 3) corner points around the mesh."""
        if id(mesh) not in self._corners:
            self._corners[id(mesh)] = mesh, corners_of(mesh.vertices)
        return self._corners[id(mesh)][1]

    def mesh(self, part: _Part, tolerance: float) -> Mesh:
        """The mesh of a part of a body, simplified with an error of at most `tolerance` metres."""
        largest = max(map(abs, part.scale))
        if largest == 0 or not _is_mesh(part.shape):
            return part.exact
        textured = _is_textured(part.material)
        key = (id(part.exact), textured, tolerance / largest)
        if key not in self._made:
            mesh = part.exact if textured else drop_uvs(part.exact)
            # Stored with the exact mesh, so that its id is not reused.
            self._made[key] = part.exact, within(mesh, tolerance / largest)
        return self._made[key][1]


def _is_textured(material: Any) -> bool:
    kinds = ("base_color", "roughness", "metallic", "normal", "emission", "transmission")
    return any(getattr(material, f"{kind}_texture") is not None for kind in kinds)


def _simplified(
    body: Any,
    parts: Sequence[_Part],
    tolerance: float,
    chosen: _Chosen,
    planes: Planes | None = None,
) -> sapien.render.RenderBodyComponent | None:
    """A simplified copy of a body; None where no part can be simplified, or nothing is in view.

    Args:
        planes: view planes in the body's frame to which its triangles are cut; None for all triangles.
    """
    shapes, fewer = [], False
    for part in parts:
        mesh = chosen.mesh(part, tolerance)
        if planes is not None:
            mesh = cut_to_view(mesh, planes @ part.placed)
        fewer |= len(mesh.faces) < len(part.exact.faces)
        if len(mesh.faces):
            shapes.append(_shape(mesh, part))
    if not shapes or (planes is None and not fewer):
        return None
    made = sapien.render.RenderBodyComponent()
    made.shading_mode = body.shading_mode
    for shape in shapes:
        made.attach(shape)
    if body.is_render_id_disabled:
        made.disable_render_id()
    return made


def _shape(mesh: Mesh, like: _Part) -> Any:
    uvs = np.zeros((len(mesh.vertices), 2), np.float32) if mesh.uvs is None else mesh.uvs
    normals: Any = mesh.normals
    shape = sapien.render.RenderShapeTriangleMesh(mesh.vertices, mesh.faces, normals, uvs, like.material)
    shape.set_scale(like.scale)
    shape.local_pose = like.shape.local_pose
    shape.front_face = like.shape.front_face if hasattr(like.shape, "front_face") else "counterclockwise"
    shape.name = like.shape.name
    return shape


def _faces(body: Any) -> int:
    return sum(len(part.triangles) for shape in body.render_shapes if _is_mesh(shape) for part in shape.parts)


def _is_mesh(shape: Any) -> bool:
    return isinstance(shape, sapien.render.RenderShapeTriangleMesh)


def _shared_name(entity: Any, env: int) -> str:
    """The name without ManiSkill's env prefix, so that a body has the same tolerance in all envs."""
    return entity.name.removeprefix(f"scene-{env}-").removeprefix(f"scene-{env}_")


def _tolerance(camera: sapien.render.RenderCameraComponent, distance: float) -> float:
    """Metres that a surface at this distance may be off."""
    pixels_off = TOLERANCE_PIXELS * max(1.0, camera.height / _TOLERANCE_SIDE_PIXELS) ** 0.5
    return pixels_off * _pixel(camera) * max(distance, _MIN_DISTANCE_METRES)


def _pixel(camera: sapien.render.RenderCameraComponent) -> float:
    """Angle that a pixel in the middle of the picture covers, in radians."""
    k = camera.get_intrinsic_matrix()
    return 1.0 / float(max(k[0, 0], k[1, 1]))


def _distance(point: NDArray[np.floating], low: NDArray[np.floating], high: NDArray[np.floating]) -> float:
    """Metres from a point to the box between these corners; 0 inside."""
    return float(np.linalg.norm(np.maximum(0.0, np.maximum(low - point, point - high))))


def _rounded(tolerance: float) -> float:
    if tolerance < _TOLERANCE_UNIT_METRES:
        return tolerance
    return _TOLERANCE_UNIT_METRES * 2.0 ** (np.floor(4 * np.log2(tolerance / _TOLERANCE_UNIT_METRES)) / 4)
