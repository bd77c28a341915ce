"""Draws pictures with SAPIEN under a time limit, and names the camera in errors."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from numpy.typing import NDArray

from workbench.envs.camera_data import CallSite, CameraKey
from workbench.envs.error_notes import CoreRefusal, Place
from workbench.machine.processes.time_limit import PICTURE_SECONDS, limited


class CannotDraw(CoreRefusal, RuntimeError):
    """The renderer failed to draw a camera."""

    def __init__(self, message: str, key: CameraKey, place: Place | None) -> None:
        super().__init__(message, place=place)
        self.key = key


@contextmanager
def drawing(key: CameraKey, site: CallSite | None = None) -> Iterator[None]:
    """Context in which SAPIEN draws a camera, or the caller waits for its picture.

    Args:
        site: where the config of the camera is made.

    Raises:
        CannotDraw: SAPIEN raised.
    """
    camera = _named(key, site)
    late = (
        f"{camera} was not ready after {PICTURE_SECONDS:g} s, so this process is ended. Make the picture "
        "smaller, or run `workbench doctor` to see which driver draws. With --env render_backend=none "
        "nothing is drawn."
    )
    with limited(late):
        try:
            yield
        except CannotDraw:
            raise
        except RuntimeError as error:
            raise CannotDraw(f"{camera} cannot be drawn: {error}", key, _place(site)) from error


def read_texture(component: Any, texture: str, key: CameraKey, site: CallSite | None = None) -> NDArray[Any]:
    """(H, W, C) one texture of a camera component's last picture. Raises like `drawing`, also for an unknown
    texture."""
    with drawing(key, site):
        if texture not in (has := component.get_picture_names()):
            raise CannotDraw(
                f"{_named(key, site)} has no texture {texture!r}. Its shader draws {', '.join(has)}.",
                key,
                _place(site),
            )
        return component.get_picture(texture)


def _named(key: CameraKey, site: CallSite | None) -> str:
    place = "" if site is None else f" ({site.file}:{site.line})"
    return f"The picture of {key[0]} camera {key[1]!r}{place}"


def _place(site: CallSite | None) -> Place | None:
    return None if site is None else (site.file, site.line, site.function.rpartition(".")[2])
