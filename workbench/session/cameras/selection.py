"""The cameras of the version that runs, how each of them is placed, and which one the page works on.

It is what placing, judging and writing have in common: each asks here for a camera by its key, and whether it can be
placed at all. Not thread-safe: whoever asks holds `lock`.

What was placed by hand can be undone and made again. A step keeps the whole settings of one camera before and after, so
it can be taken back whatever happened to the file meanwhile. What belongs to one gesture, the hundred positions of a
drag, is one step. When a version comes in, what was placed and not written stays, except where the file says something
new of that very camera: the author wrote that, so it counts, and the placement is one step of undo away.
"""

from __future__ import annotations

import math
import threading
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
"""Metres in front of the eye at which the target of a camera is put that has none yet."""


@dataclass(frozen=True)
class Step:
    """One change of one camera."""

    key: CameraKey
    before: CameraSettings
    after: CameraSettings
    words: str
    hand: object = None
    """What made it."""
    at: float = 0.0
    """Seconds, of `time.monotonic`."""


class Placements:
    """See the module's text."""

    def __init__(self) -> None:
        self.said: dict[CameraKey, CameraSettings] = {}
        """What the loaded version says."""
        self.placed: dict[CameraKey, CameraSettings] = {}
        """How cameras stand that were placed otherwise; what is put or taken here is no step of undo."""
        self._done: list[Step] = []
        self._undone: list[Step] = []

    def now(self, key: CameraKey) -> CameraSettings | None:
        """None for a camera that there is not, or whose config cannot be said in settings."""
        return self.placed.get(key, self.said.get(key))

    @property
    def undo_words(self) -> str | None:
        return self._done[-1].words if self._done else None

    @property
    def redo_words(self) -> str | None:
        return self._undone[-1].words if self._undone else None

    def place(
        self,
        key: CameraKey,
        settings: CameraSettings,
        hand: object = None,
        pause: float = math.inf,
        words: str = "",
    ) -> bool:
        """False if there is no such camera, or it stands so already; `hand` and `pause` as in `CameraStudio.place`."""
        before, now = self.now(key), time.monotonic()
        if before is None:
            return False
        last = self._done[-1] if self._done and self._done[-1].key == key else None
        if not differences(before, settings):
            # How far it looks is no step of its own.
            aimed = self.aim(key, settings.distance)
            if last is not None:
                self._done[-1] = replace(last, after=aimed)
            return False
        if last is not None and hand is not None and last.hand == hand and now - last.at <= pause:
            before = last.before
            self._done.pop()
        words = words or _in_words(key, before, settings)
        self._note(Step(key, before, settings, words, hand, now))
        self._put(key, settings)
        return True

    def aim(self, key: CameraKey, distance: float | None) -> CameraSettings:
        """A camera as it is now, looking so far."""
        held = self.placed if key in self.placed else self.said
        held[key] = replace(held[key], distance=distance)
        return held[key]

    def _note(self, step: Step) -> None:
        self._done = [*self._done[-_MOST_STEPS + 1 :], step]
        self._undone.clear()

    def undo(self) -> Step | None:
        """The step that was taken back."""
        if not self._done:
            return None
        step = self._done.pop()
        self._undone.append(step)
        self._put(step.key, step.before)
        return step

    def redo(self) -> Step | None:
        if not self._undone:
            return None
        step = self._undone.pop()
        self._done.append(replace(step, hand=None))
        self._put(step.key, step.after)
        return step

    def refused(self, key: CameraKey) -> None:
        """It could not be placed so: it is as it was before that."""
        last = self._done[-1] if self._done else None
        if last is not None and last.key == key:
            self._done.pop()
            self._put(key, last.before)
        else:
            self.placed.pop(key, None)

    def taken_back(self, key: CameraKey, written: CameraSettings, said: CameraSettings) -> bool:
        """The file says again what it said before a placement was written to it: the camera stands as that says, and
        the placement is one step of undo away. False, and nothing is done, if it was placed elsewhere since.

        Args:
            written: what was taken out of the file.
            said: what it says now.
        """
        placed = self.placed.get(key)
        if placed is not None and differences(placed, written):
            return False
        self.placed.pop(key, None)
        if differences(written, said):
            self._note(Step(key, written, said, f"took back the change of {key[1]}"))
        return True

    def rename(self, key: CameraKey, new: CameraKey) -> None:
        """What is known of one camera is from now on of the other."""
        if key in self.placed:
            self.placed[new] = self.placed.pop(key)
        if key in self.said:
            self.said[new] = self.said[key]
        for steps in (self._done, self._undone):
            steps[:] = [replace(s, key=new) if s.key == key else s for s in steps]

    def loaded(
        self, said: Mapping[CameraKey, CameraSettings], own: frozenset[CameraKey] = frozenset()
    ) -> tuple[CameraKey, ...]:
        """A version runs, whose cameras are these.

        Args:
            own: cameras that the studio itself changed in the file: nothing of theirs is dropped.

        Returns:
            cameras whose placement was dropped, since the file says something new of them.
        """
        # Where the file names no target, a camera looks as far as it did.
        far = {key: now.distance for key in said if (now := self.now(key)) is not None}
        said = {key: s if s.distance else replace(s, distance=far.get(key)) for key, s in said.items()}
        before, self.said = self.said, dict(said)
        dropped: list[CameraKey] = []
        for key, placed in list(self.placed.items()):
            if key not in said:
                del self.placed[key]
            elif not differences(placed, said[key]):
                del self.placed[key]
            elif key not in own and key in before and differences(before[key], said[key]):
                del self.placed[key]
                dropped.append(key)
                words = f"took {key[1]} from the file"
                self._done.append(Step(key, placed, said[key], words))
        for steps in (self._done, self._undone):
            steps[:] = [step for step in steps if step.key in said]
        return tuple(dropped)

    def _put(self, key: CameraKey, settings: CameraSettings) -> None:
        file = self.said.get(key)
        if file is not None and not differences(file, settings):
            self.placed.pop(key, None)
        else:
            self.placed[key] = settings


