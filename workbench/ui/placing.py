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
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from workbench.core.camera_settings import CameraKey, CameraSettings
from workbench.session.session import Session
from workbench.session.studio_view import StudioCamera
from workbench.ui.camera_moves import USUAL, Floats, Frame, looking_at, target_of, usual_distance

PAUSE = 1.2
"""Seconds. What one hand does after a shorter pause belongs to the same step of undo."""
REMEMBERED = 2000
"""Places of cameras, for which it is known how far they looked from there."""
FARTHEST = 1000.0
"""Metres from the origin that a page may ask for."""


class Placing:
    def __init__(self, session: Session) -> None:
        self._session = session
        self._lock = threading.Lock()
        self._gestures = itertools.count(1)
        self._gesture, self._hand, self._moved_at = 0, "", -1e9
        self._distances: dict[tuple[object, ...], float] = {}
        self._distance: dict[CameraKey, float] = {}
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

    def begin(self) -> int:
        """A movement that is one step of undo however long it takes; and what comes after it is another."""
        with self._lock:
            self._hand = ""
            return next(self._gestures)

    def place(self, key: CameraKey, settings: CameraSettings, hand: str, gesture: int | None = None) -> None:
        """Place it live.

        Args:
            hand: what moves it. The same hand goes on with its movement unless it paused.
            gesture: of `begin`, for a hand that says when it begins and ends.

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
            gesture = self._gesture if gesture is None else gesture
        self._session.studio.place(key, settings, gesture)

    def change(self, hand: str, change: Callable[[CameraSettings], CameraSettings]) -> None:
        """Place the chosen camera as `change` makes of it; `hand` as in `place`.

        Raises:
            ValueError: no camera can be placed, or not so.
        """
        camera, now, _ = self.require()
        changed = change(now)
        if changed != now:
            self.place(camera.key, changed, hand)

    # --- the target: a camera has a direction; how far it looks is said by its look_at, or known to the page ----

    def distance(self, camera: StudioCamera) -> float:
        """Metres from the eye to the target: as it was set when the camera stood so, as the file gives it where the
        camera stands as that has it, or as it was last."""
        now = camera.now
        if now is None:
            return USUAL
        set_here, said = self._distances.get(_stand(camera.key, now)), _said_distance(camera)
        if set_here is None and said is not None:
            # Not kept for this place: the file may give another target that is seen the same way.
            with self._lock:
                self._distance[camera.key] = said
            return said
        distance = self._distance.get(camera.key) if set_here is None else set_here
        if distance is None:
            distance = usual_distance(self.frame(camera).to_env(now))
        self.set_distance(camera.key, now, distance)
        return distance

    def set_distance(self, key: CameraKey, settings: CameraSettings, distance: float) -> None:
        """Remember how far it looks from there, so that an undo brings back the target too."""
        distance = max(float(distance), 1e-3)
        with self._lock:
            self._distance[key] = distance
            self._distances[_stand(key, settings)] = distance
            if len(self._distances) > REMEMBERED:
                del self._distances[next(iter(self._distances))]

    def target_in_view(self, camera: StudioCamera, settings: CameraSettings) -> Floats:
        """(3,)"""
        return target_of(self.frame(camera).to_view(settings), self.distance(camera))

    def target(self, camera: StudioCamera, settings: CameraSettings) -> Floats:
        """(3,) in the frame that the camera's numbers are said in."""
        return self.frame(camera).point_from_view(self.target_in_view(camera, settings))

    def look(self, camera: StudioCamera, settings: CameraSettings, target: Floats, hand: str) -> None:
        """Place it where these settings say, turned to a target (3,) in the view; `hand` as in `place`.

        Raises:
            ValueError: that is where it stands, or it is too far away for any task.
        """
        frame = self.frame(camera)
        pose = frame.to_view(settings)
        turned = frame.from_view(settings, looking_at(pose, pose[:3], target))
        self.set_distance(camera.key, turned, float(np.linalg.norm(target - pose[:3])))
        self.place(camera.key, turned, hand)


def _said_distance(camera: StudioCamera) -> float | None:
    """Metres to the target that the file gives; None where it gives none, or the camera was moved."""
    if camera.moved or camera.now is None or camera.info.target is None:
        return None
    return float(np.linalg.norm(np.subtract(camera.info.target, camera.now.position)))


def _stand(key: CameraKey, settings: CameraSettings) -> tuple[object, ...]:
    return key, settings.position, settings.quaternion
