"""The cameras of the version that runs, how each of them is placed, and which one the page works on.

It is what placing, judging and writing have in common: each asks here for a camera by its key, and whether it can be
placed at all. Not thread-safe: whoever asks holds `lock`.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from workbench.authoring import camera_files
from workbench.core.camera_frames import Convention, Direction, Floats, relative_to
from workbench.core.camera_settings import CameraKey
from workbench.core.pictures import CameraInfo
from workbench.core.step import StepResult
from workbench.session.messages import TaskDescription
from workbench.session.placements import Placements
from workbench.session.studio_view import StudioCamera

_ON_THE_GPU = "in GPU simulation cameras cannot be moved; open the task with --backend cpu to place them"


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

    def asked_for(self, key: CameraKey) -> StudioCamera | None:
        """The camera, if there is one; it is said if not. What went wrong before it was asked for is over."""
        info = self.info(key)
        self.problem = "" if info is not None else f"There is no {key[0]} camera {key[1]}."
        return None if info is None else self._as_shown(info)

    def refusal(self, key: CameraKey) -> str | None:
        """Why a camera cannot be placed; None where it can."""
        info = self.info(key)
        if info is None:
            return f"there is no {key[0]} camera {key[1]}"
        if self.task is not None and self.task.backend == "gpu":
            return _ON_THE_GPU
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
        key = info.key
        return StudioCamera(
            key=key,
            info=info,
            now=self.placements.now(key),
            moved=self.placements.moved(key),
            mount_pose=self.mount_pose(info),
            refused=self.refusal(key) or "",
        )

    def to_export(self, key: CameraKey) -> camera_files.CameraToExport:
        """Raises ValueError with a sentence where there is no such camera."""
        info, now = self.info(key), self.placements.now(key)
        if info is None or now is None:
            raise ValueError(f"there is no {key[0]} camera {key[1]} whose settings are known")
        return camera_files.CameraToExport(key, now, info.mount, self.mount_pose(info))


def exported(cameras: Sequence[camera_files.CameraToExport], form: Literal["json", "opencv", "ros"]) -> str:
    """The text of a file; ROS's form is one file a camera, so of several it is one document after the other."""
    if form == "json":
        return camera_files.cameras_as_json(cameras)
    if form == "opencv":
        return camera_files.cameras_as_opencv_yaml(cameras)
    return "---\n".join(camera_files.camera_as_ros_yaml(camera) for camera in cameras)


def imported(
    info: CameraInfo,
    mount: ArrayLike | None,
    text: str,
    direction: Direction | None,
    convention: Convention | None,
    metres_per_unit: float,
) -> Floats:
    """(7,) the pose that a calibration gives a camera: in the env's frame, or in its mount's if it is mounted.

    Args:
        mount: (7,) where its mount is; None for a camera that stands still, or where that is not known.

    Raises:
        ValueError: with a sentence for the reader.
    """
    found = camera_files.find_poses(text)
    chosen = [pose for pose in found if info.name in pose.label] or list(found)
    if len(chosen) > 1:
        labels = ", ".join(pose.label for pose in chosen)
        raise ValueError(f"there are several poses in it ({labels}): paste the one that is meant")
    pose = camera_files.camera_pose(chosen[0], convention, direction, metres_per_unit)
    if chosen[0].said is None or info.mount is None:
        return pose
    if mount is None:
        raise ValueError(f"where {info.mount} is, on which {info.name} rides, is not known yet")
    return relative_to(mount, pose)  # ours is of the env's frame
