"""The gizmos of the chosen camera in the 3D view, and the page's view through that camera."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import viser

from workbench.cameras.pose_math import (
    Floats,
    Frame,
    Placing,
    Snap,
    fov_that_shows_all,
    looking_at,
    picture_corners,
    snapped,
    turned_in_world,
    viewer_pose,
)
from workbench.cameras.view import StudioCamera
from workbench.envs.camera_data import CameraKey, CameraSettings
from workbench.machine.loop import post
from workbench.page.scene.env_grid import line_set
from workbench.page.scene.viewpoint import DEFAULT_ASPECT
from workbench.page.widgets.notices import refusals_shown
from workbench.pictures.camera_conventions import axes_of, intrinsic_of, target_of, vertical_fov

RELEASE_TIMEOUT_SECONDS = 60.0
"""Time without movement after which a gizmo counts as released: if its page was closed, no release event
arrives."""
GIZMO_PIXELS = 76.0
TARGET_PIXELS = 44.0
"""Sizes of the gizmos on the screen."""
SIGHT_COLOUR = (34, 139, 230)
UNTURNED = np.array([1.0, 0.0, 0.0, 0.0])


@dataclass(frozen=True, eq=False)
class _Taken:
    """State of a camera when a drag of a gizmo began. All movements until the release are one undo step."""

    key: CameraKey
    settings: CameraSettings
    frame: Frame
    pose: Floats
    """(7,) pose in the view."""
    target: Floats
    """(3,) target in the view."""


class CameraGizmo:
    """A gizmo to move and rotate the chosen camera, or two gizmos for its eye and its target, in the view of one page.

    viser's gizmo moves along its own axes and cannot snap. To rotate about the world's axes, the gizmo is
    aligned with them when a drag begins, and its rotation since then is applied to the camera. With snap
    steps, the camera moves in steps while the gizmo follows the pointer; on release the gizmo returns to the
    camera. During a drag the server does not write the gizmo's pose: that would pull the gizmo away from the
    pointer.

    Args:
        snap: returns the chosen snap steps.
        own_axes: returns whether the gizmo uses the camera's own axes.
        look_at: returns whether to show the gizmos of eye and target.
    """

    def __init__(
        self,
        page: viser.ClientHandle,
        placing: Placing,
        snap: Callable[[], Snap],
        own_axes: Callable[[], bool],
        look_at: Callable[[], bool],
    ) -> None:
        self._placing = placing
        self._snap, self._own_axes, self._look_at = snap, own_axes, look_at
        # Fixed size on the screen: in a grid of sixteen envs, a gizmo of 10 cm would be a dot.
        add = partial(page.scene.add_transform_controls, fixed=True, depth_test=False, visible=False)
        self._camera = add("/studio/camera", GIZMO_PIXELS)
        self._eye = add("/studio/eye", GIZMO_PIXELS, disable_rotations=True)
        self._target = add("/studio/target", TARGET_PIXELS, disable_rotations=True)
        self._line = line_set(page, "/studio/line of sight", SIGHT_COLOUR, 2.0)
        self._held_at = -1e9
        self._start: _Taken | None = None
        self._camera.on_update(self._on_camera)
        self._eye.on_update(self._on_point)
        self._target.on_update(self._on_point)

    def remove(self) -> None:
        """Remove the gizmos from the view, even during a drag."""
        self._line.draw()
        for handle in (self._camera, self._eye, self._target):
            handle.remove()

    @property
    def held(self) -> bool:
        return self._start is not None and time.monotonic() - self._held_at < RELEASE_TIMEOUT_SECONDS

    def draw(self, camera: StudioCamera | None) -> None:
        """Draw the gizmos at this camera, unless a gizmo is being dragged. If `camera` is None, hide the
        gizmos."""
        if self.held:
            if camera is not None:
                self._draw_line(camera)
            return
        two = camera is not None and self._look_at()
        for handle, shown in (
            (self._camera, camera is not None and not two),
            (self._eye, two),
            (self._target, two),
        ):
            handle.visible = shown
        self._draw_line(camera)
        if camera is None or camera.now is None:
            return
        frame = self._placing.frame(camera)
        pose = frame.to_view(camera.now)
        _move(self._camera, pose[:3], pose[3:] if self._own_axes() else UNTURNED)
        _move(self._eye, pose[:3], UNTURNED)
        _move(self._target, frame.point_to_view(target_of(camera.now)), UNTURNED)

    def _draw_line(self, camera: StudioCamera | None) -> None:
        """Draw a line from the eye to the target, to show which camera the target belongs to."""
        if camera is None or camera.now is None or not self._look_at():
            self._line.draw()
            return
        ends = camera.now.position, target_of(camera.now)
        self._line.draw(np.stack([self._placing.frame(camera).point_to_view(end) for end in ends])[None])

    # --- dragging --------------------------------------------------------------------------------------

    def _take(self) -> bool:
        camera = self._placing.camera
        if camera is None or camera.now is None:
            return False
        frame = self._placing.frame(camera)
        pose = frame.to_view(camera.now)
        target = frame.point_to_view(target_of(camera.now))
        self._start = _Taken(camera.key, camera.now, frame, pose, target)
        return True

    def _went_on(self, phase: str) -> _Taken | None:
        """Register a drag event; returns the camera's state at the start of the drag if `phase` is "update", else None."""
        taken, self._held_at = self.held, time.monotonic()
        if (phase == "start" or not taken) and not self._take():
            return None
        start = self._start
        if phase == "end":
            self._start = None
        return start if phase == "update" else None

    # Async, since viser runs callbacks that are not async in its thread pool, in any order.
    async def _on_camera(self, event: viser.TransformControlsEvent) -> None:
        pose = np.concatenate([event.target.position, event.target.wxyz])
        post(partial(self._drag_camera, event.client, event.phase, pose))

    async def _on_point(self, event: viser.TransformControlsEvent) -> None:
        point = np.array(event.target.position)
        post(partial(self._drag_point, event.client, event.phase, point, event.target is self._eye))

    def _drag_camera(self, client: viser.ClientHandle | None, phase: str, there: Floats) -> None:
        start = self._went_on(phase)
        if start is None:
            return
        pose, own = start.pose, self._own_axes()
        with refusals_shown(client, then=self._let_go):
            moved = there if own else turned_in_world(pose, there[:3], there[3:])
            moved = snapped(pose, moved, self._snap(), own, start.frame.offset)
            self._place(start, moved, start.target - pose[:3])

    def _drag_point(
        self, client: viser.ClientHandle | None, phase: str, point: Floats, moves_eye: bool
    ) -> None:
        """Move the eye or the target."""
        start = self._went_on(phase)
        if start is None:
            return
        pose, target = start.pose, start.target
        before = pose[:3] if moves_eye else target
        at = np.concatenate([before, UNTURNED]), np.concatenate([point, UNTURNED])
        there = snapped(*at, Snap(metres=self._snap().metres), False, start.frame.offset)[:3]
        eye, target = (there, target) if moves_eye else (pose[:3], there)
        with refusals_shown(client, then=self._let_go):
            self._place(start, looking_at(pose, eye, target), target - eye)

    def _place(self, start: _Taken, pose: Floats, sight: Floats) -> None:
        moved = start.frame.from_view(start.settings, pose, float(np.linalg.norm(sight)))
        self._placing.place(start.key, moved, start, math.inf)

    def _let_go(self) -> None:
        """End the drag: the next drawing puts the gizmo back on the camera."""
        self._start = None


