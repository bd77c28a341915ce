"""Converts camera poses and lenses between conventions; needs no simulator."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from transforms3d.euler import euler2mat, euler2quat
from transforms3d.quaternions import mat2quat, qconjugate, qmult, quat2mat

from workbench.envs.camera_data import CameraSettings, Matrix3

Floats = NDArray[np.float64]
Convention = Literal["maniskill", "opencv", "opengl"]
"""Convention of the camera's own axes.

* ``maniskill`` (also SAPIEN, ROS's body frames): x forward, y left, z up;
* ``opencv`` (also ROS's optical frames, COLMAP): x right, y down, z forward;
* ``opengl`` (also Blender, NeRF): x right, y up, z backward.

Every conversion goes through a pose ``[x, y, z, qw, qx, qy, qz]``, camera to world, in the convention
``maniskill``.
"""
Direction = Literal["camera_to_world", "world_to_camera"]

_AXES: dict[str, Floats] = {
    # Columns: the convention's x, y and z in ManiSkill's camera frame.
    "maniskill": np.eye(3),
    "opencv": np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]),
    "opengl": np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
}
VERTICAL_SINE = 1e-6
"""A camera counts as looking straight down or up if the sine of the angle between its line of sight and the
vertical is below this. "Upright" is not defined for such a camera."""
ROTATION_TOLERANCE = 1e-3
"""Largest accepted deviation of a matrix's singular values from 1: calibrations are printed with four
digits."""


@dataclass(frozen=True)
class LookAt:
    """A camera pose as eye, target and roll."""

    eye: tuple[float, float, float]
    """Metres."""
    target: tuple[float, float, float]
    """Any point on the optical axis in front of the eye."""
    roll: float = 0.0
    """Radians about the line of sight; positive turns the camera clockwise as seen from behind it. At roll 0
    the camera is upright. For a camera that looks straight down, roll 0 means that the top of the picture is
    towards +x; for one that looks straight up, towards -x (as if an upright camera that looks along +x had
    been tilted down or up)."""


# --- rotations ---------------------------------------------------------------------------------------------------


def normalised(quaternion: ArrayLike) -> Floats:
    """(4,) wxyz of unit length with w >= 0, so that q and -q give the same numbers.

    Raises:
        ValueError: the quaternion is not a rotation (all zero, or not finite).
    """
    q = _vector(quaternion, 4, "a quaternion")
    # Divide by the largest first: the squares of tiny numbers underflow to zero.
    largest = np.abs(q).max()
    if largest == 0:
        raise ValueError("a quaternion of zeros is not a rotation; 1, 0, 0, 0 (w first) is the identity")
    q = q / largest
    q = q / np.linalg.norm(q)
    first = q[np.abs(q) > 1e-12][0]
    return -q + 0.0 if first < 0 else q


def rotation_matrix(quaternion: ArrayLike) -> Floats:
    """(3, 3) rotation matrix of a wxyz quaternion of any length."""
    return quat2mat(normalised(quaternion))


def quaternion_of(rotation: ArrayLike) -> Floats:
    """(4,) wxyz of the rotation nearest to a matrix (3, 3).

    Raises:
        ValueError: the matrix is not a rotation; the message has the reason.
    """
    return normalised(mat2quat(nearest_rotation(rotation)))


def nearest_rotation(matrix: ArrayLike) -> Floats:
    """(3, 3) the rotation nearest to a matrix.

    Raises:
        ValueError: the matrix is farther from any rotation than `ROTATION_TOLERANCE`: a mirror image, scaled, skewed,
            singular, or not 3 x 3.
    """
    m = np.asarray(matrix, np.float64)
    if m.shape != (3, 3):
        raise ValueError(f"a rotation is a matrix of 3 x 3 numbers, not of {' x '.join(map(str, m.shape))}")
    if not np.isfinite(m).all():
        raise ValueError("the rotation holds numbers that are not finite")
    u, scales, v = np.linalg.svd(m)
    if scales[2] < 1e-6:
        raise ValueError("the matrix is not a rotation: its determinant is 0")
    if np.linalg.det(m) < 0:
        raise ValueError(
            "the matrix is not a rotation but a mirror image (its determinant is negative): one axis, or the whole "
            "of a row or column, has the wrong sign"
        )
    if scales[0] - scales[2] <= ROTATION_TOLERANCE * scales[0] and abs(scales[0] - 1) > ROTATION_TOLERANCE:
        raise ValueError(
            f"the matrix is not a rotation: it also scales by {scales.mean():.4g}. Divide its 3 x 3 part by "
            "this number, and check that the translation is in metres"
        )
    if np.abs(scales - 1).max() > ROTATION_TOLERANCE:
        lengths = ", ".join(f"{length:.4g}" for length in np.linalg.norm(m, axis=1))
        raise ValueError(
            f"the matrix is not a rotation: its rows must be of length 1 and at right angles to each other; their "
            f"lengths are {lengths}"
        )
    return u @ v


def axes_of(quaternion: ArrayLike) -> tuple[Floats, Floats, Floats]:
    """Forward, left and up of a camera: unit vectors (3,), in the frame in which `quaternion` is given."""
    r = rotation_matrix(quaternion)
    return r[:, 0], r[:, 1], r[:, 2]


def angle_between(a: ArrayLike, b: ArrayLike) -> float:
    """Angle in radians between two orientations (4,) wxyz; q and -q are the same orientation."""
    # Computed from the vector part, which keeps its precision for small angles.
    w, *vector = qmult(normalised(a), qconjugate(normalised(b)))
    return 2 * math.atan2(math.hypot(*vector), abs(w))


def quaternion_from_axes(forward: ArrayLike, up: ArrayLike) -> Floats:
    """(4,) wxyz of the camera that looks along `forward` with its top towards `up`.

    `forward` is kept exactly; of `up`, only the component perpendicular to `forward` is used.

    Raises:
        ValueError: a vector has no length, or the two are parallel.
    """
    ahead = _direction(forward, "forward")
    left = np.cross(_direction(up, "up"), ahead)
    if np.linalg.norm(left) < VERTICAL_SINE:
        raise ValueError("up must not point along forward: the camera's roll would be undefined")
    left /= np.linalg.norm(left)
    return quaternion_of(np.stack([ahead, left, np.cross(ahead, left)], axis=1))


def rpy_of(quaternion: ArrayLike) -> tuple[float, float, float]:
    """Roll, pitch and yaw in degrees: R = Rz(yaw) Ry(pitch) Rx(roll).

    URDF's and ROS's fixed-axis convention, transforms3d's ``sxyz``. For a camera in ManiSkill's frame: yaw
    turns it to the left, a positive pitch makes it look down, roll turns it clockwise as seen from behind. If
    it looks straight down or up, roll and yaw have the same axis: roll is returned as 0, and yaw has the
    whole rotation.
    """
    r = rotation_matrix(quaternion)
    flat = math.hypot(r[0, 0], r[1, 0])
    pitch = math.atan2(-r[2, 0], flat)
    if flat < VERTICAL_SINE:
        roll, yaw = 0.0, math.atan2(-r[0, 1], r[1, 1])
    else:
        roll, yaw = math.atan2(r[2, 1], r[2, 2]), math.atan2(r[1, 0], r[0, 0])
    return math.degrees(roll), math.degrees(pitch), math.degrees(yaw)


def quaternion_from_rpy(roll: float, pitch: float, yaw: float) -> Floats:
    """(4,) wxyz of roll, pitch and yaw in degrees, as in `rpy_of`."""
    return normalised(euler2quat(*np.radians(_vector([roll, pitch, yaw], 3, "roll, pitch and yaw"))))


# --- poses -------------------------------------------------------------------------------------------------------


def pose_of(settings: CameraSettings) -> Floats:
    """(7,) position, then quaternion wxyz, of the camera in the frame of its mount."""
    return make_pose(settings.position, settings.quaternion)


def pose_in_env(settings: CameraSettings, mount: ArrayLike | None) -> Floats:
    """(7,) pose of the camera in the env's frame; `mount` (7,) is the pose of the body that carries it, None
    for a fixed camera."""
    return pose_of(settings) if mount is None else compose(mount, pose_of(settings))


def with_pose(settings: CameraSettings, pose: ArrayLike) -> CameraSettings:
    """Copy of the settings with another pose (7,) in the frame of the mount."""
    p = _vector(pose, 7, "a pose")
    qw, qx, qy, qz = map(float, normalised(p[3:]))
    return replace(settings, position=triple(p[:3]), quaternion=(qw, qx, qy, qz))


def make_pose(position: ArrayLike, quaternion: ArrayLike) -> Floats:
    """(7,) pose from a position (3,) and a quaternion (4,) wxyz of any length."""
    return np.concatenate([_vector(position, 3, "a position"), normalised(quaternion)])


def target_of(settings: CameraSettings) -> Floats:
    """(3,) the target of a camera, in the frame of its mount; one metre ahead of the camera if the settings
    have no target distance."""
    return settings.position + (settings.distance or 1.0) * axes_of(settings.quaternion)[0]


def inverse(pose: ArrayLike) -> Floats:
    """(7,) the inverse pose: camera to world becomes world to camera."""
    p = _vector(pose, 7, "a pose")
    return make_pose(-rotation_matrix(p[3:]).T @ p[:3], qconjugate(p[3:]))


def compose(mount: ArrayLike, local: ArrayLike) -> Floats:
    """(7,) the pose `local` (7,), converted from the frame of a body at `mount` (7,) to the env's frame."""
    m, p = _vector(mount, 7, "a mount's pose"), _vector(local, 7, "a pose")
    r = rotation_matrix(m[3:])
    return make_pose(m[:3] + r @ p[:3], qmult(normalised(m[3:]), normalised(p[3:])))


def relative_to(mount: ArrayLike, world: ArrayLike) -> Floats:
    """(7,) the pose `world` (7,), converted from the env's frame to the frame of a body at `mount` (7,)."""
    return compose(inverse(mount), world)


def pose_from_look_at(look_at: LookAt) -> Floats:
    """(7,) pose from eye, target and roll. With roll 0 it equals ManiSkill's ``look_at``, except for a camera
    that looks straight down or up: there, ManiSkill's quaternion is not of unit length.

    Raises:
        ValueError: eye and target are one point.
    """
    eye, target = _vector(look_at.eye, 3, "the eye"), _vector(look_at.target, 3, "the target")
    if np.linalg.norm(target - eye) < 1e-9:
        raise ValueError("eye and target are the same point: the camera needs a direction to look in")
    forward = _direction(target - eye, "forward")
    turned = upright(forward) @ euler2mat(look_at.roll, 0, 0)
    return np.concatenate([eye, quaternion_of(turned)])


def look_at_of(pose: ArrayLike, distance: float = 1.0) -> LookAt:
    """Eye, target and roll of a pose (7,), with the target `distance` metres ahead of the eye."""
    if not distance > 0:
        raise ValueError(f"the target must be in front of the camera, not at a distance of {distance} m")
    p = _vector(pose, 7, "a pose")
    r = rotation_matrix(p[3:])
    target = p[:3] + distance * r[:, 0]
    # Computed as in `pose_from_look_at`: near the vertical, the last digits decide which roll is upright.
    forward = _direction(target - p[:3], "forward")
    turned = upright(forward).T @ r
    return LookAt(triple(p[:3]), triple(target), math.atan2(turned[2, 1], turned[1, 1]))


def upright(forward: ArrayLike) -> Floats:
    """(3, 3) rotation of the level camera that looks along `forward`; see `LookAt.roll` for a vertical
    `forward`."""
    ahead = _direction(forward, "forward")
    flat = math.hypot(ahead[0], ahead[1])
    left = np.array([0.0, 1.0, 0.0]) if flat < VERTICAL_SINE else np.array([-ahead[1], ahead[0], 0.0]) / flat
    left = left - ahead * (ahead @ left)
    left /= np.linalg.norm(left)
    return np.stack([ahead, left, np.cross(ahead, left)], axis=1)


# --- matrices ----------------------------------------------------------------------------------------------------


def matrix_of(pose: ArrayLike, convention: Convention, direction: Direction) -> Floats:
    """(4, 4) matrix of a pose (7,). OpenCV's extrinsic is ``("opencv", "world_to_camera")`` without its last row; the
    model matrix of ManiSkill's ``cam2world_gl`` is ``("opengl", "camera_to_world")``.
    """
    p = _vector(pose, 7, "a pose")
    r = rotation_matrix(p[3:]) @ _AXES[convention]
    matrix = np.eye(4)
    if direction == "camera_to_world":
        matrix[:3, :3], matrix[:3, 3] = r, p[:3]
    else:
        matrix[:3, :3], matrix[:3, 3] = r.T, -r.T @ p[:3]
    return matrix


def pose_from_matrix(matrix: ArrayLike, convention: Convention, direction: Direction) -> Floats:
    """(7,) pose from a matrix (4, 4) or (3, 4) in this convention and direction.

    Raises:
        ValueError: the matrix has another shape, its last row is not 0 0 0 1, or its 3 x 3 part is not a rotation.
    """
    m = np.asarray(matrix, np.float64)
    if m.shape not in ((4, 4), (3, 4)):
        raise ValueError(
            f"a pose is a matrix of 4 x 4 or 3 x 4 numbers, not of {' x '.join(map(str, m.shape))}"
        )
    if not np.isfinite(m).all():
        raise ValueError("the matrix holds numbers that are not finite")
    if m.shape == (4, 4) and np.abs(m[3] - [0, 0, 0, 1]).max() > 1e-6:
        row = ", ".join(f"{number:.6g}" for number in m[3])
        hint = ""
        if np.abs(m[:, 3] - [0, 0, 0, 1]).max() <= 1e-6:
            hint = "; the matrix looks transposed (the translation belongs in the last column)"
        raise ValueError(f"the last row of a pose's 4 x 4 matrix is 0, 0, 0, 1, not {row}{hint}")
    r, t = nearest_rotation(m[:3, :3]), m[:3, 3]
    if direction == "world_to_camera":
        r, t = r.T, -r.T @ t
    return make_pose(t, quaternion_of(r @ _AXES[convention].T))


def opencv_extrinsic(pose: ArrayLike) -> Floats:
    """(3, 4) matrix from world to camera; the camera's x is right, y down, z forward."""
    return matrix_of(pose, "opencv", "world_to_camera")[:3]


def opengl_model_matrix(pose: ArrayLike) -> Floats:
    """(4, 4) matrix from camera to world; the camera's x is right, y up, z backward."""
    return matrix_of(pose, "opengl", "camera_to_world")


# --- the lens ----------------------------------------------------------------------------------------------------


def intrinsic_from_fov(fov: float, width: int, height: int) -> Floats:
    """(3, 3) intrinsic matrix of a vertical field of view in radians: square pixels, principal point in the middle.

    OpenCV's pinhole, (u, v, 1) z = K (x, y, z), with pixels counted from the outer edge of the top left pixel, as in
    SAPIEN: the middle of a picture is W / 2, H / 2.
    """
    _check_size(width, height)
    if not 0 < fov < math.pi:
        raise ValueError(f"a vertical field of view is between 0 and pi radians, not {fov}")
    focal = height / 2 / math.tan(fov / 2)
    return np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])


