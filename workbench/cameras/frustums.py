"""Draws the selected env's cameras in the 3D view, each as a frustum with its live picture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
import viser
import viser.transforms
from numpy.typing import NDArray

from workbench.envs.camera_data import CameraInfo, CameraKey, CameraKind, CameraSettings, Picture
from workbench.page.scene.env_grid import InView
from workbench.pictures.camera_conventions import intrinsic_of, vertical_fov

CAMERA_TO_OPENCV = viser.transforms.SO3.from_matrix(
    # Columns: OpenCV's right, down and forward in ManiSkill's camera frame (x forward, y left, z up).
    np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
)
MAX_IMAGE_PIXELS = 128
"""Target for the longer side of a frustum's picture. A larger picture is shrunk by a whole factor, so its
longer side stays below twice this number."""
SMALL_METRES, LARGE_METRES = 0.07, 0.14
"""Depth of a frustum: small for one env, large for a view of the whole grid."""
COLOURS: dict[CameraKind, tuple[int, int, int]] = {"sensor": (245, 159, 0), "human": (132, 94, 247)}
THIN_PIXELS, THICK_PIXELS = 2.0, 4.0
"""Width of a frustum's lines; the chosen frustum's lines are thick."""


@dataclass(frozen=True)
class PlacedFrustum:
    """A camera that is being placed. It is drawn at its present pose, since its newest picture may be from an
    earlier pose."""

    pose: NDArray[np.float64]
    """(7,) pose in the view."""
    settings: CameraSettings
    hidden: bool = False
    """Whether to hide the frustum, because a page's viewpoint is at the camera, where the frustum's picture
    would fill the view."""


class CameraFrustums:
    """One frustum for each camera that has a picture or is being placed."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._drawn: dict[CameraKey, InView] = {}
        self._drawn_pictures: dict[CameraKey, Picture] = {}

    def draw(
        self,
        cameras: tuple[CameraInfo, ...],
        pictures: dict[CameraKey, Picture],
        offset: NDArray[np.float32],
        size: float = LARGE_METRES,
        placed: Mapping[CameraKey, PlacedFrustum] | None = None,
    ) -> None:
        """Draw the cameras of these pictures and those that are being placed, and remove all others.

        Args:
            cameras: The task's cameras.
            pictures: Pictures by camera.
            offset: (3,) offset of the selected env in the view.
            size: Depth of a frustum in metres.
            placed: Cameras that are being placed, with or without a picture.
        """
        placed = placed or {}
        known = {camera.key: camera for camera in cameras}
        shown = {
            key: pictures.get(key)
            for key in (*pictures, *placed)
            if key in known and not (key in placed and placed[key].hidden)
        }
        for key in [key for key in self._drawn if key not in shown]:
            self._drawn.pop(key).draw()
            self._drawn_pictures.pop(key, None)
        for key, picture in shown.items():
            self._draw_one(known[key], picture, placed.get(key), offset, size)

    def clear(self) -> None:
        self.draw((), {}, np.zeros(3, np.float32))

    def under_ray(self, origin: NDArray, direction: NDArray) -> CameraKey | None:
        """The camera whose frustum a ray (3,) in the view hits first, or None.

        viser's clicks on nodes are not used: a clickable node captures every press in its area, even on the
        gizmo that is drawn over it.
        """
        met = [
            (distance, key)
            for key, frustum in list(self._drawn.items())
            if (handle := frustum.handle) is not None  # another thread may be drawing
            and (distance := _distance_to(handle, origin, direction)) is not None
        ]
        return min(met)[1] if met else None

    def _draw_one(
        self,
        camera: CameraInfo,
        picture: Picture | None,
        placed: PlacedFrustum | None,
        offset: NDArray[np.float32],
        size: float,
    ) -> None:
        fov, aspect = camera.fovy, camera.width / camera.height
        if placed is not None:
            wxyz, position = frustum_pose(placed.pose, np.zeros(3))
            settings = placed.settings
            fov, aspect = (
                vertical_fov(intrinsic_of(settings), settings.height),
                settings.width / settings.height,
            )
        elif picture is not None:
            wxyz, position = frustum_pose(picture.pose, offset)
        else:
            return
        thickness = THIN_PIXELS if placed is None else THICK_PIXELS
        frustum = self._drawn.get(camera.key)
        if frustum is None:
            add = partial(
                self._server.scene.add_camera_frustum,
                f"/cameras/{camera.kind} {camera.name}",
                thickness_units="screen",
                color=COLOURS[camera.kind],
                format="jpeg",
                jpeg_quality=75,
                cast_shadow=False,
                receive_shadow=False,
            )
            frustum = self._drawn[camera.key] = InView(
                add, "wxyz", "position", "scale", "fov", "aspect", "thickness"
            )
        frustum.draw(wxyz, position, size, fov, aspect, thickness)
        if (
            picture is not None
            and picture is not self._drawn_pictures.get(camera.key)
            and picture.rgb is not None
        ):
            # Assign only a new picture: assigning encodes and sends it, even if it is equal.
            self._drawn_pictures[camera.key] = picture
            frustum.handle.image = small_image(picture)


