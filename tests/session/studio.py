"""The cameras of the example task, and what a session says of them."""

from __future__ import annotations

from collections.abc import Callable

from workbench.core.camera_settings import CameraKey
from workbench.session.session import Session
from workbench.session.studio_view import StudioCamera, StudioView
from workbench.session.view import SessionView

BASE: CameraKey = ("sensor", "base_camera")

PEOPLE: CameraKey = ("human", "render_camera")


def moved(view: SessionView) -> set[CameraKey]:
    return {camera.key for camera in view.studio.cameras if camera.moved}


def camera(session: Session, key: CameraKey) -> StudioCamera:
    found = session.view().studio.camera(key)
    assert found is not None
    return found


def said(what: Callable[[StudioView], bool]) -> Callable[[SessionView], bool]:
    return lambda view: what(view.studio)
