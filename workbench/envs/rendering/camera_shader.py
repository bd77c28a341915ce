"""Selects the shader of a camera, keeps it when the camera changes scenes, and replaces a shader that this
machine cannot draw."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache, wraps
from pathlib import Path
from typing import Any, Literal
from weakref import WeakKeyDictionary

import sapien.render
from mani_skill.render import PREBUILT_SHADER_CONFIGS, ShaderConfig, set_shader_pack
from mani_skill.sensors.camera import Camera, CameraConfig

from workbench.envs.backends import why_no_ray_tracing

MINIMAL, DEFAULT = PREBUILT_SHADER_CONFIGS["minimal"], PREBUILT_SHADER_CONFIGS["default"]


@dataclass(frozen=True)
class _Selection:
    """Shader settings of the process. SAPIEN makes a camera with them whenever the camera enters a scene."""

    folder: str
    samples_per_pixel: int
    path_depth: int
    denoiser: Literal["none", "oidn", "optix"]

    @staticmethod
    def now() -> _Selection:
        return _Selection(
            sapien.render.get_camera_shader_dir(),
            sapien.render.get_ray_tracing_samples_per_pixel(),
            sapien.render.get_ray_tracing_path_depth(),
            sapien.render.get_ray_tracing_denoiser(),
        )

    def select(self) -> None:
        if Path(self.folder).name in ("minimal", "default"):
            set_shader_pack(PREBUILT_SHADER_CONFIGS[Path(self.folder).name])  # sets texture formats too
        sapien.render.set_camera_shader_dir(self.folder)
        sapien.render.set_ray_tracing_samples_per_pixel(self.samples_per_pixel)
        sapien.render.set_ray_tracing_path_depth(self.path_depth)
        sapien.render.set_ray_tracing_denoiser(self.denoiser)


_made_with: WeakKeyDictionary[sapien.render.RenderCameraComponent, _Selection] = WeakKeyDictionary()


@contextmanager
def selected(shader: ShaderConfig, folder: Path | None = None) -> Iterator[None]:
    """Context in which SAPIEN makes cameras with `shader`.

    Args:
        folder: folder of a shader that replaces `shader` and has the same textures.
    """
    before = _Selection.now()
    set_shader_pack(shader)
    if folder is not None:
        sapien.render.set_camera_shader_dir(str(folder))
    try:
        yield
    finally:
        before.select()


def note_shader(camera: sapien.render.RenderCameraComponent) -> None:
    """Store the selected shader for `made_again`; call it when the camera is made."""
    _made_with[camera] = _Selection.now()


@contextmanager
def made_again(camera: sapien.render.RenderCameraComponent) -> Iterator[None]:
    """Context in which the camera's shader (see `note_shader`) is selected. Add the camera to a scene in this
    context.

    Without the context, a sensor with the minimal shader would get the default shader if the human camera has
    that one, and would then lack the texture ``PositionSegmentation``.
    """
    before, own = _Selection.now(), _made_with.get(camera)
    if own is None or own == before:
        yield
        return
    own.select()
    try:
        yield
    finally:
        before.select()


# --- machines without ray tracing ------------------------------------------------------------------


def drawable(config: CameraConfig) -> CameraConfig:
    """`config`; or, if it is ray traced and this machine cannot trace rays, a copy with the default shader.

    The default shader has the same textures. ``shader_pack`` of the copy keeps the requested name.
    """
    asked = config.shader_config
    if asked is None or not is_ray_traced(asked.shader_pack) or why_no_ray_tracing() is None:
        return config
    drawn = copy.copy(config)
    # ManiSkill replaces the names rt-fast and rt-med by rt when it applies keywords to a config.
    drawn.shader_pack = next(
        (name for name, of in PREBUILT_SHADER_CONFIGS.items() if of is asked), asked.shader_pack
    )
    drawn.shader_config = replace(
        DEFAULT,
        texture_names={name: of for name, of in asked.texture_names.items() if name in DEFAULT.texture_names},
        texture_transforms=asked.texture_transforms,
    )
    return drawn


def replaced_shader(config: CameraConfig) -> str:
    """The shader pack that `drawable` has replaced; empty if none."""
    asked, drawn = str(config.shader_pack), config.shader_config
    return (
        asked if drawn is not None and is_ray_traced(asked) and not is_ray_traced(drawn.shader_pack) else ""
    )


def is_ray_traced(shader_pack: str) -> bool:
    """Whether a shader pack traces rays, as ManiSkill's ``set_shader_pack`` decides it."""
    return shader_pack[:2] == "rt"


@cache
def install_drawable_cameras(is_batched: Callable[[Any], bool]) -> None:
    """Make ManiSkill build cameras of batched CPU scenes from `drawable` configs, once per process."""
    stock = Camera.__init__

    @wraps(stock)
    def init(self: Camera, camera_config: CameraConfig, scene: Any, *args: Any, **kwargs: Any) -> None:
        stock(self, drawable(camera_config) if is_batched(scene) else camera_config, scene, *args, **kwargs)

    Camera.__init__ = init  # type: ignore[method-assign]
