"""Shapes of the envs: meshes with materials, and the bodies that have them."""

from __future__ import annotations

import hashlib
from collections.abc import Hashable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

BodyKind = Literal["link", "dynamic", "kinematic", "static"]


@dataclass(frozen=True)
class Mesh:
    """Triangles in the frame of their body, with local pose and scale applied."""

    vertices: NDArray[np.float32]
    """(V, 3) metres."""
    faces: NDArray[np.uint32]
    """(F, 3) indices into `vertices`, counter-clockwise seen from outside."""
    normals: NDArray[np.float32] | None = None
    """(V, 3) unit length, or None if the source has none."""
    uvs: NDArray[np.float32] | None = None
    """(V, 2), or None where there is no texture. As in glTF and SAPIEN: (0, 0) is the top left corner
    of the first row, v grows downwards, and values outside 0..1 repeat the texture. trimesh and OBJ
    count v from the bottom: use ``1 - v`` for those."""


@dataclass(frozen=True)
class Material:
    """The part of a SAPIEN ``RenderMaterial`` that a browser can show."""

    base_color: tuple[float, float, float, float]
    """RGBA in 0..1, *linear*, as SAPIEN and glTF (``baseColorFactor``) mean it; see `srgb_color`.
    White where there is a texture, which replaces it."""
    metallic: float = 0.0
    roughness: float = 1.0
    texture: NDArray[np.uint8] | None = None
    """(H, W, 4) RGBA base colour texture, sRGB encoded as in an image file, first row on top."""

    @property
    def srgb_color(self) -> tuple[float, float, float, float]:
        """`base_color` as in CSS: R, G and B encoded as sRGB, alpha unchanged."""
        r, g, b = srgb(np.array(self.base_color[:3])).tolist()
        return r, g, b, self.base_color[3]


def srgb(linear: NDArray[Any]) -> NDArray[Any]:
    """Encode linear colours in 0..1 as sRGB."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


@dataclass(frozen=True)
class Visual:
    """One mesh with one material, and every (env, body) that has it."""

    name: str
    """Readable and unique in the scene, for example ``panda/panda_hand/0``."""
    mesh: Mesh
    material: Material
    envs: NDArray[np.int32]
    """(K,) env index of each instance."""
    bodies: NDArray[np.int32]
    """(K,) body index of each instance."""


@dataclass(frozen=True, eq=False)
class SceneGeometry:
    """Everything about a scene that does not change from frame to frame. Compared by identity.

    A frame is one array, ``poses[env, body] = [x, y, z, qw, qx, qy, qz]`` in the env's own world frame (metres, z up, quaternion
    wxyz), NaN for a body that an env does not have. Equal shapes are one `Visual` with many instances: a browser draws a
    thousand instances of one mesh as fast as one, but is unusable with one node per body.
    """

    num_envs: int
    body_names: tuple[str, ...]
    """(B,) an actor's name, or ``articulation/link``. Merged actors have the merged name."""
    body_kinds: tuple[BodyKind, ...]
    """(B,)"""
    body_hidden: tuple[bool, ...]
    """(B,) whether the task hides the body from sensors (goal markers: ``_hidden_objects``)."""
    visuals: tuple[Visual, ...]
    collisions: tuple[Visual, ...] = ()
    """Collision shapes, coloured by the kind of their body. Empty for a recording, and where `visuals` already
    are collision shapes."""

    @cached_property
    def as_collisions(self) -> SceneGeometry:
        """This scene with the collision shapes in place of the visuals."""
        return replace(self, visuals=self.collisions)

    @property
    def hidden_names(self) -> tuple[str, ...]:
        return tuple(name for name, hidden in zip(self.body_names, self.body_hidden, strict=True) if hidden)


# --- shapes that look the same -----------------------------------------------------------------------


def fingerprint(visuals: tuple[Visual, ...]) -> str:
    """Digest that is equal for visuals that look the same, even across loads."""
    digest = hashlib.blake2b(digest_size=16)
    for visual in visuals:
        mesh, material = visual.mesh, visual.material
        for array in (mesh.vertices, mesh.faces, mesh.normals, mesh.uvs, material.texture):
            if array is not None:
                digest.update(np.ascontiguousarray(array).data)
            digest.update(b"|")
        digest.update(repr((material.base_color, material.metallic, material.roughness)).encode())
    return digest.hexdigest()


class SharedShapes:
    """Cache that stores equal-looking shapes only once, by a digest of everything visible. Not thread-safe.

    A texture takes some megabytes: without the cache, sixty open recordings of one task would hold half a gigabyte.
    """

    def __init__(self) -> None:
        self._known: dict[str, tuple[Mesh, Material]] = {}
        self._marked: dict[Hashable, tuple[str, Mesh, Material]] = {}
        self._kept: dict[tuple[int, int], tuple[Mesh, Material]] = {}
        """Shared shapes by the ids of their mesh and material, so that these need no digest again."""

    def share(self, geometry: SceneGeometry) -> SceneGeometry:
        """Copy of the scene that uses earlier meshes and materials where they look the same."""
        return replace(geometry, visuals=tuple(self._shared(geometry.visuals)))

    def shared(self, mesh: Mesh, material: Material) -> tuple[Mesh, Material]:
        """An earlier mesh and material that look the same, else the given ones."""
        kept = self._kept.get((id(mesh), id(material)))
        if kept is None:
            none = np.zeros(0, np.int32)
            looks = fingerprint((Visual("", mesh, material, none, none),))
            kept = self._known.setdefault(looks, (mesh, material))
            self._kept[id(kept[0]), id(kept[1])] = kept
        return kept

    def learn(self, mark: Hashable, name: str, mesh: Mesh, material: Material) -> None:
        """Store the name, mesh and material of a file under this mark."""
        self._marked[mark] = (name, mesh, material)

    def known(self, mark: Hashable) -> tuple[str, Mesh, Material] | None:
        """Name, mesh and material stored for that mark."""
        return self._marked.get(mark)

    def _shared(self, visuals: Iterable[Visual]) -> Iterable[Visual]:
        for visual in visuals:
            mesh, material = self.shared(visual.mesh, visual.material)
            yield replace(visual, mesh=mesh, material=material)
