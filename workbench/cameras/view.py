"""The snapshot of the camera studio, a part of `SessionView`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from workbench.envs.camera_data import CameraInfo, CameraKey, CameraSettings, Picture
from workbench.live.view import SessionView
from workbench.pictures.camera_report import CameraReport, OfferedPlacement

if TYPE_CHECKING:
    from workbench.task.write_edits import SourceEdit
from workbench.live.process.background_jobs import JobProgress

EditStage = Literal["none", "planned", "refused", "written", "checked", "mismatch", "undone"]
"""``planned``: shown, not written. ``written``: in the file, which is not loaded again yet. ``checked``: the
new env's camera equals the edit. ``mismatch``: the new env's camera does not equal the edit. ``undone``:
reverted in the file."""


EditKind = Literal["edit", "add", "duplicate", "rename", "remove"]
"""Kind of change to a camera in the file."""


@dataclass(frozen=True)
class EditRequest:
    """A requested change of a camera in the file."""

    what: EditKind
    key: CameraKey
    """The camera that is changed, copied, renamed, removed or added."""
    settings: CameraSettings | None = None
    """New settings (for a removal, the present ones); None stands for the camera's placement when the request
    is made."""
    name: str = ""
    """The new name."""
    about: str = ""
    """A note that is shown with the plan."""

    @property
    def result(self) -> CameraKey:
        """Key of the camera in the file after the change."""
        return (self.key[0], self.name) if self.name else self.key


@dataclass(frozen=True)
class StudioCamera:
    """A camera with its settings in the file and as placed."""

    key: CameraKey
    info: CameraInfo
    """Description of the live camera; its `settings` are those of the file."""
    now: CameraSettings | None
    """Settings as placed; equal to ``info.settings`` if the camera is not placed. None only if
    ``info.settings`` is None."""
    moved: bool
    """Whether the placement differs from the file."""
    mount_pose: NDArray[np.float32] | None
    """(7,) p and wxyz of its mount in the selected env's frame, at the shown moment. None if the camera has
    no mount, or if the shown step does not have the mount."""
    refused: str = ""
    """Reason why the camera cannot be placed, as a clause; empty if it can."""


@dataclass(frozen=True)
class EditState:
    """State of the edit of the file; there is one edit at a time."""

    stage: EditStage = "none"
    request: EditRequest | None = None
    edit: SourceEdit | None = None
    snippet: str = ""
    """Code for a refused edit, which the author can copy into the file."""
    message: str = ""
    """One or two sentences: what happened, and what to do next."""
    can_copy: bool = False
    """Whether the edit was refused because this file must not be edited, so that `CopyTask` is offered."""
    picture: Picture | None = None
    """Preview of a new camera, once it is drawn."""
    drawing: bool = False
    """Whether the preview is being drawn."""
    loading: bool = False
    """Whether the edit was written or reverted and the changed file is not loaded yet."""

    @property
    def what(self) -> EditKind:
        return "edit" if self.request is None else self.request.what


@dataclass(frozen=True)
class PickedPixel:
    """Result of probing a pixel."""

    key: CameraKey
    env: int
    u: float
    """0 at the left edge, 1 at the right."""
    v: float
    """0 at the top edge, 1 at the bottom."""
    pixel: tuple[int, int]
    """Column and row."""
    body: str | None
    """Body name; None for the background."""
    depth: float | None
    """Metres along the optical axis; None for the background."""
    point: tuple[float, float, float] | None
    """Metres, in the env's frame; None for the background."""


@dataclass(frozen=True)
class MeasuredMoment:
    """The moment and env of one entry in a report over steps."""

    serial: int
    env: int
    step: int
    """Control steps since the env's reset."""


