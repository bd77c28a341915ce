"""Events of the camera studio, and the effects that follow from them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from workbench.cameras.commands import MAX_MEASURED, Measured
from workbench.cameras.questions import DrawCamera, MeasureCamera
from workbench.cameras.view import EditRequest, EditState, MeasuredMoment, PickedPixel
from workbench.envs.camera_data import CameraInfo, CameraKey, CameraSettings, Picture
from workbench.live.events import Send
from workbench.live.history.moments import ShownMoment
from workbench.live.messages import Load
from workbench.pictures.camera_report import CameraReport, OfferedPlacement, SearchSpace
from workbench.task.description import TaskDescription
from workbench.task.write_edits import SourceEdit

Triple = tuple[float, float, float]
Case = tuple[int, NDArray[np.float32] | None, MeasuredMoment | None]
"""A case in which a camera is measured: the env; the poses (B, 7) of its bodies, None for the present ones;
the moment of the history, None unless the camera is measured over steps."""

Lane = Literal["live", "background", "preview", "new camera"]
"""Each lane has one job at a time; a new job replaces the running one. ``live`` uses the worker that plays,
``background`` the background process."""

# --- requests of a page that are not commands ----------------------------------------------------


@dataclass(frozen=True)
class CameraChosen:
    """Select the camera that the page works on, or none."""

    key: CameraKey | None


@dataclass(frozen=True)
class CameraPlaced:
    """Place a camera, live. If placements arrive too fast for the worker, only the newest is applied."""

    key: CameraKey
    settings: CameraSettings
    control: object = None
    """Id of the control; successive placements by the same control are one undo step (a drag)."""
    pause: float = math.inf
    """Seconds without a placement after which a new undo step begins."""


@dataclass(frozen=True)
class StudioOpened:
    """A page has opened the studio."""


@dataclass(frozen=True)
class MeasureWanted:
    """Measure the selected camera, as placed: over all envs at the shown moment; over evenly spaced steps of the selected
    env's episode; or over freshly reset envs, in the background."""

    over: Measured
    most: int = MAX_MEASURED
    """Maximum number of steps or resets."""


@dataclass(frozen=True)
class SuggestionsWanted:
    """Search for placements of the selected camera that see these objects in fresh episodes."""

    objects: tuple[str, ...]
    """Names of objects, or of single links of them (``TaskDescription.objects``)."""
    low: Triple
    high: Triple
    """Corners of the box for the eye, in metres: in the frame of the camera's mount, or in the env's frame if
    the camera has no mount."""
    seeds: int
    """Number of episodes, at most one per env."""


@dataclass(frozen=True)
class ComparisonWanted:
    """Draw the shown env twice with the selected camera: as placed, and with other settings."""

    other: CameraSettings


@dataclass(frozen=True)
class SheetWanted:
    """Draw the selected camera's pictures of all envs, one by one; the worst env first if a report covers
    these envs."""


@dataclass(frozen=True)
class EditWanted:
    """Plan the edit of the file for a request."""

    request: EditRequest


# --- results of jobs -----------------------------------------------------------------------------


@dataclass(frozen=True)
class PreviewDrawn:
    """The last requested preview was drawn."""

    picture: Picture


@dataclass(frozen=True)
class ReportMade:
    """A report over the cases measured so far was made."""

    report: CameraReport
    of: CameraKey
    settings: CameraSettings | None
    """The camera's settings when it was measured."""
    seeds: int
    """Number of fresh episodes; 0 if the report is over envs at the shown moment or over steps."""
    moments: tuple[MeasuredMoment, ...]


@dataclass(frozen=True)
class Measuring:
    """A measurement has begun (`on`) or ended, whether complete or not."""

    on: bool


@dataclass(frozen=True)
class SuggestionsFound:
    """Placements that see these objects were found, best first."""

    found: tuple[OfferedPlacement, ...]
    objects: tuple[str, ...]


@dataclass(frozen=True)
class PicturesCompared:
    """The shown env was drawn twice by one camera: as placed, and with other settings."""

    now: Picture
    other: Picture


@dataclass(frozen=True)
class SheetPictureDrawn:
    """The next picture of the sheet was drawn."""

    picture: Picture


@dataclass(frozen=True)
class PixelPicked:
    """A pixel was probed."""

    picked: PickedPixel