_IN_WORDS = (
    ({"position"}, "moved {}"),
    ({"orientation"}, "turned {}"),
    ({"position", "orientation"}, "moved and turned {}"),
    ({"fov", "intrinsic"}, "changed the lens of {}"),
    ({"near", "far"}, "changed near and far of {}"),
    ({"width", "height", "intrinsic"}, "changed the size of {}"),
    ({"shader_pack"}, "changed the shader of {}"),
)
"""What a step is called of which no more is changed than this."""


def _in_words(key: CameraKey, before: CameraSettings, after: CameraSettings) -> str:
    changed = set(differences(before, after))
    return next((words for most, words in _IN_WORDS if changed <= most), "changed {}").format(key[1])


def usual_distance(pose: ArrayLike) -> float:
    """How far before a camera (7,) its target is put: where it looks at the height 0 of its env, if that is near."""
    p = np.asarray(pose, np.float64)
    forward = axes_of(p[3:])[0]
    distance = -float(p[2] / forward[2]) if abs(forward[2]) >= 1e-6 else USUAL
    return distance if NEAREST_TARGET <= distance <= FARTHEST_TARGET else USUAL


class StudioCameras:
    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.task: TaskDescription | None = None
        self.selected: CameraKey | None = None
        self.placements = Placements()
        self.problem = ""
        """What went wrong last, for the reader."""
        self.drawn: tuple[StepResult | None, int] = (None, 0)
        """What was shown last: the step and the selected env."""

    def info(self, key: CameraKey) -> CameraInfo | None:
        return None if self.task is None else self.task.camera(key)

    def asked_for(self) -> StudioCamera | None:
        """The selected camera, if there is one. What went wrong before something was asked of it is over."""
        info = None if self.selected is None else self.info(self.selected)
        self.problem = ""
        return None if info is None else self._as_shown(info)

    def refusal(self, key: CameraKey) -> str | None:
        """Why a camera cannot be placed; None where it can."""
        info = self.info(key)
        if info is None:
            return f"there is no {key[0]} camera {key[1]}"
        if self.task is not None and self.task.backend == "gpu":
            return NOT_ON_THE_GPU
        if info.settings is None:
            return "its pose is no pose, or its lens differs between envs, so one placement cannot be its"
        return None

    def mount_pose(self, info: CameraInfo) -> NDArray[np.float32] | None:
        """(7,) of the body that a camera rides on, in the env's frame, at the moment that was shown last."""
        step, env = self.drawn
        if info.mount is None or self.task is None or step is None:
            return None
        names = self.task.geometry.body_names
        if info.mount not in names or step.poses.shape[1] != len(names) or env >= len(step.poses):
            return None  # another version is coming in
        return step.poses[env, names.index(info.mount)]

    def all_as_shown(self) -> tuple[StudioCamera, ...]:
        """For the page, at the moment that was shown last."""
        return () if self.task is None else tuple(self._as_shown(info) for info in self.task.cameras)

    def _as_shown(self, info: CameraInfo) -> StudioCamera:
        key, mount = info.key, self.mount_pose(info)
        now = self.placements.now(key)
        if now is not None and now.distance is None and (mount is None) == (info.mount is None):
            now = self.placements.aim(key, usual_distance(pose_in_env(now, mount)))
        return StudioCamera(
            key=key,
            info=info,
            now=now,
            moved=key in self.placements.placed,
            mount_pose=mount,
            refused=self.refusal(key) or "",
        )

    def to_export(self, key: CameraKey) -> calibration_files.CameraToExport:
        """Raises ValueError with a sentence where there is no such camera."""
        info, now = self.info(key), self.placements.now(key)
        if info is None or now is None:
            raise ValueError(f"there is no {key[0]} camera {key[1]} whose settings are known")
        return calibration_files.CameraToExport(key, now, info.mount, self.mount_pose(info))
