"""Cameras of the running version, their placements with undo, and the selected one."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from workbench.authoring.camera_source import calibration_files
from workbench.core.camera_data import NOT_ON_THE_GPU, CameraInfo, CameraKey, CameraSettings, differences
from workbench.core.cameras.conventions import axes_of, pose_in_env
from workbench.core.env.step_result import StepResult
from workbench.jobs.task import TaskDescription
from workbench.session.cameras.view import StudioCamera

_MOST_STEPS = 500
NEAREST_TARGET, FARTHEST_TARGET, USUAL = 0.1, 3.0, 1.0
"""Metres in front of the eye: limits and default of the target of a camera without one."""


@dataclass(frozen=True)
class PlacementChange:
    """One undoable change of one camera."""

    key: CameraKey
    before: CameraSettings
    after: CameraSettings
    label: str
    """Text such as ``moved base_camera``."""
    control: object = None
    """Id of the control that made it."""
    at: float = 0.0
    """Seconds of `time.monotonic`."""


class Placements:
    """Placements of cameras, with undo and redo.

    A step holds a camera's whole settings before and after, so it can be undone even if the file changed since. A gesture
    (a drag has a hundred positions) is one step. A new version keeps unwritten placements, except of cameras whose
    settings changed in the file: the author wrote these, so they count, and Undo brings the placement back.
    """

    def __init__(self) -> None:
        self.in_file: dict[CameraKey, CameraSettings] = {}
        """Settings of the loaded version."""
        self.placed: dict[CameraKey, CameraSettings] = {}
        """Settings of cameras that differ from the file; a direct change of this dict is no step of undo."""
        self._done: list[PlacementChange] = []
        self._undone: list[PlacementChange] = []

    def copy(self) -> Placements:
        """A copy of the placements and steps, independent of this object."""
        other = Placements()
        other.in_file, other.placed = dict(self.in_file), dict(self.placed)
        other._done, other._undone = list(self._done), list(self._undone)
        return other

    def now(self, key: CameraKey) -> CameraSettings | None:
        """A camera's present settings; None if it is missing, or settings cannot describe its config."""
        return self.placed.get(key, self.in_file.get(key))

    @property
    def undo_label(self) -> str | None:
        return self._done[-1].label if self._done else None

    @property
    def redo_label(self) -> str | None:
        return self._undone[-1].label if self._undone else None

    def place(
        self,
        key: CameraKey,
        settings: CameraSettings,
        control: object = None,
        pause: float = math.inf,
        label: str = "",
    ) -> bool:
        """Place a camera; `control` and `pause` as in `CameraStudio.place`. False if it is missing or nothing changes."""
        before, now = self.now(key), time.monotonic()
        if before is None:
            return False
        last = self._done[-1] if self._done and self._done[-1].key == key else None
        if not differences(before, settings):
            # The distance of the target is no step of its own.
            aimed = self.set_distance(key, settings.distance)
            if last is not None:
                self._done[-1] = replace(last, after=aimed)
            return False
        if last is not None and control is not None and last.control == control and now - last.at <= pause:
            before = last.before
            self._done.pop()
        label = label or _step_label(key, before, settings)
        self._add_step(PlacementChange(key, before, settings, label, control, now))
        self._put(key, settings)
        return True

    def set_distance(self, key: CameraKey, distance: float | None) -> CameraSettings:
        """Set the distance of a camera's target in metres; returns the new settings."""
        held = self.placed if key in self.placed else self.in_file
        held[key] = replace(held[key], distance=distance)
        return held[key]

    def _add_step(self, step: PlacementChange) -> None:
        self._done = [*self._done[-_MOST_STEPS + 1 :], step]
        self._undone.clear()

    def undo(self) -> PlacementChange | None:
        """Undo a step; returns it, or None if there is none."""
        if not self._done:
            return None
        step = self._done.pop()
        self._undone.append(step)
        self._put(step.key, step.before)
        return step

    def redo(self) -> PlacementChange | None:
        """Redo a step; returns it, or None if there is none."""
        if not self._undone:
            return None
        step = self._undone.pop()
        self._done.append(replace(step, control=None))
        self._put(step.key, step.after)
        return step

    def refused(self, key: CameraKey) -> None:
        """The worker refused the camera's newest placement: restore the one before."""
        last = self._done[-1] if self._done else None
        if last is not None and last.key == key:
            self._done.pop()
            self._put(key, last.before)
        else:
            self.placed.pop(key, None)

    def edit_undone(self, key: CameraKey, written: CameraSettings, in_file: CameraSettings) -> bool:
        """A placement was written to the file and taken out again: use the file's settings, and let Undo bring the
        placement back. False, without a change, if the camera was placed elsewhere since.

        Args:
            written: the settings that were taken out of the file.
            in_file: the file's settings now.
        """
        placed = self.placed.get(key)
        if placed is not None and differences(placed, written):
            return False
        self.placed.pop(key, None)
        if differences(written, in_file):
            self._add_step(PlacementChange(key, written, in_file, f"reverted the change of {key[1]}"))
        return True

    def rename(self, key: CameraKey, new: CameraKey) -> None:
        """Move a camera's placements and steps to another key."""
        if key in self.placed:
            self.placed[new] = self.placed.pop(key)
        if key in self.in_file:
            self.in_file[new] = self.in_file[key]
        for steps in (self._done, self._undone):
            steps[:] = [replace(s, key=new) if s.key == key else s for s in steps]

    def loaded(
        self, in_file: Mapping[CameraKey, CameraSettings], own: frozenset[CameraKey] = frozenset()
    ) -> tuple[CameraKey, ...]:
        """Take the cameras of a new version.

        Args:
            in_file: their settings.
            own: cameras that the studio itself changed in the file: their placements stay.

        Returns:
            Cameras whose placement was dropped, since the file has new settings.
        """
        # A camera without a target in the file keeps its distance.
        far = {key: now.distance for key in in_file if (now := self.now(key)) is not None}
        in_file = {key: s if s.distance else replace(s, distance=far.get(key)) for key, s in in_file.items()}
        before, self.in_file = self.in_file, dict(in_file)
        dropped: list[CameraKey] = []
        for key, placed in list(self.placed.items()):
            if key not in in_file:
                del self.placed[key]
            elif not differences(placed, in_file[key]):
                del self.placed[key]
            elif key not in own and key in before and differences(before[key], in_file[key]):
                del self.placed[key]
                dropped.append(key)
                label = f"reloaded {key[1]} from the file"
                self._done.append(PlacementChange(key, placed, in_file[key], label))
        for steps in (self._done, self._undone):
            steps[:] = [step for step in steps if step.key in in_file]
        return tuple(dropped)

    def _put(self, key: CameraKey, settings: CameraSettings) -> None:
        file = self.in_file.get(key)
        if file is not None and not differences(file, settings):
            self.placed.pop(key, None)
        else:
            self.placed[key] = settings