@dataclass(frozen=True)
class StudioResults:
    """The newest results of the jobs: report, suggestions, compared pictures, picked pixel and sheet."""

    report: CameraReport | None = None
    """The newest report."""
    report_of: CameraKey | None = None
    report_settings: CameraSettings | None = None
    """The camera's settings when it was measured."""
    report_seeds: int = 0
    """Number of fresh episodes; 0 for a report over the envs at the shown moment or over steps."""
    report_moments: tuple[MeasuredMoment, ...] = ()
    """In a report over steps, the moment of each entry of ``report.envs``; empty in other reports."""
    outdated: bool = False
    """Whether the report is of an earlier version."""
    measuring: bool = False
    """Whether a new report is being made and has no numbers yet."""
    suggestions: tuple[OfferedPlacement, ...] = ()
    """Suggested placements, best first."""
    suggestions_of: CameraKey | None = None
    compared: tuple[Picture, Picture] | None = None
    """Pictures of the camera as placed, and with the settings of `ComparisonWanted`."""
    picked: PickedPixel | None = None
    sheet: tuple[Picture, ...] = ()
    """The selected camera's picture in every env, the worst env first if a report covers these envs."""
    problem: str = ""
    """Why the last job failed, as a sentence."""

    def report_over_envs(self, key: CameraKey) -> CameraReport | None:
        """The report, if it is of this camera and over the envs at one moment."""
        return (
            self.report if (self.report_of, self.report_seeds, self.report_moments) == (key, 0, ()) else None
        )


@dataclass(frozen=True)
class StudioView:
    """Immutable snapshot of the studio: plain data and NumPy arrays."""

    cameras: tuple[StudioCamera, ...] = ()
    selected: CameraKey | None = None
    was_chosen: bool = False
    """Whether a camera or "none" was chosen, by the user or automatically."""
    undo: str | None = None
    """Text: the change that `UndoCamera` would undo (``moved base_camera``); None if there is none."""
    redo: str | None = None
    edit_state: EditState = EditState()
    copies_to: Path = Path()
    """Folder for a copy of the task."""
    results: StudioResults = StudioResults()
    """Reports, suggestions, pictures."""
    report_stale: bool = False
    """Whether the camera was moved since it was measured, or another version runs."""
    preview_scale: float = 1.0
    """Size of the preview relative to the camera's own; 1 for no preview."""
    preview: Picture | None = None
    """The preview, while there is one."""
    progress: JobProgress | None = None
    """Progress of the running job; None while no job runs."""
    problem: str = ""
    """The last failure, or a placement that was dropped, as a sentence."""

    def camera(self, key: CameraKey | None) -> StudioCamera | None:
        """The camera of that key; None if there is none."""
        return next((camera for camera in self.cameras if camera.key == key), None)

    @property
    def chosen(self) -> StudioCamera | None:
        """The selected camera."""
        return self.camera(self.selected)

    @property
    def placeable(self) -> StudioCamera | None:
        """The selected camera, if it can be placed; its `now` is not None then."""
        chosen = self.chosen
        return None if chosen is None or chosen.now is None or chosen.refused else chosen


@dataclass(frozen=True)
class ShownCameras:
    """Cameras and pictures of the shown env: of a session at the shown moment, or of a recording."""

    cameras: tuple[CameraInfo, ...]
    cameras_serial: int
    """Number that differs for each set of cameras."""
    pictures: Mapping[CameraKey, Picture]
    pictures_serial: int
    segmentation: dict[int, str]
    """Names of the ids in a segmentation."""
    env: int = 0
    milliseconds: float | None = None
    """Render time of the newest picture; None for a recorded picture, and for one drawn while steps were made."""
    can_render: bool = True
    placed: CameraKey | None = None
    """The camera that is selected in the Studio."""
    preview: bool = False
    """Whether the placed camera is shown at another size than its own."""
    failed: Mapping[CameraKey, str] = field(default_factory=dict)
    """Cameras that cannot be drawn, with the reason as a sentence."""
    hidden: tuple[str, ...] = ()
    """Bodies that the task hides from its sensors."""


def shown_cameras(view: SessionView) -> ShownCameras | None:
    """Cameras and pictures of the shown env; None while there is no task."""
    task, studio = view.task, view.of(StudioView)
    return task and ShownCameras(
        task.cameras,
        view.cameras_serial,
        view.pictures,
        view.pictures_serial,
        task.segmentation,
        view.selected_env,
        view.picture_milliseconds,
        task.can_render,
        studio.selected,
        studio.preview_scale != 1.0,
        view.failed_cameras,
        task.geometry.hidden_names,
    )
