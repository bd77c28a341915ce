"""Shapes that look the same, kept once, wherever they were read.

Recordings of one task hold the same robot and the same table each; a texture is some megabytes, and sixty recordings
that are open side by side would be half a gigabyte of them. What looks the same is known by a digest of all that is
seen of it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Hashable, Iterable
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
        self._marked: dict[Hashable, tuple[str, Mesh, Material]] = {}
        self._kept: dict[tuple[int, int], tuple[Mesh, Material]] = {}
        """By the ids of the two: those that are given out, which need not be looked at again."""

    def share(self, geometry: SceneGeometry) -> SceneGeometry:
        """The same scene, with meshes and materials of earlier ones where they look the same."""
        return replace(geometry, visuals=tuple(self._shared(geometry.visuals)))

    def shared(self, mesh: Mesh, material: Material) -> tuple[Mesh, Material]:
        """An earlier mesh and material that look the same, or these."""
        kept = self._kept.get((id(mesh), id(material)))
        if kept is None:
            none = np.zeros(0, np.int32)
            looks = fingerprint((Visual("", mesh, material, none, none),))
            kept = self._known.setdefault(looks, (mesh, material))
            self._kept[id(kept[0]), id(kept[1])] = kept
        return kept

    def learn(self, mark: Hashable, name: str, mesh: Mesh, material: Material) -> None:
        """What lies in a file under this mark, for who meets the mark again."""
        self._marked[mark] = (name, mesh, material)

    def known(self, mark: Hashable) -> tuple[str, Mesh, Material] | None:
        """What was learnt of that mark: the visual's name and its looks."""
        return self._marked.get(mark)

    def _shared(self, visuals: Iterable[Visual]) -> Iterable[Visual]:
        for visual in visuals:
            mesh, material = self.shared(visual.mesh, visual.material)
            yield replace(visual, mesh=mesh, material=material)
