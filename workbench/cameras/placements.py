"""Placements of cameras, with undo and redo."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from workbench.envs.camera_data import CameraKey, CameraSettings, differences
from workbench.pictures.camera_conventions import axes_of

_MAX_UNDO_STEPS = 500
MIN_TARGET_METRES, MAX_TARGET_METRES, DEFAULT_TARGET_METRES = 0.1, 3.0, 1.0
"""Limits and default of the distance from the eye to the target, for a camera whose settings have no
target."""


@dataclass(frozen=True)
class PlacementChange:
    """One undoable change of one camera."""

    key: CameraKey
    before: CameraSettings
    after: CameraSettings
    label: str
    """Text such as ``moved base_camera``."""
    control: object = None
    """Id of the control that made the change."""
    at: float = 0.0
    """Time of the change, in seconds of a monotonic clock."""


@dataclass(frozen=True)
class Placements:
    """Placements of cameras, with undo and redo. Methods that change something return a new value.

    An undo step has a camera's full settings before and after the step, so it can be undone even if the file
    has changed since. A whole gesture, such as a drag through a hundred positions, is one step. When a new
    version is loaded, placements that are not in the file stay, except for cameras whose settings changed in
    the file: the author's change wins, and Undo restores the placement.
    """

    in_file: Mapping[CameraKey, CameraSettings] = field(default_factory=dict)
    """Settings of the loaded version."""
    placed: Mapping[CameraKey, CameraSettings] = field(default_factory=dict)
    """Settings of cameras that differ from the file."""
    done: tuple[PlacementChange, ...] = ()
    """Steps that can be undone, the newest last."""
    undone: tuple[PlacementChange, ...] = ()
    """Steps that can be redone; the step to redo next is the last."""

    def now(self, key: CameraKey) -> CameraSettings | None:
        """A camera's present settings; None if there is no such camera, or `CameraSettings` cannot describe
        its config."""
        return self.placed.get(key, self.in_file.get(key))

    @property
    def undo_label(self) -> str | None:
        return self.done[-1].label if self.done else None

    @property
    def redo_label(self) -> str | None:
        return self.undone[-1].label if self.undone else None

    def place(
        self,
        key: CameraKey,
        settings: CameraSettings,
        at: float,
        control: object = None,
        pause: float = math.inf,
        label: str = "",
    ) -> Placements:
        """Place a camera; nothing changes if there is no such camera.

        Args:
            at: time in seconds of a monotonic clock.
            control: id of the control; successive calls with the same id are one undo step (a drag).
            pause: seconds without a call after which a new step begins.
        """
        before = self.now(key)
        if before is None:
            return self
        last = self.done[-1] if self.done and self.done[-1].key == key else None
        if not differences(before, settings):
            # A change of only the target's distance is not a separate step.
            return self._with_distance(key, settings.distance)
        others = self.done
        if last is not None and control is not None and last.control == control and at - last.at <= pause:
            before, others = last.before, self.done[:-1]
        label = label or _step_label(key, before, settings)
        step = PlacementChange(key, before, settings, label, control, at)
        return replace(self, done=others)._with_step(step)._put(key, settings)

    def _with_distance(self, key: CameraKey, distance: float | None) -> Placements:
        """Change the distance of a camera's target, in metres."""
        held = "placed" if key in self.placed else "in_file"
        settings = replace(getattr(self, held)[key], distance=distance)
        done = self.done
        if done and done[-1].key == key:
            done = (*done[:-1], replace(done[-1], after=settings))
        return replace(self, done=done, **{held: {**getattr(self, held), key: settings}})

    def _with_step(self, step: PlacementChange) -> Placements:
        return replace(self, done=(*self.done[-_MAX_UNDO_STEPS + 1 :], step), undone=())

    def undo(self) -> Placements:
        """Undo the last step, if there is one."""
        if not self.done:
            return self
        step = self.done[-1]
        undone = (*self.undone, step)
        return replace(self, done=self.done[:-1], undone=undone)._put(step.key, step.before)

    def redo(self) -> Placements:
        """Redo the last undone step, if there is one."""
        if not self.undone:
            return self
        step = self.undone[-1]
        done = (*self.done, replace(step, control=None))
        return replace(self, done=done, undone=self.undone[:-1])._put(step.key, step.after)

    def refused(self, key: CameraKey) -> Placements:
        """Restore the previous placement, because the worker refused the newest."""
        if self.done and self.done[-1].key == key:
            return replace(self, done=self.done[:-1])._put(key, self.done[-1].before)
        return self.without(key)

    def edit_undone(
        self, key: CameraKey, written: CameraSettings, in_file: CameraSettings
    ) -> Placements | None:
        """Handle a revert of a written placement: use the file's settings, and let Undo restore the
        placement. Returns None if the camera was placed elsewhere after that placement was written.

        Args:
            written: the settings that were removed from the file.
            in_file: the file's present settings.
        """
        placed = self.placed.get(key)
        if placed is not None and differences(placed, written):
            return None
        after = self.without(key)
        if not differences(written, in_file):
            return after
        return after._with_step(PlacementChange(key, written, in_file, f"reverted the change of {key[1]}"))

    def rename(self, key: CameraKey, new: CameraKey) -> Placements:
        """Move a camera's placements and steps to another key."""
        after = self.without(key).with_placed(new, self.placed[key]) if key in self.placed else self
        in_file = {**self.in_file, new: self.in_file[key]} if key in self.in_file else self.in_file
        done, undone = (
            tuple(replace(step, key=new) if step.key == key else step for step in steps)
            for steps in (self.done, self.undone)
        )
        return Placements(in_file, after.placed, done, undone)

    def loaded(
        self, in_file: Mapping[CameraKey, CameraSettings], own: frozenset[CameraKey] = frozenset()
    ) -> tuple[Placements, tuple[CameraKey, ...]]:
        """Update the placements for the cameras of a newly loaded version.

        Args:
            in_file: settings of the version's cameras.
            own: cameras that the studio itself changed in the file; their placements stay.

        Returns:
            The placements, and the cameras whose placement was dropped because the file has new settings.
        """
        before, kept, done = self.in_file, {}, self.done
        dropped: list[CameraKey] = []
        for key, placed in self.placed.items():
            if key not in in_file or not differences(placed, in_file[key]):
                continue
            if key not in own and key in before and differences(before[key], in_file[key]):
                dropped.append(key)
                label = f"reloaded {key[1]} from the file"
                done = (*done, PlacementChange(key, placed, in_file[key], label))
            else:
                kept[key] = placed
        done, undone = (tuple(s for s in steps if s.key in in_file) for steps in (done, self.undone))
        return Placements(in_file, kept, done, undone), tuple(dropped)

    def without(self, key: CameraKey) -> Placements:
        """Drop the camera's placement, without an undo step."""
        return replace(self, placed={one: settings for one, settings in self.placed.items() if one != key})

    def with_placed(self, key: CameraKey, settings: CameraSettings) -> Placements:
        """Place the camera, without an undo step."""
        return replace(self, placed={**self.placed, key: settings})

    def _put(self, key: CameraKey, settings: CameraSettings) -> Placements:
        file = self.in_file.get(key)
        if file is not None and not differences(file, settings):
            return self.without(key)
        return self.with_placed(key, settings)


