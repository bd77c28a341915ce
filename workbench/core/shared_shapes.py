"""Shapes that look the same, kept once, wherever they were read.

Recordings of one task hold the same robot and the same table each; a texture is some megabytes, and sixty recordings
that are open side by side would be half a gigabyte of them. What looks the same is known by a digest of all that is
seen of it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from workbench.core.geometry import Material, Mesh, SceneGeometry, Visual


def fingerprint(visuals: tuple[Visual, ...]) -> str:
    """The same for visuals that look the same, also when another load made them anew."""
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
    """What was read so far. Not thread-safe."""

    def __init__(self) -> None:
        self._known: dict[str, tuple[Mesh, Material]] = {}

    def share(self, geometry: SceneGeometry) -> SceneGeometry:
        """The same scene, with meshes and materials of earlier ones where they look the same."""
        return replace(geometry, visuals=tuple(self._shared(geometry.visuals)))

    def _shared(self, visuals: Iterable[Visual]) -> Iterable[Visual]:
        for visual in visuals:
            mesh, material = self._known.setdefault(fingerprint((visual,)), (visual.mesh, visual.material))
            yield replace(visual, mesh=mesh, material=material)
