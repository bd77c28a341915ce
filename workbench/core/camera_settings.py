"""What can be set about one camera, as plain numbers that cross the pipe.

The same camera is spoken of in four places: the env that renders it, the page where it is moved, the author's file
where it is written, and the files in which other programs want it. All of them speak of these settings, so that
"the camera asked for" and "the camera that there is" can be compared number by number.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

CameraKind = Literal["sensor", "human"]
CameraKey = tuple[CameraKind, str]
"""Kind and name: a sensor and a camera for people may have the same name."""

Matrix3 = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]


@dataclass(frozen=True)
class CameraSettings:
    """Where one camera stands and how it sees: what ManiSkill's ``CameraConfig`` says of it."""

    position: tuple[float, float, float]
    """Metres, in the frame of its mount; in the env's frame if it stands still."""
    quaternion: tuple[float, float, float, float]
    """wxyz, of unit length, in the same frame. The camera looks along x, y is to its left, z is up."""
    fov: float | None
    """Vertical field of view in radians; None where `intrinsic` is given in its place."""
    intrinsic: Matrix3 | None
    """OpenCV's matrix in pixels; None where `fov` is given."""
    width: int
    height: int
    near: float
    """Metres."""
    far: float
    shader_pack: str
    """``minimal``, ``default``, ``rt`` ...: what draws it, and so which modalities it has."""


@dataclass(frozen=True)
class CallSite:
    """Where the author's code made a camera's config."""

    file: str
    line: int
    """Of the call, counted from 1: its first line."""
    function: str
    """Qualified name of the code that it is in, as Python has it: ``PushCubeEnv._default_sensor_configs``."""