def intrinsic_of(settings: CameraSettings) -> Floats:
    """(3, 3) intrinsic matrix in pixels, from the intrinsic or the fov of the settings.

    Raises:
        ValueError: the settings have neither an intrinsic nor a fov, or a value that is not valid.
    """
    if settings.intrinsic is not None:
        return checked_intrinsic(settings.intrinsic)
    if settings.fov is None:
        raise ValueError("a camera needs a field of view or an intrinsic matrix")
    return intrinsic_from_fov(settings.fov, settings.width, settings.height)


def checked_intrinsic(matrix: ArrayLike) -> Floats:
    """(3, 3) `matrix`, if it is an intrinsic matrix that ManiSkill can render.

    Raises:
        ValueError: the matrix is not that of a pinhole camera (wrong shape or last row, focal lengths that
            are not positive), or it has a skew, which ManiSkill silently ignores.
    """
    k = np.asarray(matrix, np.float64)
    if k.shape != (3, 3) or not np.isfinite(k).all():
        raise ValueError("an intrinsic matrix is 3 x 3 finite numbers: fx 0 cx, 0 fy cy, 0 0 1")
    if np.abs(k[2] - [0, 0, 1]).max() > 1e-9 or abs(k[1, 0]) > 1e-9:
        raise ValueError("an intrinsic matrix is fx 0 cx, 0 fy cy, 0 0 1 in its three rows")
    if k[0, 0] <= 0 or k[1, 1] <= 0:
        raise ValueError(f"focal lengths must be positive, not {k[0, 0]:.6g} and {k[1, 1]:.6g} pixels")
    if abs(k[0, 1]) > 1e-6 * k[0, 0]:
        raise ValueError(f"a skew of {k[0, 1]:.6g} pixels cannot be rendered: ManiSkill ignores it")
    return k


