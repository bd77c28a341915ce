"""A camera as it is placed, in the words of other programs, and a pose in theirs as a placement."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from numpy.typing import ArrayLike

from workbench.authoring import camera_files
from workbench.core.camera_frames import Convention, Direction, Floats, relative_to
from workbench.core.pictures import CameraInfo


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
