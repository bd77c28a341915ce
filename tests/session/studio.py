"""The cameras of the example task, and what a session says of them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from tests.ui.scenes import camera as camera_of
from workbench.core.camera_data import CameraKey, CameraSettings
from workbench.core.cameras.conventions import LookAt, pose_from_look_at, with_pose
from workbench.session.cameras.view import StudioCamera, StudioView
from workbench.session.live.session import Session
from workbench.session.live.view import SessionView

BASE: CameraKey = ("sensor", "base_camera")

PEOPLE: CameraKey = ("human", "render_camera")

EYE, TARGET = (0.45, 0.0, 0.6), (0.08, 0.0, 0.2)
"""It looks at something above the ground, which a line of sight does not tell."""
LENS = CameraSettings((0, 0, 0), (1, 0, 0, 0), 1.0, None, 128, 128, 0.01, 10.0, "minimal")
BARE = with_pose(LENS, pose_from_look_at(LookAt(EYE, TARGET)))
"""As a file has it that names no target."""
FILE = replace(BARE, distance=math.dist(EYE, TARGET))
INFO = camera_of()
KEY = INFO.key


def moved(view: SessionView) -> set[CameraKey]:
    return {camera.key for camera in view.studio.cameras if camera.moved}


def camera(session: Session, key: CameraKey) -> StudioCamera:
    found = session.view().studio.camera(key)
    assert found is not None
    return found


def said(what: Callable[[StudioView], bool]) -> Callable[[SessionView], bool]:
    return lambda view: what(view.studio)
