"""Converts the shapes of a scene to GLB, grouped and simplified for the browser."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from workbench.envs.scene.shapes import Material, Mesh, SceneGeometry, Visual

MAX_TEXTURE_PIXELS = 1024
"""Maximum side of a texture. A page loads every texture before it shows anything; 4k scans are megabytes each."""


MIN_LIGHT_MEAN = 0.6
"""Minimum mean of the sRGB channels of a light floor."""
DARKNESS_KEPT = 0.3
"""Share of a dark floor's darkness that stays in the light theme."""

LAYER_METRES = 4e-4
"""Distance between painted layers; two steps of a 24-bit depth buffer at ten metres."""


@dataclass(frozen=True)
class VisualGroup:
    """Visuals with the same (env, body) pairs, drawn as one node.

    A frame then costs two messages per link instead of two per part; viser splits a frame of more than 128 messages.
    """

    name: str
    visuals: tuple[Visual, ...]
    envs: NDArray[np.int32]
    """(K,) indices of the envs."""
    bodies: NDArray[np.int32]
    """(K,) indices of the bodies."""


def group_visuals(geometry: SceneGeometry) -> tuple[VisualGroup, ...]:
    """The visuals of a scene, grouped by the (env, body) pairs that have them."""
    groups: dict[tuple[bytes, bytes], list[Visual]] = {}
    for visual in geometry.visuals:
        if len(visual.mesh.faces):
            key = (visual.envs.tobytes(), visual.bodies.tobytes())
            groups.setdefault(key, []).append(visual)
    return tuple(
        VisualGroup(name=group[0].name, visuals=tuple(group), envs=group[0].envs, bodies=group[0].bodies)
        for group in groups.values()
    )


def face_limit(visuals: tuple[Visual, ...], shown_envs: int, num_envs: int, budget: int) -> int:
    """The largest number of triangles per visual with which all shown instances together stay within the
    budget; at least 200, even if that exceeds the budget.

    Simple shapes keep all triangles; only shapes with many triangles are reduced.
    """
    faces = np.array([len(visual.mesh.faces) for visual in visuals], np.int64)
    shown = np.array([len(visual.envs) for visual in visuals], np.int64) * shown_envs / num_envs
    fewest, most = 200, int(max(faces.max(initial=0), 200))
    while fewest < most:
        limit = (fewest + most + 1) // 2
        if (np.minimum(faces, limit) * shown).sum() <= budget:
            fewest = limit
        else:
            most = limit - 1
    return fewest


def as_glb(parts: list[tuple[Mesh, Material]]) -> bytes:
    """One GLB with these parts, in the frame of their body.

    viser draws plain triangles in one colour without normals (a box is shaded like a ball), or a GLB with textures, metal
    and roughness; hence GLB for everything. The browser merges the parts into one buffer and refuses parts with different
    attributes: normals are always written, texture coordinates if any part has them.
    """
    textured = any(mesh.uvs is not None for mesh, _ in parts)
    parts = list(zip(lift_painted_layers([mesh for mesh, _ in parts]), [m for _, m in parts], strict=True))
    scene = trimesh.Scene()
    for number, (mesh, material) in enumerate(parts):
        solid = trimesh.Trimesh(
            mesh.vertices, mesh.faces, vertex_normals=mesh.normals, process=False, validate=False
        )
        if mesh.normals is None:
            # Reading the normals fills the cache, and only cached normals are exported.
            _ = solid.vertex_normals
        uvs = np.zeros((len(mesh.vertices), 2), np.float32) if mesh.uvs is None else mesh.uvs.copy()
        # trimesh counts v from the bottom of the image and flips it for glTF, which counts from the top like SAPIEN:
        # without this every texture would be upside down.
        uvs[:, 1] = 1.0 - uvs[:, 1]
        solid.visual = TextureVisuals(uv=uvs if textured else None, material=_pbr(material, number))
        scene.add_geometry(solid, geom_name=str(number))
    glb = scene.export(file_type="glb", include_normals=True)
    assert isinstance(glb, bytes)
    return glb


def lift_painted_layers(meshes: list[Mesh]) -> list[Mesh]:
    """Separate stacked thin layers of one body as far as a browser's depth buffer needs.

    ManiSkill paints its targets as discs that rise by a hundredth of a millimetre each. SAPIEN's float depth buffer
    separates them; a browser's 24 bits do not, and the rings turn into noise. Layers thinner than a millimetre are moved
    along their thin axis so that each is `LAYER_METRES` beyond the previous one; thicker parts stay.
    """
    layers: dict[int, list[int]] = {}
    for number, mesh in enumerate(meshes):
        if len(mesh.vertices):
            extent = np.ptp(mesh.vertices, axis=0)
            if extent.min() < 1e-3 and extent.max() > 20 * extent.min():
                layers.setdefault(int(extent.argmin()), []).append(number)
    lifted = list(meshes)
    for axis, numbers in layers.items():
        if len(numbers) < 2:
            continue
        numbers = sorted(numbers, key=lambda n: np.abs(meshes[n].vertices[:, axis]).max())
        for rank, number in enumerate(numbers):
            mesh = meshes[number]
            vertices = mesh.vertices.copy()
            vertices[:, axis] += np.sign(vertices[:, axis]) * rank * LAYER_METRES
            lifted[number] = replace(mesh, vertices=vertices)
    return lifted


def lightened(material: Material) -> Material:
    """A dark material lightened, so that a floor fits the light theme; a light material unchanged."""
    if material.texture is not None:
        rgb = material.texture[..., :3]
        if rgb.mean() >= 255 * MIN_LIGHT_MEAN:
            return material
        lighter = np.concatenate([(255 - (255 - rgb) * DARKNESS_KEPT), material.texture[..., 3:]], axis=-1)
        return replace(material, texture=lighter.astype(np.uint8))
    if np.mean(material.srgb_color[:3]) >= MIN_LIGHT_MEAN:
        return material
    red, green, blue = (1 - (1 - c) * DARKNESS_KEPT**2 for c in material.base_color[:3])
    return replace(material, base_color=(red, green, blue, material.base_color[3]))


def _pbr(material: Material, number: int) -> PBRMaterial:
    red, green, blue, alpha = (float(np.clip(c, 0.0, 1.0)) for c in material.base_color)
    texture = None if material.texture is None else _texture(material.texture)
    see_through = alpha < 0.999 or (texture is not None and texture.mode == "RGBA")
    return PBRMaterial(
        name=f"part {number}",
        baseColorFactor=[red, green, blue, alpha],
        baseColorTexture=texture,
        # Limited: metal shows only reflections, and the page has no environment to reflect.
        metallicFactor=float(np.clip(material.metallic, 0.0, 0.4)),
        roughnessFactor=float(np.clip(material.roughness, 0.0, 1.0)),
        alphaMode="BLEND" if see_through else "OPAQUE",
        # Robot meshes are often open shells with mixed winding: single-sided they would have holes.
        doubleSided=True,
    )


def _texture(pixels: NDArray[np.uint8]) -> Image.Image:
    image = Image.fromarray(pixels[..., :3])
    if pixels.shape[-1] == 4 and pixels[..., 3].min() < 255:
        image = Image.fromarray(pixels)
    if max(image.size) > MAX_TEXTURE_PIXELS:
        image.thumbnail((MAX_TEXTURE_PIXELS, MAX_TEXTURE_PIXELS), Image.Resampling.LANCZOS)
    if image.mode == "RGB":
        # trimesh writes JPEG only if the image has that format; a PNG of a photograph is five times the size.
        image.format = "JPEG"
    return image
