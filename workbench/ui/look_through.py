"""The viewer's own camera, put where a task's camera is, and back; and the other way round.

To judge a placement one wants to stand where the camera stands. "Look through it" takes the page that asked there,
with that field of view; while it looks through, it follows the camera (a number that is typed, an undo), and going
back leaves it where it was. Each page has its own view, so this is kept by page.
"""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass

import numpy as np
import viser

from workbench.core.camera_frames import axes_of, intrinsic_of, vertical_fov
from workbench.core.camera_settings import CameraKey, CameraSettings
from workbench.session.studio_view import StudioCamera
from workbench.ui.camera_moves import Floats, Frame, fov_that_shows_all, picture_corners, viewer_pose
from workbench.ui.placing import Placing
from workbench.ui.selection_mark import line_set
from workbench.ui.viewpoint import USUAL_ASPECT

WIDEST = math.radians(150)
"""Of the page's own view: what is wider it cannot draw."""
BORDER_AT = 0.15
"""Metres in front of the eye: as near as the page draws, or things would hide it."""
BORDER_COLOUR = (245, 159, 0)
UPRIGHT = np.array([0.0, 0.0, 1.0])


@dataclass
class _Looking:
    key: CameraKey
    position: Floats
    look_at: Floats
    up: Floats
    fov: float
    shown: tuple[CameraSettings, bytes] | None = None
    """The camera, and its place in the view, that the page was last put to."""


class LookThrough:
    def __init__(self, server: viser.ViserServer, placing: Placing) -> None:
        self._server, self._placing = server, placing
        self._lock = threading.Lock()
        self._looking: dict[int, _Looking] = {}
        self._border = line_set(server, "/studio/border", BORDER_COLOUR, 2.0)

    @property
    def any(self) -> bool:
        """Whether a page looks through the chosen camera."""
        return bool(self._looking)

    def toggle(self, client: viser.ClientHandle | None) -> None:
        """Go there, or back."""
        camera = self._placing.camera
        if client is None:
            return
        with self._lock:
            if client.client_id in self._looking:
                self._back(client)
            elif camera is not None:
                eye = client.camera
                self._looking[client.client_id] = _Looking(
                    camera.key, eye.position.copy(), eye.look_at.copy(), eye.up_direction.copy(), eye.fov
                )
                self._show(client, camera)

    def draw(self, camera: StudioCamera | None) -> None:
        """Follow the camera; go back where it is no longer the chosen one."""
        with self._lock:
            clients = self._server.get_clients()
            for number in list(self._looking):
                client = clients.get(number)
                if client is None:
                    del self._looking[number]
                elif camera is None or camera.key != self._looking[number].key:
                    self._back(client)
                else:
                    self._show(client, camera)
        self._draw_border(camera if self._looking else None)

    def _draw_border(self, camera: StudioCamera | None) -> None:
        """A view is wider than the picture; what is inside of this line is in it."""
        if camera is None or camera.now is None:
            self._border.draw()
            return
        corners = picture_corners(camera.now, self._placing.frame(camera).to_view(camera.now), BORDER_AT)
        self._border.draw(np.stack([corners, np.roll(corners, -1, axis=0)], axis=1))

    def settings_from(
        self, client: viser.ClientHandle, settings: CameraSettings, frame: Frame
    ) -> CameraSettings:
        """This camera, where the page looks from.

        Raises:
            ValueError: the page says nothing that is a pose.
        """
        return frame.from_view(settings, viewer_pose(client.camera.position, client.camera.wxyz))

    def _show(self, client: viser.ClientHandle, camera: StudioCamera) -> None:
        looking, now = self._looking[client.client_id], camera.now
        if now is None:
            return
        pose = self._placing.frame(camera).to_view(now)
        shown = (now, pose.tobytes())
        if shown == looking.shown:
            return
        looking.shown = shown
        forward, left, up = axes_of(pose[3:])
        # The page's orbit turns about its up: about the camera's own, a drag would tilt a level horizon.
        level = abs(left[2]) < 1e-3 and up[2] > 0.05
        eye = client.camera
        aspect = eye.image_width / eye.image_height if eye.image_height and eye.image_width else USUAL_ASPECT
        fov = vertical_fov(intrinsic_of(now), now.height)
        with client.atomic():
            eye.up_direction = UPRIGHT if level else up
            eye.position = pose[:3]
            eye.look_at = pose[:3] + forward * self._placing.distance(camera)
            eye.fov = min(fov_that_shows_all(fov, now.width / now.height, aspect), WIDEST)

    def _back(self, client: viser.ClientHandle) -> None:
        looking = self._looking.pop(client.client_id)
        eye = client.camera
        with client.atomic():
            eye.up_direction = looking.up if np.linalg.norm(looking.up) > 0.5 else UPRIGHT
            eye.position = looking.position
            eye.look_at = looking.look_at
            eye.fov = looking.fov
