"""What the page reads of the camera studio: immutable, a part of `SessionView`.

Everything here is plain data and numpy. What can be done is in `camera_studio`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from workbench.core.camera_data import CameraInfo, CameraKey, CameraSettings, Picture
from workbench.core.cameras.report import CameraReport, OfferedPlacement

if TYPE_CHECKING:
    from workbench.authoring.camera_source.disk import SourceEdit
from workbench.session.process.job_lane import JobProgress

WritingStage = Literal["none", "planned", "refused", "written", "checked", "mismatch", "undone"]
"""``planned``: shown, not made. ``written``: in the file, the reload is awaited. ``checked``: the new env has what
was written. ``mismatch``: it has something else. ``undone``: taken back out of the file."""


Change = Literal["edit", "add", "duplicate", "rename", "remove"]
"""Of a camera in the file."""


@dataclass(frozen=True)
class Wish:
    """What is to be written."""

    what: Change
    key: CameraKey
    """The camera that is changed, copied, renamed or removed, or the one that is added."""
    settings: CameraSettings | None = None
    """What it is to have, or has where it is removed; None for as it is placed when it is asked for."""
    name: str = ""
    """The new name."""
    about: str = ""
    """What is said beside its plan, for the reader."""

    @property
    def result(self) -> CameraKey:
        """The camera that the file has when it is done."""
        return (self.key[0], self.name) if self.name else self.key


@dataclass(frozen=True)
class StudioCamera:
    """One camera, as the file has it and as it is placed."""

    key: CameraKey
    info: CameraInfo
    """Of the live camera; its `settings` are what the file says."""
    now: CameraSettings | None
    """As it is placed; equal to ``info.settings`` while it is untouched. None only where that is None."""
    moved: bool
    """It is placed otherwise than the file says."""
    mount_pose: NDArray[np.float32] | None
    """(7,) p and wxyz of its mount in the selected env's frame, at the shown moment. None: it stands still in the
    env's frame."""
    refused: str = ""
    """Why it cannot be placed, as a sentence; empty where it can."""


@dataclass(frozen=True)
class Writing:
    """How far a change is on its way into the file. One at a time."""

    stage: WritingStage = "none"
    wish: Wish | None = None
    edit: SourceEdit | None = None
    snippet: str = ""
    """Of what was refused: what the author can copy into the file themselves."""
    message: str = ""
    """One sentence or two: what happened, and what to do next."""
    can_copy: bool = False
    """Refused since the file is not the user's to edit, and a copy of it would be: see `StudioFile.copy_task`."""
    picture: Picture | None = None
    """What the camera would see whose addition is planned, once it was looked."""
    loading: bool = False
    """It is in the file, or out of it again, and the version with that has not come in yet."""

    @property
    def what(self) -> Change:
        return "edit" if self.wish is None else self.wish.what


@dataclass(frozen=True)
class Picked:
    """What a pixel of a picture shows."""

    key: CameraKey
    env: int
    u: float
    """0 at the left border, 1 at the right."""
    v: float
    """0 at the top."""
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
    """Which moment of which env's episode an entry of a report over steps is of."""

    serial: int
    env: int
    step: int
    """Control steps since the env's reset."""


@dataclass(frozen=True)
class Looked:
    """What came of looking at the cameras, by now."""

    report: CameraReport | None = None
    """Of the last judgement."""
    report_of: CameraKey | None = None
    report_settings: CameraSettings | None = None
    """How the camera stood when it was judged."""
    report_seeds: int = 0
    """Fresh episodes that it is of; 0 for the envs at the moment that was shown."""
    report_moments: tuple[MeasuredMoment, ...] = ()
    """Where it is of an episode's steps: which one each of ``report.envs`` is; empty for all others."""
    outdated: bool = False
    """The report is of a version that was."""
    measuring: bool = False
    """Another judgement is under way, of which nothing is known yet."""
    suggestions: tuple[OfferedPlacement, ...] = ()
    """Best first."""
    suggestions_of: CameraKey | None = None
    compared: tuple[Picture, Picture] | None = None
    """The camera as it is placed, and as `CameraStudio.compare` was told."""
    picked: Picked | None = None
    sheet: tuple[Picture, ...] = ()
    """The selected camera's picture in every env, worst first where it was judged."""
    problem: str = ""
    """Why the last question was not answered, as a sentence."""

    def report_over_envs(self, key: CameraKey) -> CameraReport | None:
        """The report, if it is of this camera and of the envs at one moment."""
        return (
            self.report if (self.report_of, self.report_seeds, self.report_moments) == (key, 0, ()) else None
        )


@dataclass(frozen=True)
class StudioView:
    cameras: tuple[StudioCamera, ...] = ()
    selected: CameraKey | None = None
    undo: str | None = None
    """What `CameraStudio.undo` takes back, in words (``moved base_camera``); None if there is nothing."""
    redo: str | None = None
    writing: Writing = Writing()
    looked: Looked = Looked()
    """What came of looking at the cameras."""
    report_stale: bool = False
    """The camera was moved since it was judged, or another version runs."""
    quick_scale: float = 1.0
    """Other than 1: the chosen camera is looked through in a picture of so much of its own size."""
    quick: Picture | None = None
    """That picture, while there is one."""
    progress: JobProgress | None = None
    """None while nothing runs in the background."""
    problem: str = ""
    """What went wrong last, or was decided over the author's head, as a sentence."""
    serial: int = 0
    """Grows with every change of anything but `StudioCamera.mount_pose`."""

    def camera(self, key: CameraKey | None) -> StudioCamera | None:
        """The camera of that key; None if there is none."""
        return next((camera for camera in self.cameras if camera.key == key), None)

    @property
    def chosen(self) -> StudioCamera | None:
        """The selected camera."""
        return self.camera(self.selected)

    @property
    def placeable(self) -> StudioCamera | None:
        """The selected camera, if it can be placed: then it is known how it is."""
        chosen = self.chosen
        return None if chosen is None or chosen.now is None or chosen.refused else chosen