def vertical_fov(intrinsic: ArrayLike, height: int) -> float:
    """Vertical field of view in radians, as if the principal point were in the middle of the picture."""
    return 2 * math.atan(height / 2 / float(checked_intrinsic(intrinsic)[1, 1]))


def horizontal_fov(intrinsic: ArrayLike, width: int) -> float:
    """Horizontal field of view in radians, as if the principal point were in the middle of the picture."""
    return 2 * math.atan(width / 2 / float(checked_intrinsic(intrinsic)[0, 0]))


def scaled_intrinsic(intrinsic: ArrayLike, size: Sequence[int], new_size: Sequence[int]) -> Floats:
    """(3, 3) intrinsic matrix for the same view in a picture of another size (width, height); pixels need not
    stay square."""
    _check_size(*size)
    _check_size(*new_size)
    scale = np.diag([new_size[0] / size[0], new_size[1] / size[1], 1.0])
    return scale @ checked_intrinsic(intrinsic)


def triple(vector: ArrayLike) -> tuple[float, float, float]:
    """The three numbers of a vector (3,) as plain floats."""
    x, y, z = np.asarray(vector, np.float64).tolist()
    return x, y, z


def matrix3(matrix: ArrayLike) -> Matrix3:
    """A (3, 3) array as plain floats, in the form of `CameraSettings.intrinsic`."""
    rows = np.asarray(matrix, np.float64).reshape(3, 3)
    return triple(rows[0]), triple(rows[1]), triple(rows[2])


# --- small parts -------------------------------------------------------------------------------------------------


def _vector(numbers: ArrayLike, length: int, what: str) -> Floats:
    v = np.asarray(numbers, np.float64)
    if v.shape != (length,):
        raise ValueError(f"{what} is {length} numbers, not an array of shape {v.shape}")
    if not np.isfinite(v).all():
        raise ValueError(f"{what} holds numbers that are not finite")
    return v


def _direction(vector: ArrayLike, what: str) -> Floats:
    v = _vector(vector, 3, what)
    length = np.linalg.norm(v)
    if length < 1e-12:
        raise ValueError(f"{what} has no length, and so no direction")
    return v / length


def _check_size(width: int, height: int) -> None:
    if width < 1 or height < 1:
        raise ValueError(f"a picture has at least one pixel, not {width} x {height}")