_STEP_LABELS = (
    ({"position"}, "moved {}"),
    ({"orientation"}, "rotated {}"),
    ({"position", "orientation"}, "moved and rotated {}"),
    ({"fov", "intrinsic"}, "changed the lens of {}"),
    ({"near", "far"}, "changed near and far of {}"),
    ({"width", "height", "intrinsic"}, "changed the size of {}"),
    ({"shader_pack"}, "changed the shader of {}"),
)
"""Labels of steps that change no more than these settings; the first match counts."""


def _step_label(key: CameraKey, before: CameraSettings, after: CameraSettings) -> str:
    changed = set(differences(before, after))
    return next((label for most, label in _STEP_LABELS if changed <= most), "changed {}").format(key[1])


def usual_distance(pose: ArrayLike) -> float:
    """Default distance in metres from a camera's pose (7,) to its target: where its axis meets z = 0, if that is near."""
    p = np.asarray(pose, np.float64)
    forward = axes_of(p[3:])[0]
    distance = -float(p[2] / forward[2]) if abs(forward[2]) >= 1e-6 else USUAL
    return distance if NEAREST_TARGET <= distance <= FARTHEST_TARGET else USUAL


@dataclass(frozen=True)
class KeptPlacements:
    """Placements with their steps of undo, and the selected camera, for a later session of the same task."""

    placements: Placements
    selected: CameraKey | None


