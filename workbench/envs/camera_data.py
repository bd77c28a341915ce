"""Camera settings, descriptions and pictures as plain data, without a simulator."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

CameraKind = Literal["sensor", "human"]
PictureDegree = Literal["exact", "fast"]
"""``exact``: SAPIEN's own picture, to the bit. ``fast``: heavy meshes are simplified, see
`envs.rendering.fast_shapes`."""
CameraKey = tuple[CameraKind, str]
"""Kind and name: a sensor and a camera for people may have the same name."""

Matrix3 = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]


@dataclass(frozen=True)
class CameraSettings:
    """Pose, lens, size and shader of one camera, as ManiSkill's ``CameraConfig`` has them."""

    position: tuple[float, float, float]
    """Metres, in the frame of the camera's mount; in the env's frame without a mount."""
    quaternion: tuple[float, float, float, float]
    """wxyz, of unit length, in the same frame. The camera looks along x, y is to its left, z is up."""
    fov: float | None
    """Vertical field of view in radians; None if `intrinsic` is given."""
    intrinsic: Matrix3 | None
    """OpenCV's matrix in pixels; None if `fov` is given."""
    width: int
    height: int
    near: float
    """Metres."""
    far: float
    shader_pack: str
    """``minimal``, ``default``, ``rt`` ...; it decides the modalities."""
    distance: float | None = field(default=None, compare=False)
    """Metres to the camera's target, along the line of sight; None without a target. Changes no picture."""


@dataclass(frozen=True)
class CallSite:
    """Where the author's code made a camera's config."""

    file: str
    line: int
    """First line of the call, counted from 1."""
    function: str
    """Python's qualified name of the calling function: ``PushCubeEnv._default_sensor_configs``."""


SETTING_TOLERANCE = 1e-6
"""Largest difference between settings that count as equal: metres, quaternion components, radians; relative
for values above 1. A config keeps its pose in single precision."""


def differences(a: CameraSettings, b: CameraSettings, close: float = SETTING_TOLERANCE) -> tuple[str, ...]:
    """Names of the settings that differ: ``position orientation fov intrinsic width height near far shader_pack``."""
    turned = tuple(-x for x in b.quaternion)
    found = []
    for name in [f.name for f in fields(a) if f.compare]:
        mine, other = getattr(a, name), getattr(b, name)
        if name != "quaternion":
            found += [] if _alike(mine, other, close) else [name]
        elif not _alike(mine, other, close) and not _alike(mine, turned, close):
            found.append("orientation")
    return tuple(found)


def _alike(a: Any, b: Any, close: float) -> bool:
    if isinstance(a, tuple) and isinstance(b, tuple):
        return all(_alike(x, y, close) for x, y in zip(a, b, strict=True))
    if isinstance(a, float) and isinstance(b, float):
        return abs(a - b) <= close * max(1.0, abs(a), abs(b))
    return a == b


def setting_text(value: object) -> str:
    """One setting as text."""
    if isinstance(value, tuple):
        return f"({', '.join(map(setting_text, value))})"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


@dataclass(frozen=True)
class MovedCamera:
    """A change of a camera in a recorded episode: to settings that differ from those in the task's file, or
    back to those in the file."""

    state: int
    """State index from which on the settings hold; 0 is the start."""
    kind: CameraKind
    name: str
    used: CameraSettings
    in_file: CameraSettings
    """Settings in the task's file; equal to `used` if the camera was put back."""


def moved_cameras_text(moved: Sequence[MovedCamera]) -> str:
    """Text such as ``base_camera: position (0.3, 0, 0.6), in the file (0.3, 0, 0.5)``; empty if no
    camera was moved."""
    texts = []
    for one in moved:
        from_step = f" from step {one.state} on" if one.state else ""
        values = [
            f"{what} {setting_text(mine)}, in the file {setting_text(file)}"
            for what in differences(one.used, one.in_file)
            for mine, file in [(_value(one.used, what), _value(one.in_file, what))]
        ]
        texts.append(f"{one.name}{from_step}: {'; '.join(values) or 'as in the file'}")
    return ". ".join(texts)


def _value(settings: CameraSettings, what: str) -> object:
    """The setting that `differences` calls `what`."""
    return getattr(settings, "quaternion" if what == "orientation" else what)


NOT_ON_THE_GPU = "in GPU simulation cameras cannot be moved; open the task with --backend cpu to place them"
MAX_SIDE_PIXELS = 4096
"""Maximum pixels per side. Without a limit, one digit too many would use up the memory."""


_MAX_DISTANCE_METRES = 1e6
"""Largest coordinate of a camera's pose, and largest near and far."""


