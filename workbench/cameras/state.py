"""The state of the camera studio as one value: placements, the selected camera, reports and the edit of the file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from workbench.cameras.commands import CopyTask, RevertCameraChange, SaveCameraChange
from workbench.cameras.events import EditWanted, StudioEffect
from workbench.cameras.placements import Placements, usual_distance
from workbench.cameras.questions import DrawCamera
from workbench.cameras.view import EditRequest, EditState, StudioCamera, StudioResults, StudioView
from workbench.envs.camera_data import (
    NOT_ON_THE_GPU,
    CameraInfo,
    CameraKey,
    CameraSettings,
    Picture,
    differences,
)
from workbench.envs.step_result import StepResult
from workbench.live.messages import PlaceCamera
from workbench.live.process.background_jobs import JobProgress
from workbench.live.run import Run
from workbench.pictures.camera_conventions import pose_in_env

Previewed = tuple[StepResult | None, DrawCamera]
"""A step and the question that draws it."""
EditAsked = EditWanted | SaveCameraChange | RevertCameraChange | CopyTask


@dataclass(frozen=True)
class Edits:
    """Edits of the author's file, made one after another."""

    shown: EditState = EditState()
    done: tuple[EditState, ...] = ()
    """Edits in the file that can be reverted, the newest last."""
    removed: Mapping[CameraKey, CameraSettings] = field(default_factory=dict)
    """Placements of cameras that were removed from the file."""
    folder: Path = Path()
    """Folder for a copy of a task."""
    copied: Path | None = None
    """The copy of the task that is being opened."""
    just_copied: str = ""
    """First sentence of the message about the plan in the copy."""
    waiting: tuple[EditAsked, ...] = ()
    """Requests queued behind the current edit, the next first."""
    busy: bool = False
    """Whether an edit is in progress."""
    left: EditRequest | None = None
    """Request of the plan that was shown before the current plan."""
    before: tuple[EditState, tuple[EditState, ...]] = EditState(), ()
    """`shown` and `done` before the current change of the file."""
    closed: bool = False


@dataclass(frozen=True)
class Studio:
    """State of the studio. The descriptions of the cameras are in ``Run.task``.

    A placement is stored here (with undo), in the worker's live cameras, and finally in the author's file.
    The state here is authoritative: after each load it is sent to the worker again, so that neither a reload
    nor a crash moves a camera. If the author changed the camera in the file, the file wins.
    """

    placements: Placements = Placements()
    selected: CameraKey | None = None
    was_chosen: bool = False
    """Whether a camera or "none" was chosen, by the user or automatically."""
    is_open: bool = False
    """Whether a page has opened the studio. From then on, a camera is chosen automatically if no choice was
    made yet."""
    select_when_loaded: CameraKey | None = None
    """The camera that was selected in the previous session."""
    problem: str = ""
    """Message about the last failure."""
    preview_scale: float = 1.0
    """Size of the preview relative to the camera's own; 1 for no preview."""
    preview: Picture | None = None
    preview_problem: str = ""
    previewed: Previewed | None = None
    """Step and question of the last preview."""
    drawing: bool = False
    """Whether a preview is being drawn."""
    results: StudioResults = StudioResults()
    edits: Edits = Edits()


Change = tuple[Studio, list[StudioEffect]]
"""The studio after an event, and the effects to perform."""


@dataclass(frozen=True)
class KeptPlacements:
    """Placements with their undo steps, and the selected camera, for a later session of the same task."""

    placements: Placements
    selected: CameraKey | None


def first_studio(kept: KeptPlacements | None = None) -> Studio:
    """The studio before a version is loaded. The folder for copies of a task is the current folder.

    Args:
        kept: state kept from the previous session of the task.
    """
    edits = Edits(folder=Path.cwd())
    if kept is None:
        return Studio(edits=edits)
    return Studio(kept.placements, select_when_loaded=kept.selected, edits=edits)


def kept_placements(studio: Studio) -> KeptPlacements:
    return KeptPlacements(studio.placements, studio.selected or studio.select_when_loaded)