@dataclass(frozen=True)
class WorkFailed:
    """The job of a lane failed."""

    lane: Lane
    why: str


@dataclass(frozen=True)
class PlanFound:
    """The edit for a request was planned or refused."""

    request: EditRequest
    state: EditState


@dataclass(frozen=True)
class NewCameraDrawn:
    """The job for the preview of a new camera has ended; `picture` is None if nothing was drawn."""

    request: EditRequest
    picture: Picture | None


@dataclass(frozen=True)
class FileChanged:
    """The edit was written or reverted."""


@dataclass(frozen=True)
class FileNotChanged:
    """The file was not changed."""

    reason: str


@dataclass(frozen=True)
class TaskCopied:
    """The task's file was copied, or could not be copied."""

    file: Path | None
    """The copy; None on failure."""
    state: EditState


@dataclass(frozen=True)
class EditFailed:
    """A bug of the workbench ended an edit."""

    error: str


@dataclass(frozen=True)
class StudioClosed:
    """The studio is closing: no edit starts any more."""


StudioEvent = (
    CameraChosen
    | CameraPlaced
    | StudioOpened
    | MeasureWanted
    | SuggestionsWanted
    | ComparisonWanted
    | SheetWanted
    | EditWanted
    | PreviewDrawn
    | ReportMade
    | Measuring
    | SuggestionsFound
    | PicturesCompared
    | SheetPictureDrawn
    | PixelPicked
    | WorkFailed
    | PlanFound
    | NewCameraDrawn
    | FileChanged
    | FileNotChanged
    | TaskCopied
    | EditFailed
    | StudioClosed
)

# --- effects ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class StopJobs:
    """Cancel the jobs of these lanes; results so far stay."""

    lanes: tuple[Lane, ...]


@dataclass(frozen=True)
class StopQuestion:
    """Cancel the question that an edit has sent to the worker."""


@dataclass(frozen=True)
class DrawPreview:
    """Draw the selected camera at the size of the preview."""

    question: DrawCamera


@dataclass(frozen=True)
class MeasureLive:
    """Measure a camera in these cases, with a report after every `every` cases."""

    what: str
    question: MeasureCamera
    """The question; env and poses are filled in for each case."""
    settings: CameraSettings | None
    """The camera's present settings."""
    cases: tuple[Case, ...]
    every: int


@dataclass(frozen=True)
class MeasureSeeds:
    """Measure a camera in fresh episodes, with partial reports."""

    what: str
    question: MeasureCamera
    settings: CameraSettings | None
    load: Load
    seeds: int


@dataclass(frozen=True)
class Suggest:
    """Search for placements in fresh episodes."""

    what: str
    space: SearchSpace
    load: Load
    seeds: int


@dataclass(frozen=True)
class Compare:
    """Draw one env twice with a camera: as placed, and with other settings."""

    key: CameraKey
    other: CameraSettings
    moment: ShownMoment


@dataclass(frozen=True)
class DrawEnvs:
    """Draw a camera's pictures of these envs."""

    key: CameraKey
    env_idx: tuple[int, ...]
    moment: ShownMoment


@dataclass(frozen=True)
class Pick:
    """Probe a pixel of a camera."""

    info: CameraInfo
    u: float
    v: float
    moment: ShownMoment
    segmentation: dict[int, str]


@dataclass(frozen=True)
class FindPlan:
    """Plan the edit of the files on disk for a request."""

    request: EditRequest
    task: TaskDescription
    info: CameraInfo | None
    load: Load | None
    """The load of the running version."""


@dataclass(frozen=True)
class DrawNewCamera:
    """Draw the picture of a new camera."""

    request: EditRequest
    question: DrawCamera


@dataclass(frozen=True)
class ChangeFile:
    """Write or revert an edit."""

    edit: SourceEdit
    revert: bool


@dataclass(frozen=True)
class CopyToFolder:
    """Copy the task's file into a folder, and open the copy."""

    task: TaskDescription
    folder: Path


StudioEffect = (
    Send
    | StopJobs
    | StopQuestion
    | DrawPreview
    | MeasureLive
    | MeasureSeeds
    | Suggest
    | Compare
    | DrawEnvs
    | Pick
    | FindPlan
    | DrawNewCamera
    | ChangeFile
    | CopyToFolder
)