class StudioCameras:
    """The cameras, placements and selection that all parts of the studio share. Used on the loop.

    Args:
        kept: of an earlier session of the task.
    """

    def __init__(self, kept: KeptPlacements | None = None) -> None:
        self.task: TaskDescription | None = None
        self.selected: CameraKey | None = None
        self.was_chosen = False
        """Whether a camera, or none, was chosen."""
        self.placements = Placements() if kept is None else kept.placements.copy()
        self._select_when_loaded = None if kept is None else kept.selected
        self.problem = ""
        """Message about the last failure."""
        self.drawn: tuple[StepResult | None, int] = (None, 0)
        """The step and the selected env that were shown last."""

    def kept(self) -> KeptPlacements:
        """Placements, steps of undo and the selected camera, for a later session of this task."""
        return KeptPlacements(self.placements.copy(), self.selected or self._select_when_loaded)

    def select_again(self) -> None:
        """Select again, after a load, the camera that was selected in the earlier session; none if the camera is gone."""
        before, self._select_when_loaded = self._select_when_loaded, None
        self.selected = self.selected or before
        if self.selected is not None and self.info(self.selected) is None:
            self.selected = None

    def info(self, key: CameraKey) -> CameraInfo | None:
        return None if self.task is None else self.task.camera(key)

    def selected_camera(self) -> StudioCamera | None:
        """The selected camera, if any, for a new request; clears `problem`."""
        info = None if self.selected is None else self.info(self.selected)
        self.problem = ""
        return None if info is None else self._studio_camera(info)

    def refusal(self, key: CameraKey) -> str | None:
        """Why a camera cannot be placed; None if it can."""
        info = self.info(key)
        if info is None:
            return f"there is no {key[0]} camera {key[1]}"
        if self.task is not None and self.task.backend == "gpu":
            return NOT_ON_THE_GPU
        if info.settings is None:
            return "its pose is invalid, or its lens differs between envs, so it cannot have one placement"
        return None

    def mount_pose(self, info: CameraInfo) -> NDArray[np.float32] | None:
        """(7,) pose of the camera's mount in the env's frame, at the moment shown last; None without one."""
        step, env = self.drawn
        if info.mount is None or self.task is None or step is None:
            return None
        names = self.task.geometry.body_names
        if info.mount not in names or step.poses.shape[1] != len(names) or env >= len(step.poses):
            return None  # the step is of another version
        return step.poses[env, names.index(info.mount)]

    def all_cameras(self) -> tuple[StudioCamera, ...]:
        """All cameras, at the moment shown last."""
        return () if self.task is None else tuple(self._studio_camera(info) for info in self.task.cameras)

    def _studio_camera(self, info: CameraInfo) -> StudioCamera:
        key, mount = info.key, self.mount_pose(info)
        now = self.placements.now(key)
        if now is not None and now.distance is None and (mount is None) == (info.mount is None):
            now = self.placements.set_distance(key, usual_distance(pose_in_env(now, mount)))
        return StudioCamera(
            key=key,
            info=info,
            now=now,
            moved=key in self.placements.placed,
            mount_pose=mount,
            refused=self.refusal(key) or "",
        )

    def to_export(self, key: CameraKey) -> calibration_files.CameraToExport:
        """A camera as placed, for export. Raises ValueError if there is none, with a message for the reader."""
        info, now = self.info(key), self.placements.now(key)
        if info is None or now is None:
            raise ValueError(f"there is no {key[0]} camera {key[1]} whose settings are known")
        return calibration_files.CameraToExport(key, now, info.mount, self.mount_pose(info))
