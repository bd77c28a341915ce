"""What a worker is asked about a camera, to be looked at once.

Each question is small, so that a worker that plays answers it between two steps: who wants sixteen envs judged asks
sixteen times. A search alone takes long, and is asked of a worker in the background; any request behind it ends it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from workbench.authoring.camera_source.cameras import Ran
from workbench.authoring.reference import TaskName
from workbench.core.camera_report import CameraReport, OfferedPlacement
from workbench.core.camera_settings import CameraKey, CameraSettings
from workbench.core.pictures import Picture
from workbench.session.calls import Question


@dataclass(frozen=True)
class DrawCamera(Question[Picture]):
    """The picture of one camera in one env."""

    key: CameraKey
    settings: CameraSettings | None
    """Drawn as if it were placed so, and left as it is; None for as it is placed. Of a camera that the env has not
    they must be given: it is one that stands still, and is drawn as with a `scale`."""
    env: int
    modalities: tuple[str, ...] = ("rgb",)
    """Those that its shader does not give are left out."""
    poses: NDArray[np.float32] | None = None
    """(B, 7) of the env's bodies at a moment of the past; None for now."""
    scale: float = 1.0
    """Other than 1: in a picture whose sides are so much of `settings`' (which must be given), by a camera beside the
    env's, with the minimal shader: colours, depth and segmentation."""


@dataclass(frozen=True)
class JudgeCamera(Question[CameraReport]):
    """Measure what one camera sees in one env."""

    key: CameraKey
    settings: CameraSettings | None
    """None for the env's own."""
    env: int
    poses: NDArray[np.float32] | None = None
    """As in `DrawCamera`."""


@dataclass(frozen=True)
class SuggestCameras(Question[tuple[OfferedPlacement, ...]]):
    """Search placements of one camera that see these objects."""

    key: CameraKey
    settings: CameraSettings
    """Its lens; of the pose it matters only which way up a mounted camera's picture is."""
    objects: tuple[str, ...]
    low: tuple[float, float, float]
    """Of the box for the eye, metres in the frame of its mount, or the env's if it has none."""
    high: tuple[float, float, float]
    envs: tuple[int, ...]


@dataclass(frozen=True)
class RunCameras(Question[Ran]):
    """Run the camera hooks with other texts of the author's files."""

    task: TaskName
    """What was opened."""
    texts: Mapping[str, str]
    """By path."""


CameraQuestion = DrawCamera | JudgeCamera | SuggestCameras | RunCameras
