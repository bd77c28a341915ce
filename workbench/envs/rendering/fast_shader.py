"""Cameras that draw the pictures of SAPIEN's minimal shader, but skip shader work that changes no picture."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import sapien
import sapien.render

from workbench.envs.backends import give_brdf_table
from workbench.envs.rendering.camera_shader import MINIMAL, selected
from workbench.machine.folders import cache_folder, read_private, write_private

COLOR = frozenset({"Color"})
ALL = frozenset({"Color", "PositionSegmentation", "GbufferDepth"})
"""Textures of the minimal shader that a fast camera has: only those of `COLOR`, or all."""

Edits = tuple[tuple[str, str], ...]
"""Replacements in a shader's text: (old, new); each old passage occurs once."""

# These edits leave out the environment map, which would add black: it costs two cube map look-ups per pixel,
# and another look-up in the last pass, which otherwise only copies. The edits also use that w of a position
# is 1, and that the transposed inverse equals the cofactor matrix up to scale.
_VERTICES: Edits = (
    ("mat3(transpose(inverse(modelView)))", "sign(determinant(m)) * mat3(cross(m[1], m[2]), cross(m[2], m[0]), cross(m[0], m[1]))"),
    ("  mat3 normalMatrix", "  mat3 m = mat3(modelView);\n  mat3 normalMatrix"),
    ("layout(location = 3) out vec3 objectCoord;\n", ""),
    ("  objectCoord = position;\n", ""),
    ("layout(location = 0) out vec4 outPosition;", "layout(location = 0) out vec3 outPosition;"),
    ("  outPosition = modelView * vec4(position, 1);", "  vec4 inView = modelView * vec4(position, 1);\n  outPosition = inView.xyz;"),
    ("projectionMatrix * outPosition", "projectionMatrix * inView"),
)  # fmt: skip
_PIXELS: Edits = (
    ("  color += diffuseIBL(diffuseAlbedo, wnormal);\n", ""),
    ("  color += specularIBL(fresnel, roughness,\n", ""),
    ("                       wnormal,\n", ""),
    ("                       mat3(cameraBuffer.viewMatrixInverse) * camDir);\n", ""),
    ("  vec3 wnormal = mat3(cameraBuffer.viewMatrixInverse) * normal;\n", ""),
    ("layout(location = 3) in vec3 objectCoord;\n", ""),
    ("layout(location = 0) in vec4 inPosition;", "layout(location = 0) in vec3 inPosition;"),
    ("    vec4 fdx = dFdx(inPosition);\n    vec4 fdy = dFdy(inPosition);\n", "    vec3 fdx = dFdx(inPosition);\n    vec3 fdy = dFdy(inPosition);\n"),
    ("  vec4 csPosition = inPosition;\n  csPosition /= csPosition.w;\n", "  vec3 csPosition = inPosition;\n"),
    ("out vec4 outColorRaw;", "out vec4 outColor;"),
    ("  outColorRaw = ", "  outColor = "),
)  # fmt: skip
# The same light with less arithmetic: the half vector of two unit vectors follows from their angle.
_LIGHT: Edits = (
    ("  vec3 color = emission.rgb;\n", """  vec3 color = emission.rgb;
  float nv = dot(normal, camDir);
  float alpha = roughness * roughness;
  float alpha2 = alpha * alpha;
  float k = (alpha + 2 * roughness + 1.0) / 8.0;
  float nom1 = clamp(nv, 1e-6, 1) * (1 - k) + k;
"""),
    ("""    color += computeDirectionalLight(
        mat3(cameraBuffer.viewMatrix) * sceneBuffer.directionalLights[i].direction.xyz,
        sceneBuffer.directionalLights[i].emission.rgb,
        normal, camDir, diffuseAlbedo, roughness, fresnel);
""", """    vec3 l = -(mat3(cameraBuffer.viewMatrix) * sceneBuffer.directionalLights[i].direction.xyz);
    float nl = dot(normal, l);
    float lv = dot(camDir, l);
    float perH = inversesqrt(max(2 + 2 * lv, 1e-6));
    float NoH = clamp((nl + nv) * perH, 1e-6, 1);
    float VoH = clamp((1 + lv) * perH, 1e-6, 1);
    float NoL = clamp(nl, 0, 1);
    float nom0 = NoH * NoH * (alpha2 - 1) + 1;
    float nom = clamp(nom0 * nom0 * nom1 * (NoL * (1 - k) + k), 1e-6 / 12.566370614359172, 1);
    vec3 reflected = fresnel + (1 - fresnel) * exp2((-5.55473 * VoH - 6.98316) * VoH);
    vec3 spread = diffuseAlbedo + reflected * (alpha2 / (4 * nom));
    color += sceneBuffer.directionalLights[i].emission.rgb * (NoL / 3.141592653589793 * spread);
"""),
)  # fmt: skip
_COLOR_VERTICES: Edits = (
    ("layout(location = 2) out flat uvec4 outSegmentation;\n", ""),
    ("  outSegmentation = objectDataBuffer.segmentation;\n", ""),
)
_COLOR_PIXELS: Edits = (
    ("layout(location = 2) in flat uvec4 inSegmentation;\n", ""),
    ("layout(location = 1) out ivec4 outPositionSegmentation;\n", ""),
    ("  outPositionSegmentation = ivec4(ivec3(inPosition * 1000), inSegmentation[1]);\n", ""),
)


