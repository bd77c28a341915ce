"""Replaces constant metallic textures by numbers: SAPIEN's shaders look a texture up for every pixel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import sapien.render

_VALUES = (
    "base_color",
    "emission",
    "roughness",
    "metallic",
    "specular",
    "ior",
    "transmission",
    "transmission_roughness",
)
_TEXTURES = ("base_color", "emission", "normal", "roughness", "metallic", "transmission")
_KNOWN_FORMATS = ("R8G8B8A8Unorm", "R8Unorm")
_MAX_READ_TEXELS = 1 << 24
"""Maximum texels that are read per scene: a million takes 10 to 20 ms, and a furnished house has hundreds of
millions."""


@dataclass(frozen=True)
class LeanBody:
    """Copy of an exact component with the same meshes and its own materials."""

    component: sapien.render.RenderBodyComponent
    _exact: list[Any]
    """Materials of the exact component."""
    _copied: list[list[Any]]
    """Values of these materials when they were copied."""

    def is_like_exact(self) -> bool:
        """Whether the exact materials are unchanged. If not, the exact body must be drawn.

        SAPIEN does not draw every change that is made to a material while its body is hidden.
        """
        now = [_read(material) for material in self._exact]
        return all(map(_equal, now, self._copied))


class LeanMaterials:
    """Makes each `LeanBody` of a scene, whose envs share the textures of their files."""

    def __init__(self) -> None:
        self._constants: list[tuple[Any, float | None]] = []
        """Textures with their constant value; a list, since a texture has no hash. A texture that the author changes in
        place is not read again."""
        self._texels = 0
        """Number of texels read so far."""

    def lean_copy(self, body: Any) -> LeanBody | None:
        """A copy of a body without its constant metallic textures; None if the body has no such texture, or
        has a mesh that is not from a file.

        In SAPIEN, a mesh that is not from a file shares its materials with its copies, and has no tangents
        for normal maps.
        """
        parts = [part for shape in body.render_shapes for part in shape.parts]
        if all(self._metallic(part.material) is None for part in parts):
            return None
        made = sapien.render.RenderBodyComponent()
        made.shading_mode = body.shading_mode
        if body.is_render_id_disabled:
            made.disable_render_id()
        copies = []
        for shape in body.render_shapes:
            copy = _from_file(shape)
            if copy is None:
                return None
            made.attach(copy)
            copies += copy.parts
        exact = [part.material for part in parts]
        for material, copy in zip(exact, copies, strict=True):
            self._copy(material, copy.material)
        return LeanBody(made, exact, [_read(material) for material in exact])

    def _copy(self, material: Any, to: Any) -> None:
        for name in _VALUES:
            setattr(to, name, getattr(material, name))
        for name in _TEXTURES:
            setattr(to, f"{name}_texture", getattr(material, f"{name}_texture"))
        metallic = self._metallic(material)
        if metallic is not None:
            to.metallic_texture, to.metallic = None, metallic

    def _metallic(self, material: Any) -> float | None:
        """The value that replaces a material's metallic texture; None if that texture is not constant."""
        texture = material.metallic_texture
        if texture is None:
            return None
        for known, value in self._constants:
            if known == texture:
                return value
        self._texels += texture.width * texture.height
        value = _constant(texture) if self._texels <= _MAX_READ_TEXELS else None
        self._constants.append((texture, value))
        return value


def _constant(texture: Any) -> float | None:
    """The value 0..1 that red and blue have in all texels; None if the values differ. SAPIEN reads the
    metallic value from red of a picture, and from blue of a glTF file's texture, which has the roughness in
    green."""
    if texture.is_srgb or texture.format not in _KNOWN_FORMATS:
        return None
    pixels = np.asarray(texture.download())
    read = pixels.reshape(-1, pixels.shape[-1])[:, ::2]
    return float(read[0, 0]) / 255 if len(read) and (read == read[0, 0]).all() else None


def _from_file(shape: Any) -> Any:
    """Copy of a shape, with materials of its own; None if the shape is not from a file, or differs from its
    file."""
    if not isinstance(shape, sapien.render.RenderShapeTriangleMesh) or not shape.filename:
        return None
    try:
        copy = sapien.render.RenderShapeTriangleMesh(shape.filename, shape.scale)
    except RuntimeError:  # the file is gone
        return None
    same = len(copy.parts) == len(shape.parts) and all(
        np.array_equal(one.vertices, other.vertices) and np.array_equal(one.triangles, other.triangles)
        for one, other in zip(copy.parts, shape.parts)
    )
    if not same:
        return None
    copy.local_pose = shape.local_pose
    copy.front_face = shape.front_face
    copy.name = shape.name
    return copy


def _read(material: Any) -> list[Any]:
    return [getattr(material, name) for name in _VALUES] + [
        getattr(material, f"{name}_texture") for name in _TEXTURES
    ]


def _equal(some: list[Any], others: list[Any]) -> bool:
    # A texture cannot be compared with None.
    return all(
        (one is None) == (other is None) and (one is None or one == other)
        for one, other in zip(some, others, strict=True)
    )