def placed_cameras(studio: Studio) -> tuple[PlaceCamera, ...]:
    """All placements, as requests to another worker."""
    return tuple(PlaceCamera(key, settings) for key, settings in studio.placements.placed.items())


# --- cameras ---------------------------------------------------------------------------------------


def info_of(run: Run, key: CameraKey) -> CameraInfo | None:
    return None if run.task is None else run.task.camera(key)


def refusal(run: Run, key: CameraKey) -> str | None:
    """Reason why a camera cannot be placed; None if it can."""
    info = info_of(run, key)
    if info is None:
        return f"there is no {key[0]} camera {key[1]}"
    if run.task is not None and run.task.backend == "gpu":
        return NOT_ON_THE_GPU
    if info.settings is None:
        return "its pose is invalid, or its lens differs between envs, so it cannot have one placement"
    return None


def shown_step(run: Run) -> StepResult | None:
    """The step of the shown moment; None before a task is loaded."""
    shown = None if run.past is None else run.past.shown
    return run.step if shown is None else shown.step


def mount_pose(run: Run, info: CameraInfo) -> NDArray[np.float32] | None:
    """(7,) pose of the camera's mount in the selected env's frame, at the shown moment; None without a mount,
    or if the step does not have this body."""
    step, env = shown_step(run), run.env
    if info.mount is None or run.task is None or step is None:
        return None
    names = run.task.geometry.body_names
    if info.mount not in names or step.poses.shape[1] != len(names) or env >= len(step.poses):
        return None  # the step is of another version
    return step.poses[env, names.index(info.mount)]


def studio_camera(studio: Studio, run: Run, info: CameraInfo) -> StudioCamera:
    return StudioCamera(
        key=info.key,
        info=info,
        now=studio.placements.now(info.key),
        moved=info.key in studio.placements.placed,
        mount_pose=mount_pose(run, info),
        refused=refusal(run, info.key) or "",
    )


def selected_camera(studio: Studio, run: Run) -> StudioCamera | None:
    info = None if studio.selected is None else info_of(run, studio.selected)
    return None if info is None else studio_camera(studio, run, info)


def settings_in_file(placements: Placements, run: Run) -> dict[CameraKey, CameraSettings]:
    """Settings of the running version's cameras, as in the file. A camera without a target in the file keeps
    its present target distance; if it has none, it gets `usual_distance`.

    Args:
        placements: placements before the version was loaded.
    """

    def distance(info: CameraInfo, settings: CameraSettings) -> float | None:
        now, mount = placements.now(info.key), mount_pose(run, info)
        if now is not None and now.distance is not None:
            return now.distance
        if (mount is None) != (info.mount is None):
            return None
        return usual_distance(pose_in_env(settings, mount))

    return {
        info.key: settings if settings.distance else replace(settings, distance=distance(info, settings))
        for info in (() if run.task is None else run.task.cameras)
        if (settings := info.settings) is not None
    }


# --- view ------------------------------------------------------------------------------------------


def view_of(studio: Studio, run: Run, progress: JobProgress | None) -> StudioView:
    """The studio's part of `SessionView`, at the shown moment.

    Args:
        progress: progress of the running job.
    """
    results, preview = studio.results, studio.preview
    measured = None if results.report_of is None else studio.placements.now(results.report_of)
    was = results.report_settings
    # Ignore rounding of written numbers.
    moved = measured is None or was is None or bool(differences(measured, was, close=3e-4))
    is_shown = preview is not None and (preview.key, preview.env) == (studio.selected, run.env)
    return StudioView(
        cameras=()
        if run.task is None
        else tuple(studio_camera(studio, run, one) for one in run.task.cameras),
        selected=studio.selected,
        was_chosen=studio.was_chosen,
        undo=studio.placements.undo_label,
        redo=studio.placements.redo_label,
        edit_state=studio.edits.shown,
        copies_to=studio.edits.folder,
        results=results,
        report_stale=results.report is not None and (moved or results.outdated),
        preview_scale=studio.preview_scale,
        preview=preview if is_shown else None,
        progress=progress,
        problem=studio.problem or results.problem or studio.preview_problem,
    )
