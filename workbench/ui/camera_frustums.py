"""The selected env's cameras in the 3-D view, each a frustum with its live picture on it."""

from __future__ import annotations

import numpy as np
import viser
import viser.transforms
from numpy.typing import NDArray

from workbench.core.pictures import CameraInfo, CameraKind, Picture

CAMERA_TO_OPENCV = viser.transforms.SO3.from_matrix(
    # Columns: OpenCV's right, down and forward in ManiSkill's camera frame (x forward, y left, z up).
    np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
)
LARGEST_IMAGE = 128
"""Pixels along the longer side of the picture on a frustum."""
SMALL, LARGE = 0.07, 0.14
"""Depth of a frustum, metres: small beside one env, larger where the whole grid is looked at."""
COLOURS: dict[CameraKind, tuple[int, int, int]] = {"sensor": (245, 159, 0), "human": (132, 94, 247)}


class CameraFrustums:
    """One frustum for each camera whose picture is at hand; a camera's pose travels with its picture."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._drawn: dict[tuple[CameraKind, str], viser.CameraFrustumHandle] = {}
        self._worn: dict[tuple[CameraKind, str], Picture] = {}

    def draw(
        self,
        cameras: tuple[CameraInfo, ...],
        pictures: dict[tuple[CameraKind, str], Picture],
        offset: NDArray[np.float32],
        size: float = LARGE,
    ) -> None:
        """Draw these pictures' cameras and take away all others.

        Args:
            cameras: The task's cameras.
            pictures: Those to show; empty shows none.
            offset: (3,) where the selected env stands in the view.
            size: Depth of a frustum in metres.
        """
        known = {(camera.kind, camera.name): camera for camera in cameras}
        for key in [key for key in self._drawn if key not in pictures or key not in known]:
            self._drawn.pop(key).remove()
            del self._worn[key]
        for key, picture in pictures.items():
            if key in known:
                self._draw_one(known[key], picture, offset, size)

    def clear(self) -> None:
        self.draw((), {}, np.zeros(3, np.float32))

    def _draw_one(
        self, camera: CameraInfo, picture: Picture, offset: NDArray[np.float32], size: float
    ) -> None:
        wxyz, position = frustum_pose(picture, offset)
        key = (camera.kind, camera.name)
        handle = self._drawn.get(key)
        if handle is None:
            self._drawn[key] = self._server.scene.add_camera_frustum(
                f"/cameras/{camera.kind} {camera.name}",
                fov=camera.fovy,
                aspect=camera.width / camera.height,
                scale=size,
                thickness=2.0,
                thickness_units="screen",
                color=COLOURS[camera.kind],
                image=small_image(picture),
                format="jpeg",
                jpeg_quality=75,
                wxyz=wxyz,
                position=position,
                cast_shadow=False,
                receive_shadow=False,
            )
            self._worn[key] = picture
            return
        handle.wxyz, handle.position, handle.scale = wxyz, position, size
        handle.fov, handle.aspect = camera.fovy, camera.width / camera.height
        if picture is not self._worn[key] and picture.rgb is not None:
            # Assigning encodes and sends it, also when it is the picture that is there already.
            self._worn[key] = picture
            handle.image = small_image(picture)


def small_image(picture: Picture) -> NDArray[np.uint8] | None:
    """What a frustum wears: every n-th pixel, since it is drawn some hundred pixels wide at most.

    A texture of 512 x 512 that changes fifteen times a second is what a browser without a graphics card
    spends its time on.
    """
    if picture.rgb is None:
        return None
    stride = max(1, max(picture.rgb.shape[:2]) // LARGEST_IMAGE)
    return np.ascontiguousarray(picture.rgb[::stride, ::stride])


def frustum_pose(picture: Picture, offset: NDArray[np.float32]) -> tuple[NDArray, NDArray]:
    """wxyz and position of the camera in the view, in OpenCV's frame (z forward, y down)."""
    turned = viser.transforms.SO3(picture.pose[3:].astype(np.float64)) @ CAMERA_TO_OPENCV
    return turned.wxyz, (picture.pose[:3] + offset).astype(np.float64)


def without_the_viewpoint(
    pictures: dict[tuple[CameraKind, str], Picture], seen: dict[tuple[CameraKind, str], Picture]
) -> dict[tuple[CameraKind, str], Picture]:
    """The pictures to draw while one env is alone in the view.

    The view then starts at the task's human camera (see `viewpoint`); its own picture, or that of a
    sensor at the same place, would fill it.
    """
    eyes = [picture.pose[:3] for (kind, _), picture in seen.items() if kind == "human"]
    return {
        key: picture
        for key, picture in pictures.items()
        if all(np.linalg.norm(picture.pose[:3] - eye) > 2 * LARGE for eye in eyes)
    }