def _distance_to(handle: viser.CameraFrustumHandle, origin: NDArray, direction: NDArray) -> float | None:
    """Distance at which a ray (3,) enters a frustum, in multiples of `direction`; None if it misses."""
    turn = viser.transforms.SO3(handle.wxyz).inverse()
    start, along = turn @ (np.asarray(origin, float) - handle.position), turn @ np.asarray(direction, float)
    # viser keeps the volume of the pyramid constant (CameraFrustumVariants.tsx); its tip is at the origin.
    y = np.tan(handle.fov / 2)
    x = y * handle.aspect
    depth = np.mean(handle.scale) / np.cbrt(x * y / 3)
    sides = np.array([[0, 0, 1], [1, 0, -x], [-1, 0, -x], [0, 1, -y], [0, -1, -y]])
    # The point `start + v` is inside if `sides @ v <= room`.
    room = np.array([depth, 0, 0, 0, 0]) - sides @ start
    speed = sides @ along
    if (room[speed == 0] < 0).any():
        return None
    enters = (room[speed < 0] / speed[speed < 0]).max(initial=0)
    leaves = (room[speed > 0] / speed[speed > 0]).min(initial=np.inf)
    return float(enters) if enters <= leaves else None


def small_image(picture: Picture) -> NDArray[np.uint8] | None:
    """Every n-th pixel of a picture, since a frustum is at most some hundred pixels wide.

    A texture of 512 x 512 that changes fifteen times a second keeps a browser without a graphics card busy.
    """
    if picture.rgb is None:
        return None
    stride = max(1, max(picture.rgb.shape[:2]) // MAX_IMAGE_PIXELS)
    return np.ascontiguousarray(picture.rgb[::stride, ::stride])


def frustum_pose(pose: NDArray, offset: NDArray) -> tuple[NDArray, NDArray]:
    """wxyz and position of a frustum in the view, for a camera's pose (7,). The frustum has OpenCV's axes (z
    forward, y down)."""
    turned = viser.transforms.SO3(pose[3:].astype(np.float64)) @ CAMERA_TO_OPENCV
    return turned.wxyz, (pose[:3] + offset).astype(np.float64)


def without_the_viewpoint(
    pictures: dict[CameraKey, Picture], seen: Mapping[CameraKey, Picture]
) -> dict[CameraKey, Picture]:
    """The pictures to draw while one env is alone in the view: those whose camera is not near a human camera
    of `seen`.

    The view then starts at the task's human camera (`viewpoint`). The frustum of this camera, or of a sensor
    at the same place, would fill the view with its picture.
    """
    eyes = [picture.pose[:3] for (kind, _), picture in seen.items() if kind == "human"]
    return {
        key: picture
        for key, picture in pictures.items()
        if all(np.linalg.norm(picture.pose[:3] - eye) > 2 * LARGE_METRES for eye in eyes)
    }
