"""Movements of a camera as pure functions, and `Placing`, which applies them to the chosen camera."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from viser.transforms import SO3

from workbench.cameras.commands import MAX_COORDINATE_METRES
from workbench.cameras.events import CameraPlaced
from workbench.cameras.view import StudioCamera, StudioView
from workbench.envs.camera_data import CameraKey, CameraSettings
from workbench.live.session_protocol import LiveSession
from workbench.page.command import Refused
from workbench.page.widgets.templates import sentence
from workbench.pictures.camera_conventions import (
    LookAt,
    axes_of,
    compose,
    intrinsic_of,
    look_at_of,
    make_pose,
    pose_from_look_at,
    pose_from_matrix,
    pose_in_env,
    quaternion_of,
    relative_to,
    rotation_matrix,
    triple,
    with_pose,
)

Floats = NDArray[np.float64]

SAME = 1e-7
"""Tolerance for positions in metres and for components of a unit quaternion, which viser rounds to 32
bits."""


@dataclass(frozen=True)
class Snap:
    """Snap steps of a gizmo; 0 for continuous."""

    metres: float = 0.0
    degrees: float = 0.0


@dataclass(frozen=True)
class Frame:
    """The frame in which a camera's pose is given (its mount's, else the env's), and the place of this frame
    in the 3D view."""

    mount: NDArray[np.float32] | None
    """(7,) pose of the link that carries the camera, in the env's frame; None for a camera without a mount."""
    offset: NDArray[np.float32]
    """(3,) offset of the env in the view."""

    def to_view(self, settings: CameraSettings) -> Floats:
        """(7,) pose of the camera in the view."""
        pose = pose_in_env(settings, self.mount)
        pose[:3] += self.offset
        return pose

    def from_view(
        self, settings: CameraSettings, pose: ArrayLike, distance: float | None = None
    ) -> CameraSettings:
        """`settings` moved to this pose (7,) in the view. The target's distance becomes `distance` metres;
        None keeps the present distance."""
        there = np.array(pose, np.float64)
        there[:3] -= self.offset
        moved = with_pose(settings, there if self.mount is None else relative_to(self.mount, there))
        # The conversion to the view and back rounds. A position or rotation that did not change keeps its
        # exact numbers.
        if np.allclose(moved.position, settings.position, rtol=0, atol=SAME):
            moved = replace(moved, position=settings.position)
        if np.allclose(moved.quaternion, settings.quaternion, rtol=0, atol=SAME):
            moved = replace(moved, quaternion=settings.quaternion)
        return moved if distance is None else replace(moved, distance=max(distance, 1e-3))

    def turned_to(self, settings: CameraSettings, target: ArrayLike) -> CameraSettings:
        """`settings` rotated to look at a target (3,) that is given in the same frame as the camera's
        position.

        Raises:
            ValueError: the target is at the camera's position.
        """
        pose, there = self.to_view(settings), self.point_to_view(target)
        return self.from_view(settings, looking_at(pose, pose[:3], there), math.dist(there, pose[:3]))

    def point_to_view(self, point: ArrayLike) -> Floats:
        """(3,) position in the view of a point (3,) that is given in the same frame as the camera's
        position."""
        there = np.asarray(point, np.float64)
        if self.mount is not None:
            there = compose(self.mount, make_pose(there, (1, 0, 0, 0)))[:3]
        return there + self.offset


def looking_at(pose: ArrayLike, eye: ArrayLike, target: ArrayLike) -> Floats:
    """(7,) pose at `eye` that looks at `target`, with the roll of `pose`.

    Raises:
        ValueError: eye and target are one point.
    """
    return pose_from_look_at(LookAt(triple(eye), triple(target), look_at_of(pose).roll))


def turned_in_world(start: ArrayLike, position: ArrayLike, turn: ArrayLike) -> Floats:
    """(7,) pose `start` rotated by the quaternion `turn` about the world's axes, and moved to `position`."""
    s = np.asarray(start, np.float64)
    turned = rotation_matrix(turn) @ rotation_matrix(s[3:])
    return make_pose(position, quaternion_of(turned))


def snapped(start: ArrayLike, pose: ArrayLike, snap: Snap, own_axes: bool, origin: ArrayLike) -> Floats:
    """(7,) the dragged pose of a gizmo, snapped to whole steps.

    Along the world's axes the position snaps to a grid, so that round numbers are written; along the camera's own axes it
    moves in steps from the start of the drag. The rotation always changes in steps from the start of the
    drag.

    Args:
        origin: (3,) origin of the grid.
    """
    s, p = np.asarray(start, np.float64), np.array(pose, np.float64)
    was, is_now = rotation_matrix(s[3:]), rotation_matrix(p[3:])
    moved = p[:3] - s[:3]
    if snap.metres and own_axes:
        p[:3] = s[:3] + was @ (np.round(was.T @ moved / snap.metres) * snap.metres)
    elif snap.metres:
        # A coordinate that was not dragged stays unchanged, even if it is off the grid.
        grid = np.asarray(origin, np.float64)
        on_grid = np.round((p[:3] - grid) / snap.metres) * snap.metres + grid
        p[:3] = np.where(np.abs(moved) > 1e-6, on_grid, p[:3])
    if snap.degrees:
        p[3:] = quaternion_of(_in_steps(is_now @ was.T, math.radians(snap.degrees)) @ was)
    return p


