"""What is asked of a worker about a camera, to be looked at once, and what it answers.

Each request is small, so that a worker that plays answers it between two steps: who wants sixteen envs judged asks
sixteen times. A search alone takes long, and is asked of a worker in the background. `number` is the asker's own and
comes back with the answer; a request with another number, or any at all during a search, means that nobody waits for
the one before.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from workbench.authoring.camera_source.cameras import Ran
from workbench.authoring.reference import TaskName
from workbench.core.camera_report import CameraReport
from workbench.core.camera_settings import CameraKey, CameraSettings
from workbench.core.camera_suggestion import OfferedPlacement
from workbench.core.pictures import Picture


@dataclass(frozen=True)
class DrawCamera:
    """The pictures of one camera in some envs; the answer is `CameraPictures`."""

    number: int
    key: CameraKey
    settings: CameraSettings | None
    """Drawn as if it were placed so, and left as it is; None for as it is placed. Of a camera that the env has not
    they must be given: it is one that stands still, and is drawn as with a `scale`."""
    envs: tuple[int, ...]
    modalities: tuple[str, ...] = ("rgb",)
    """Those that its shader does not give are left out."""
    poses: NDArray[np.float32] | None = None
    """(N, B, 7) of the bodies at a moment of the past; None for now."""
    scale: float = 1.0
    """Other than 1: in a picture whose sides are so much of `settings`' (which must be given), by a camera beside the
    env's, with the minimal shader: colours, depth and segmentation."""


@dataclass(frozen=True)
class JudgeCamera:
    """Measure what one camera sees in some envs; the answer is `CameraJudged`."""

    number: int
    key: CameraKey
    settings: CameraSettings | None
    """None for each env's own."""
    envs: tuple[int, ...]
    poses: NDArray[np.float32] | None = None
    """As in `DrawCamera`."""


@dataclass(frozen=True)
class SuggestCameras:
    """Search placements of one camera that see these objects; answered with `Searching`, and at last `Suggested`."""

    number: int
    key: CameraKey
    settings: CameraSettings
    """Its lens; of the pose it matters only which way up a mounted camera's picture is."""
    objects: tuple[str, ...]
    low: tuple[float, float, float]
    """Of the box for the eye, metres in the frame of its mount, or the env's if it has none."""
    high: tuple[float, float, float]
    envs: tuple[int, ...]


@dataclass(frozen=True)
class RunCameras:
    """Run the camera hooks with other texts of the author's files; answered with `CamerasRun`."""

    number: int
    task: TaskName
    """What was opened."""
    texts: Mapping[str, str]
    """By path."""


@dataclass(frozen=True)
class CameraPictures:
    """The answer to `DrawCamera`."""

    number: int
    pictures: tuple[Picture, ...]


@dataclass(frozen=True)
class CameraJudged:
    """The answer to `JudgeCamera`."""

    number: int
    report: CameraReport


@dataclass(frozen=True)
class CamerasRun:
    """The answer to `RunCameras`."""

    number: int
    ran: Ran


@dataclass(frozen=True)
class Searching:
    """How far a search is."""

    number: int
    done: int
    total: int


@dataclass(frozen=True)
class Suggested:
    """The answer to `SuggestCameras`."""

    number: int
    offered: tuple[OfferedPlacement, ...]


@dataclass(frozen=True)
class CameraQuestionFailed:
    """The answer to any of them that cannot be answered."""

    number: int
    why: str


CameraQuestion = DrawCamera | JudgeCamera | SuggestCameras | RunCameras
CameraAnswer = CameraPictures | CameraJudged | Suggested | CamerasRun | CameraQuestionFailed
"""What ends a request."""