def _move(handle: viser.TransformControlsHandle, position: Floats, wxyz: Floats) -> None:
    if not np.allclose(handle.position, position, atol=1e-7):
        handle.position = position
    if not np.allclose(handle.wxyz, wxyz, atol=1e-7):
        handle.wxyz = wxyz


MAX_FOV_RADIANS = math.radians(150)
"""Maximum field of view that the page can draw."""
BAR_PIXELS = 48
"""Height of the folded timeline at the lower edge of the view. The picture's border must stay above the
timeline."""
BORDER_METRES = 0.15
"""Distance of the border from the eye: close to the page's near plane, so that no body hides the border."""
BORDER_COLOUR = (245, 159, 0)
UPRIGHT = np.array([0.0, 0.0, 1.0])


@dataclass
class _Looking:
    """A page that looks through a camera, with the page's own viewpoint, to which it returns."""

    key: CameraKey
    position: Floats
    look_at: Floats
    up: Floats
    fov: float
    shown: tuple[CameraSettings, bytes] | None = None
    """The camera's settings, and its pose in the view, when the page was last moved to it."""


class LookThrough:
    """Moves a page's viewpoint to the chosen camera, with the camera's field of view, and back. Each page has
    its own state.

    A page that looks through the camera follows the camera's changes (typed numbers, undo).
    """

    def __init__(self, server: viser.ViserServer, placing: Placing) -> None:
        self._server, self._placing = server, placing
        self._asked: deque[int] = deque()
        """Pages that requested to look through the camera, or to return, since the last drawing."""
        self._looking: dict[int, _Looking] = {}
        self._border = line_set(server, "/studio/border", BORDER_COLOUR, 2.0)

    @property
    def any(self) -> bool:
        """Whether a page looks through the chosen camera."""
        return bool(self._looking)

    def toggle(self, client: viser.ClientHandle | None) -> None:
        """Look through the chosen camera, or return, at the next drawing."""
        if client is not None:
            self._asked.append(client.client_id)

    def draw(self, camera: StudioCamera | None) -> None:
        """Move the pages that look through the camera along with it; if another camera is chosen, return them
        to their own view."""
        clients = self._server.get_clients()
        while self._asked:
            if (client := clients.get(self._asked.popleft())) is not None:
                self._turn(client, camera)
        for number in list(self._looking):
            client = clients.get(number)
            if client is None:
                del self._looking[number]
            elif camera is None or camera.key != self._looking[number].key:
                self._back(client)
            else:
                self._show(client, camera)
        self._draw_border(camera if self._looking else None)

    def _turn(self, client: viser.ClientHandle, camera: StudioCamera | None) -> None:
        if client.client_id in self._looking:
            self._back(client)
        elif camera is not None:
            eye = client.camera
            self._looking[client.client_id] = _Looking(
                camera.key, eye.position.copy(), eye.look_at.copy(), eye.up_direction.copy(), eye.fov
            )

    def _draw_border(self, camera: StudioCamera | None) -> None:
        """Draw the border of the picture, since the page's view is wider."""
        if camera is None or camera.now is None:
            self._border.draw()
            return
        corners = picture_corners(camera.now, self._placing.frame(camera).to_view(camera.now), BORDER_METRES)
        self._border.draw(np.stack([corners, np.roll(corners, -1, axis=0)], axis=1))

    def settings_from(
        self, client: viser.ClientHandle, settings: CameraSettings, frame: Frame
    ) -> CameraSettings:
        """`settings` with the pose of the page's viewpoint.

        Raises:
            ValueError: the page's viewpoint is not a valid pose.
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
        _, left, up = axes_of(pose[3:])
        # The page's view orbits about the page's up axis. If this were the camera's own up axis, a drag would
        # tilt a level horizon.
        level = abs(left[2]) < 1e-3 and up[2] > 0.05
        eye = client.camera
        aspect = (
            eye.image_width / eye.image_height if eye.image_height and eye.image_width else DEFAULT_ASPECT
        )
        fov = vertical_fov(intrinsic_of(now), now.height)
        target = self._placing.frame(camera).point_to_view(target_of(now))
        fov = fov_that_shows_all(fov, now.width / now.height, aspect)
        if eye.image_height > 4 * BAR_PIXELS:
            fov = 2 * math.atan(math.tan(fov / 2) * eye.image_height / (eye.image_height - 2 * BAR_PIXELS))
        fov = min(fov, MAX_FOV_RADIANS)
        _stand(client, pose[:3], target, UPRIGHT if level else up, fov)

    def _back(self, client: viser.ClientHandle) -> None:
        was = self._looking.pop(client.client_id)
        up = was.up if np.linalg.norm(was.up) > 0.5 else UPRIGHT
        _stand(client, was.position, was.look_at, up, was.fov)


def _stand(client: viser.ClientHandle, position: Floats, look_at: Floats, up: Floats, fov: float) -> None:
    """Move a page's viewpoint."""
    with client.atomic():
        eye = client.camera
        eye.up_direction, eye.position, eye.look_at, eye.fov = up, position, look_at, fov