def nudged(pose: ArrayLike, step: Sequence[float]) -> Floats:
    """(7,) pose moved by (forward, left, up) metres along the camera's own axes."""
    p = np.array(pose, np.float64)
    p[:3] += rotation_matrix(p[3:]) @ np.asarray(step, np.float64)
    return p


def panned(pose: ArrayLike, left: float, up: float) -> Floats:
    """(7,) pose rotated in place: `left` degrees to the left about the vertical, and `up` degrees upwards."""
    p = np.asarray(pose, np.float64)
    about_z, about_left = SO3.from_z_radians(math.radians(left)), SO3.from_y_radians(-math.radians(up))
    return make_pose(p[:3], quaternion_of((about_z @ SO3(p[3:]) @ about_left).as_matrix()))


def viewer_pose(position: ArrayLike, wxyz: ArrayLike) -> Floats:
    """(7,) pose of a page's viewpoint, in ManiSkill's convention. `wxyz` is the rotation of a camera with
    OpenCV's axes."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation_matrix(wxyz), np.asarray(position, np.float64)
    return pose_from_matrix(matrix, "opencv", "camera_to_world")


def fov_that_shows_all(fov: float, aspect: float, view_aspect: float) -> float:
    """Vertical field of view that contains the whole picture in a view with another aspect ratio (width over height)."""
    return 2 * math.atan(math.tan(fov / 2) * max(1.0, aspect / view_aspect))


def picture_corners(settings: CameraSettings, pose: ArrayLike, depth: float) -> Floats:
    """(4, 3) corners of the picture, `depth` metres in front of a camera at this pose (7,)."""
    k, p = intrinsic_of(settings), np.asarray(pose, np.float64)
    forward, left, up = axes_of(p[3:])
    w, h = settings.width, settings.height
    right = (np.array([0, w, w, 0]) - k[0, 2]) / k[0, 0]
    down = (np.array([0, 0, h, h]) - k[1, 2]) / k[1, 1]
    return p[:3] + depth * (forward - right[:, None] * left - down[:, None] * up)


def rounded(numbers: ArrayLike, digits: int) -> tuple[float, ...]:
    """Numbers for a field, without negative zeros."""
    return tuple(round(float(n), digits) + 0.0 for n in np.asarray(numbers, np.float64))


def _in_steps(rotation: Floats, step: float) -> Floats:
    """(3, 3) `rotation` with its angle rounded to a whole number of steps (radians)."""
    turn = SO3(quaternion_of(rotation)).log()
    angle = float(np.linalg.norm(turn))
    whole = round(angle / step) * step
    return np.asarray(SO3.exp(turn * (whole / angle)).as_matrix(), np.float64) if whole else np.eye(3)


PAUSE_SECONDS = 1.2
"""Movements by the same control with pauses of at most this length are one undo step."""


class Placing:
    """Places the chosen camera for gizmo, keys, number fields and "move to my view".

    It checks that the camera can be placed, knows the frame of the camera's numbers, and groups
    successive moves by one control into one undo step.
    """

    def __init__(self, session: LiveSession) -> None:
        self._session = session
        self.offset: NDArray[np.float32] = np.zeros(3, np.float32)
        """Offset of the selected env in the view."""

    @property
    def camera(self) -> StudioCamera | None:
        """The chosen camera, if it can be placed."""
        return self._session.view().of(StudioView).placeable

    def require(self) -> tuple[StudioCamera, CameraSettings, Frame]:
        """The camera to place, its present settings and their frame.

        Raises:
            Refused: no camera can be placed.
        """
        camera = self.camera
        if camera is None or camera.now is None:
            raise Refused("First choose a camera that can be placed.")
        return camera, camera.now, self.frame(camera)

    def frame(self, camera: StudioCamera) -> Frame:
        return Frame(camera.mount_pose, self.offset)

    def place(
        self, key: CameraKey, settings: CameraSettings, control: object, pause: float = PAUSE_SECONDS
    ) -> None:
        """Place the camera live; `control` and `pause` as in `CameraPlaced`.

        Raises:
            Refused: the position is too far from the origin.
        """
        if not all(abs(x) <= MAX_COORDINATE_METRES for x in settings.position):
            raise Refused(f"A camera must be within {MAX_COORDINATE_METRES:g} m of the origin.")
        self._session.dispatch(CameraPlaced(key, settings, control, pause))

    def change(self, control: object, change: Callable[[CameraSettings, Frame], CameraSettings]) -> None:
        """Apply `change` to the chosen camera; `control` as in `place`.

        Args:
            change: returns the new settings; raises ValueError, with a message for the user, if not possible.

        Raises:
            Refused: no camera is chosen, or it cannot have these settings.
        """
        camera, now, frame = self.require()
        try:
            changed = change(now, frame)
        except ValueError as error:
            raise Refused(sentence(str(error))) from None
        self.place(camera.key, changed, control)


def chosen_camera(session: LiveSession) -> tuple[StudioCamera, CameraSettings]:
    """The chosen camera and its present settings.

    Raises:
        Refused: no camera is chosen, or the chosen camera cannot be placed.
    """
    camera = session.view().of(StudioView).chosen
    if camera is None or camera.now is None:
        raise Refused("First choose a camera that can be placed.")
    return camera, camera.now