def why_no_camera(settings: CameraSettings) -> str | None:
    """Why these settings are invalid, as a sentence without its full stop; None if they are valid."""
    numbers = (*settings.position, *settings.quaternion, settings.near, settings.far)
    if not all(abs(number) <= _MAX_DISTANCE_METRES for number in numbers):
        return (
            f"the camera's pose, near and far must be finite numbers of at most {_MAX_DISTANCE_METRES:,.0f}"
        )
    if abs(math.hypot(*settings.quaternion) - 1.0) > 1e-3:
        return "the camera's quaternion must be of unit length"
    if not 0 < settings.near < settings.far:
        return f"near must be above 0 and below far, not {settings.near:g} and {settings.far:g} metres"
    if not all(
        isinstance(size, int) and 1 <= size <= MAX_SIDE_PIXELS for size in (settings.width, settings.height)
    ):
        return f"width and height must be 1 to {MAX_SIDE_PIXELS}, not {settings.width} x {settings.height}"
    if not re.fullmatch(r"[A-Za-z0-9_-]{1,60}", settings.shader_pack):
        return f"{settings.shader_pack!r} is not a shader pack"
    if (settings.fov is None) == (settings.intrinsic is None):
        return "a camera has either a fov or an intrinsic matrix"
    if settings.fov is not None and not 0.0 < settings.fov < math.pi:
        return f"the fov must be above 0 and below pi radians, not {settings.fov:g}"
    if settings.intrinsic is not None:
        rows = settings.intrinsic
        if [len(row) for row in rows] != [3, 3, 3] or not all(math.isfinite(x) for row in rows for x in row):
            return "the intrinsic matrix must be 3 x 3 finite numbers"
        if rows[0][0] <= 0 or rows[1][1] <= 0:
            return "the intrinsic matrix must have focal lengths above 0"
    return None


# --- What cameras there are, and what they saw: plain data that processes exchange --------------------


@dataclass(frozen=True)
class CameraInfo:
    """One camera of the task; where envs differ, its size and lens are those of env 0.

    Poses are those of ManiSkill's camera frame: x forward, y left, z up, quaternion wxyz.
    """

    name: str
    kind: CameraKind
    width: int
    height: int
    fovy: float
    """Vertical field of view in radians."""
    near: float
    far: float
    intrinsic: NDArray[np.float32]
    """(3, 3) OpenCV intrinsic matrix in pixels."""
    mount: str | None
    """Name of the body that the camera is mounted on; None if it is fixed."""
    modalities: tuple[str, ...]
    """Modalities of the camera's shader, among ``rgb depth segmentation position normal albedo``."""
    settings: CameraSettings | None = None
    """Settings in the task's own config, even if the camera was moved later; env 0's if the envs differ. None
    if `CameraSettings` cannot express them (a lens that differs between envs)."""
    varies: bool = False
    """Whether the pose differs between envs or from the config, because the task's code moves the camera."""
    site: CallSite | None = None
    """Where the config was made; None if not noted."""
    replaced_shader: str = ""
    """The shader pack in the camera's config, if this machine cannot trace rays and draws with another pack;
    else empty."""

    @property
    def key(self) -> CameraKey:
        """Kind and name: unique in the task."""
        return self.kind, self.name


@dataclass(frozen=True)
class Picture:
    """What one camera of one env saw."""

    camera: str
    kind: CameraKind
    env: int
    pose: NDArray[np.float32]
    """(7,) pose of the camera in the env's frame when the picture was taken: p, then q as wxyz."""
    rgb: NDArray[np.uint8] | None = None
    """(H, W, 3)"""
    depth: NDArray[np.float32] | None = None
    """(H, W) metres along the optical axis, without a limit; 0 where the ray met nothing. If `step_pictures`
    took the picture from ManiSkill's observation: int16 millimetres instead, up to 32767."""
    segmentation: NDArray[np.int32] | None = None
    """(H, W) ids of actors and links; 0 is background. Names in `TaskDescription.segmentation`."""
    position: NDArray[np.float32] | None = None
    """(H, W, 3) metres, in the camera's OpenGL frame (x right, y up, z backward); 0 where the ray met
    nothing. Whole millimetres in ManiSkill's observations; at most 32.767 m with the minimal shader."""
    normal: NDArray[np.float32] | None = None
    """(H, W, 3) of unit length, in the frame of `position`; 0 where the ray met nothing."""
    albedo: NDArray[np.uint8] | None = None
    """(H, W, 3) colour without light."""
    degree: PictureDegree | None = "exact"
    """None for a recorded picture of unknown degree: another program may have recorded it."""

    @property
    def nbytes(self) -> int:
        """Approximate memory in bytes."""
        planes = self.rgb, self.depth, self.segmentation, self.position, self.normal, self.albedo
        return 300 + sum(plane.nbytes for plane in planes if plane is not None)

    @property
    def key(self) -> CameraKey:
        """Kind and name of the picture's camera."""
        return self.kind, self.camera
