"""Selects the shader that SAPIEN makes a camera with, and keeps it for cameras that change scenes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from weakref import WeakKeyDictionary

import sapien.render
from mani_skill.render import PREBUILT_SHADER_CONFIGS, ShaderConfig, set_shader_pack

MINIMAL = PREBUILT_SHADER_CONFIGS["minimal"]


@dataclass(frozen=True)
class _Selection:
    """Shader settings of the process. SAPIEN makes a camera with them whenever the camera enters a scene."""

    folder: str
    samples_per_pixel: int
    path_depth: int
    denoiser: str

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
    """Within this, SAPIEN makes cameras with `shader`.

    Args:
        folder: of a shader that replaces `shader` and has the same textures.
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
    """Remember the shader that is selected now for `made_again`; call it when the camera is made."""
    _made_with[camera] = _Selection.now()


@contextmanager
def made_again(camera: sapien.render.RenderCameraComponent) -> Iterator[None]:
    """Within this, the shader of `note_shader` is selected. Add the camera to a scene within it.

    Without it a task with a minimal sensor and a default human camera gets a default sensor, which lacks
    ``PositionSegmentation``.
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