@lru_cache(maxsize=2)
def shader_folder(textures: frozenset[str]) -> Path | None:
    """Folder of SAPIEN's minimal shader, reduced to these textures (`COLOR` or `ALL`); None if the installed shader is
    unknown."""
    source = Path(sapien.__file__).parent / "vulkan_shader"
    vertices, pixels = _VERTICES, _PIXELS + _LIGHT
    if textures == COLOR:
        vertices, pixels = vertices + _COLOR_VERTICES, pixels + _COLOR_PIXELS
    try:
        files = {
            "common/lights.glsl": (source / "common/lights.glsl").read_text(),
            "common/shadow.glsl": (source / "common/shadow.glsl").read_text(),
            "pack/shadow.vert": (source / "minimal/shadow.vert").read_text(),
            "pack/gbuffer.vert": _edited((source / "minimal/gbuffer.vert").read_text(), vertices),
            "pack/gbuffer.frag": _edited((source / "minimal/gbuffer.frag").read_text(), pixels),
        }
        digest = hashlib.blake2b("\0".join(files.values()).encode(), digest_size=8).hexdigest()
        folder = cache_folder() / f"shader-{digest}"
        for name, text in files.items():
            parent, _, file = name.partition("/")
            if read_private(file, folder / parent) != text.encode():
                write_private(file, text.encode(), folder / parent)
    except (OSError, ValueError):
        return None  # another SAPIEN, or a full disk: the minimal shader is used unchanged
    return folder / "pack"


def _edited(text: str, edits: Edits) -> str:
    for was, becomes in edits:
        if text.count(was) != 1:
            raise ValueError(f"{was!r} does not occur exactly once")
        text = text.replace(was, becomes)
    return text


@dataclass(frozen=True)
class _Fast:
    exact: sapien.render.RenderCameraComponent
    component: sapien.render.RenderCameraComponent
    scene: sapien.Scene
    """Separate scene that shares the render system: an entity in the env's scene would change the order that snapshots
    rely on."""


class FastCameras:
    """For each exact camera of a scene, a second camera of the same size that follows it."""

    def __init__(self, sub_scenes: Sequence[sapien.Scene]) -> None:
        self._sub_scenes = sub_scenes
        self._made: dict[tuple[int, frozenset[str]], _Fast] = {}
        """Fast cameras by the id of the exact component and the textures."""

    def follow(
        self, env: int, config: Any, exact: sapien.render.RenderCameraComponent, textures: Collection[str]
    ) -> None:
        """Move the fast camera for these textures to where `exact` is; call it before ``update_render``.

        Makes no fast camera if the shader is not the minimal one, a texture is not in `ALL`, or there is an
        environment map.

        Args:
            config: ManiSkill's config of the camera.
        """
        chosen = _smallest(textures)
        system = self._sub_scenes[env].render_system
        folder = shader_folder(chosen) if ALL.issuperset(textures) else None
        if folder is None or config.shader_config is not MINIMAL or system.cubemap is not None:
            self._made.pop((id(exact), chosen), None)
            return
        fast = self._made.get((id(exact), chosen))
        if fast is None:
            with selected(MINIMAL, folder):
                fast = self._made[id(exact), chosen] = _make_fast(exact, system)
        fast.component.local_pose = exact.get_global_pose()
        k = exact.get_intrinsic_matrix()
        fast.component.set_perspective_parameters(
            exact.near, exact.far, k[0, 0], k[1, 1], k[0, 2], k[1, 2], k[0, 1]
        )

    def camera_for(
        self, exact: sapien.render.RenderCameraComponent, textures: Collection[str]
    ) -> sapien.render.RenderCameraComponent:
        """The camera with which to draw these textures; `exact` itself if it has no fast camera for them."""
        fast = self._made.get((id(exact), _smallest(textures)))
        return exact if fast is None else fast.component


def _smallest(textures: Collection[str]) -> frozenset[str]:
    return COLOR if COLOR.issuperset(textures) else ALL


def _make_fast(exact: sapien.render.RenderCameraComponent, system: Any) -> _Fast:
    scene, entity = sapien.Scene([system]), sapien.Entity()
    component = sapien.render.RenderCameraComponent(exact.width, exact.height)
    entity.add_component(component)
    scene.add_entity(entity)
    give_brdf_table(component)
    return _Fast(exact, component, scene)