_STEP_LABELS = (
    ({"position"}, "moved {}"),
    ({"orientation"}, "rotated {}"),
    ({"position", "orientation"}, "moved and rotated {}"),
    ({"fov", "intrinsic"}, "changed the lens of {}"),
    ({"near", "far"}, "changed near and far of {}"),
    ({"width", "height", "intrinsic"}, "changed the size of {}"),
    ({"shader_pack"}, "changed the shader of {}"),
)
"""Labels of steps that change only these settings; the first match counts."""


def _step_label(key: CameraKey, before: CameraSettings, after: CameraSettings) -> str:
    changed = set(differences(before, after))
    return next((label for most, label in _STEP_LABELS if changed <= most), "changed {}").format(key[1])


def usual_distance(pose: ArrayLike) -> float:
    """Default distance in metres from a camera's pose (7,) to its target: the distance to the point where its
    optical axis meets the plane z = 0 if that distance is within the limits, else `DEFAULT_TARGET_METRES`."""
    p = np.asarray(pose, np.float64)
    forward = axes_of(p[3:])[0]
    distance = -float(p[2] / forward[2]) if abs(forward[2]) >= 1e-6 else DEFAULT_TARGET_METRES
    return distance if MIN_TARGET_METRES <= distance <= MAX_TARGET_METRES else DEFAULT_TARGET_METRES
