"""Questions about cameras for a worker."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from workbench.cameras.edit.hook_cameras import HookCameras
from workbench.envs.camera_data import CameraKey, CameraSettings, Picture
from workbench.machine.processes.wire import Question
from workbench.pictures.camera_report import CameraReport, OfferedPlacement, SearchSpace
from workbench.task.reference import TaskName

# Each question is small, so that the worker that plays answers it between two steps: sixteen envs take sixteen questions.
# Only a search takes long: it goes to the background process, and any later request there ends the search.


@dataclass(frozen=True)
class DrawCamera(Question[Picture]):
    """The picture of one camera in one env."""

    key: CameraKey
    settings: CameraSettings | None
    """Settings for this picture only; None for the camera's present settings. A camera that the env does not
    have needs settings; it is drawn without a mount, by a temporary camera (see `scale`)."""
    env: int
    modalities: tuple[str, ...] = ("rgb",)
    """Requested modalities; those that the camera's shader does not provide are left out."""
    poses: NDArray[np.float32] | None = None
    """(B, 7) poses of the env's bodies at a past moment; None for now."""
    scale: float = 1.0
    """Factor on the picture's size. A factor other than 1 requires `settings`; a temporary camera with the
    minimal shader then renders colours, depth and segmentation."""


@dataclass(frozen=True)
class MeasureCamera(Question[CameraReport]):
    """Measure what one camera sees in one env."""

    key: CameraKey
    settings: CameraSettings | None
    """Settings to measure with; None for the env's own."""
    env: int
    poses: NDArray[np.float32] | None = None
    """(B, 7) poses of the env's bodies at a past moment, as in `DrawCamera`; None for now."""


@dataclass(frozen=True)
class SuggestCameras(Question[tuple[OfferedPlacement, ...]]):
    """Search for placements of one camera that see the objects of `space` in these envs."""

    space: SearchSpace
    envs: tuple[int, ...]


@dataclass(frozen=True)
class RunCameras(Question[HookCameras]):
    """Run the camera hooks with other texts of the author's files."""

    task: TaskName
    """Reference with which the task was opened."""
    texts: Mapping[str, str]
    """Text of each file by path."""


CameraQuestion = DrawCamera | MeasureCamera | SuggestCameras | RunCameras
