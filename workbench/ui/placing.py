"""The one way from any control of the page to a camera's new place.

A camera is moved with a gizmo, with keys, by typing, from where the viewer looks. All of them end here, since all
need the same three things: the camera that is chosen (and a sentence if none is, or if it cannot be placed), the
frame in which its numbers are said, and which calls are one movement, so that one undo takes back one movement and
not a fiftieth of it.
"""

from __future__ import annotations

import itertools
import threading
import time

import numpy as np
from numpy.typing import NDArray

from workbench.core.camera_settings import CameraKey, CameraSettings
from workbench.session.session import Session
from workbench.session.studio_view import StudioCamera
from workbench.ui.camera_moves import Floats, Frame, target_of, usual_distance

PAUSE = 1.2
"""Seconds. What one hand does after a shorter pause belongs to the same step of undo."""
FARTHEST = 1000.0
"""Metres from the origin that a page may ask for."""


class Placing:
    def __init__(self, session: Session) -> None:
        self._session = session
        self._lock = threading.Lock()
        self._gestures = itertools.count(1)
        self._gesture, self._hand, self._moved_at = 0, "", -1e9
        self._distances: dict[CameraKey, float] = {}
        self.offset: NDArray[np.float32] = np.zeros(3, np.float32)
        """Where the selected env stands in the view."""

    @property
    def camera(self) -> StudioCamera | None:
        """The chosen one, if it can be placed."""
        chosen = self._session.view().studio.chosen
        return None if chosen is None or chosen.refused or chosen.now is None else chosen

    def require(self) -> tuple[StudioCamera, CameraSettings, Frame]:
        """The camera to place, as it is now.

        Raises:
            ValueError: there is none.
        """
        camera = self.camera
        if camera is None or camera.now is None:
            raise ValueError("Choose a camera that can be placed first.")
        return camera, camera.now, self.frame(camera)

    def frame(self, camera: StudioCamera) -> Frame:
        return Frame(camera.mount_pose, self.offset)

    def begin(self) -> None:
        """What comes next is a step of undo of its own."""
        with self._lock:
            self._hand = ""

    def place(self, key: CameraKey, settings: CameraSettings, hand: str) -> None:
        """Place it live.

        Args:
            hand: what moves it. The same hand goes on with its movement unless it paused.

        Raises:
            ValueError: it is too far away for any task.
        """
        if not all(abs(x) <= FARTHEST for x in settings.position):
            raise ValueError(f"A camera stands within {FARTHEST:g} m of the origin.")
        with self._lock:
            now = time.monotonic()
            if hand != self._hand or now - self._moved_at > PAUSE:
                self._gesture = next(self._gestures)
            self._hand, self._moved_at = hand, now
            gesture = self._gesture
        self._session.studio.place(key, settings, gesture)

    # --- the target: a camera has a direction; how far it looks is the page's own knowledge -----------

    def distance(self, camera: StudioCamera) -> float:
        """Metres from the eye to the target."""
        if camera.key not in self._distances and camera.now is not None:
            self._distances[camera.key] = usual_distance(self.frame(camera).to_env(camera.now))
        return self._distances.get(camera.key, 1.0)

    def set_distance(self, key: CameraKey, distance: float) -> None:
        self._distances[key] = max(float(distance), 1e-3)

    def target_in_view(self, camera: StudioCamera, settings: CameraSettings) -> Floats:
        """(3,)"""
        return target_of(self.frame(camera).to_view(settings), self.distance(camera))
