"""Shapes of the scene as GLB, the one mesh format that a browser shows with its true material.

viser draws either bare triangles in one colour or a GLB with textures, metal and roughness. Bare
triangles also lose the normals, so a box with shared corners is shaded like a ball. Hence GLB for
everything. Visuals that the same bodies wear (the parts of one link) go into one file with one
material a part: a frame then costs two messages a link and not two a part, and viser tears a frame
that needs more than 128.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from workbench.core.geometry import Material, Mesh, SceneGeometry, Visual

LARGEST_TEXTURE = 1024
"""Pixels. A page is sent every texture before it shows anything; 4k scans are megabytes each."""


@dataclass(frozen=True)
class WornTogether:
    """Visuals with exactly the same wearers, drawn as one node."""

    name: str
    visuals: tuple[Visual, ...]
    envs: NDArray[np.int32]
    """(K,)"""
    bodies: NDArray[np.int32]
    """(K,)"""


def group_by_wearers(geometry: SceneGeometry) -> tuple[WornTogether, ...]:
    """The visuals of a scene, those that the same (env, body) pairs wear put together."""
    groups: dict[tuple[bytes, bytes], list[Visual]] = {}
    for visual in geometry.visuals:
        if len(visual.mesh.faces):
            key = (visual.envs.tobytes(), visual.bodies.tobytes())
            groups.setdefault(key, []).append(visual)
    return tuple(
        WornTogether(name=group[0].name, visuals=tuple(group), envs=group[0].envs, bodies=group[0].bodies)
        for group in groups.values()
    )


def as_glb(parts: list[tuple[Mesh, Material]]) -> bytes:
    """One GLB of these parts, all in the frame of the body that wears them.

    The browser merges the parts into one buffer and refuses those that differ in which attributes
    they have, so normals are always written, and texture coordinates as soon as one part has some.
    """
    textured = any(mesh.uvs is not None for mesh, _ in parts)
    scene = trimesh.Scene()
    for number, (mesh, material) in enumerate(parts):
        solid = trimesh.Trimesh(
            mesh.vertices, mesh.faces, vertex_normals=mesh.normals, process=False, validate=False
        )
        if mesh.normals is None:
            # Asking for them puts them in the cache, and only cached normals are exported.
            _ = solid.vertex_normals
        uvs = mesh.uvs if mesh.uvs is not None else np.zeros((len(mesh.vertices), 2), np.float32)
        solid.visual = TextureVisuals(uv=uvs if textured else None, material=_pbr(material, number))
        scene.add_geometry(solid, geom_name=str(number))
    return bytes(scene.export(file_type="glb", include_normals=True))


def _pbr(material: Material, number: int) -> PBRMaterial:
    red, green, blue, alpha = (float(np.clip(c, 0.0, 1.0)) for c in material.base_color)
    texture = None if material.texture is None else _texture(material.texture)
    see_through = alpha < 0.999 or (texture is not None and texture.mode == "RGBA")
    return PBRMaterial(
        name=f"part {number}",
        baseColorFactor=[red, green, blue, alpha],
        baseColorTexture=texture,
        metallicFactor=float(np.clip(material.metallic, 0.0, 1.0)),
        roughnessFactor=float(np.clip(material.roughness, 0.0, 1.0)),
        alphaMode="BLEND" if see_through else "OPAQUE",
        # Meshes of robots are often open shells with mixed winding; seen from behind they would
        # have holes.
        doubleSided=True,
    )


def _texture(pixels: NDArray[np.uint8]) -> Image.Image:
    image = Image.fromarray(pixels[..., :3])
    if pixels.shape[-1] == 4 and pixels[..., 3].min() < 255:
        image = Image.fromarray(pixels)
    if max(image.size) > LARGEST_TEXTURE:
        image.thumbnail((LARGEST_TEXTURE, LARGEST_TEXTURE), Image.Resampling.LANCZOS)
    if image.mode == "RGB":
        # trimesh writes an image as JPEG only if it says it is one; a PNG of a photograph is five
        # times the size.
        image.format = "JPEG"
    return image
