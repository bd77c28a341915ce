"""Writes recorded pictures as observations in the format of ManiSkill's ``RecordEpisode``: ``sensor_data``, ``sensor_param``."""

from __future__ import annotations

from collections.abc import Iterator

import h5py
import numpy as np
from numpy.typing import NDArray
from transforms3d.quaternions import quat2mat

from workbench.episodes.encoded_pictures import MILLIMETRES_PER_METRE, MODALITIES, Modality
from workbench.episodes.episode import CameraTrack, Episode

_NO_PICTURES = {"state", "state_dict", "none"}
"""Parts of an observation mode that are not pictures."""
_FROM_OPENGL = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])
"""Axes of ManiSkill's camera frame (x forward, y left, z up) in OpenGL's (x right, y up, z backward)."""
_FROM_OPENCV = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""Axes of ManiSkill's camera frame (x forward, y left, z up) in OpenCV's (x right, y down, z forward)."""
_ZLIB_LEVEL = 1
"""Compression level of zlib."""


def observed_pictures(episode: Episode) -> dict[str, tuple[Modality, ...]]:
    """Modalities of each sensor that were part of the observations and have a picture for every state."""
    _, wanted = _wanted(episode)
    found: dict[str, tuple[Modality, ...]] = {}
    for track in _sensors(episode):
        modalities: tuple[Modality, ...] = tuple(m for m in wanted if track.pictures.get(m) is not None)
        if modalities and _is_whole(track, episode):
            found[track.info.name] = modalities
    return found


def missing_pictures(episode: Episode) -> str:
    """Parts of the observations that the recording lacks, as the end of a sentence; empty if there are none."""
    others, wanted = _wanted(episode)
    missing = list(others)
    if wanted:
        sensors = list(_sensors(episode))
        missing += [] if sensors else ["pictures"]
        for track in sensors:
            lacks = [m for m in wanted if m not in track.pictures]
            if not _is_whole(track, episode):
                missing.append(
                    f"{track.info.name} ({len(track.frame)} pictures of {episode.length + 1} states)"
                )
            elif lacks:
                missing.append(f"{' and '.join(lacks)} of {track.info.name}")
    return ", ".join(missing)


def put_pictures(episode: Episode, trajectory: h5py.Group) -> None:
    """Write `observed_pictures` into ``obs`` of the group of an episode, picture by picture.

    Names, types and shapes are those of ``mani_skill.utils.wrappers.record.RecordEpisode`` (3.0.1): for each sensor ``rgb``
    (T + 1, H, W, 3) uint8, ``depth`` (T + 1, H, W, 1) int16 millimetres, ``segmentation`` (T + 1, H, W, 1) int16, and
    ``extrinsic_cv`` (T + 1, 3, 4), ``cam2world_gl`` (T + 1, 4, 4), ``intrinsic_cv`` (T + 1, 3, 3) float32.

    Raises:
        OSError: a picture cannot be read, or the file cannot be written.
    """
    observed = observed_pictures(episode)
    tracks = {track.info.name: track for track in _sensors(episode) if track.info.name in observed}
    if not tracks:
        return
    obs = trajectory.require_group("obs")
    params = obs.create_group("sensor_param", track_order=True)
    for name, track in tracks.items():
        group = params.create_group(name, track_order=True)
        for key, values in _parameters(track).items():
            group[key] = values
    data = obs.create_group("sensor_data", track_order=True)
    for name, track in tracks.items():
        group = data.create_group(name, track_order=True)
        for modality in observed[name]:
            _put(track, modality, group)


def _wanted(episode: Episode) -> tuple[list[str], tuple[Modality, ...]]:
    """(names of the observed kinds of pictures that no recording keeps, modalities of the other observed
    kinds). If the observation mode is unknown: (no names, all recorded modalities)."""
    mode = episode.info.env_kwargs.get("obs_mode")
    if not isinstance(mode, str):
        held = {modality for track in _sensors(episode) for modality in track.pictures}
        return [], tuple(modality for modality in MODALITIES if modality in held)
    parts = {"rgb", "depth"} if mode == "rgbd" else set(mode.split("+")) - _NO_PICTURES
    return sorted(parts.difference(MODALITIES)), tuple(m for m in MODALITIES if m in parts)


def _sensors(episode: Episode) -> Iterator[CameraTrack]:
    return (track for track in episode.cameras if track.info.kind == "sensor")


def _is_whole(track: CameraTrack, episode: Episode) -> bool:
    return np.array_equal(track.frame, np.arange(episode.length + 1))


def _put(track: CameraTrack, modality: Modality, group: h5py.Group) -> None:
    pictures, size = track.pictures[modality], (track.info.height, track.info.width)
    shape, dtype = ((*size, 3), np.uint8) if modality == "rgb" else ((*size, 1), np.int16)
    written = group.create_dataset(
        modality,
        (len(pictures), *shape),
        dtype,
        chunks=(1, *shape),
        compression="gzip",
        compression_opts=_ZLIB_LEVEL,
        shuffle=dtype == np.int16,
    )
    for number in range(len(pictures)):
        picture = pictures[number]
        if picture.shape[:2] != size:
            found = f"{picture.shape[1]} x {picture.shape[0]}"
            raise OSError(f"picture {number} of {track.info.name} is {found}, not {size[1]} x {size[0]}")
        if modality == "depth":
            picture = np.rint(picture * MILLIMETRES_PER_METRE)
        if modality != "rgb":
            limits = np.iinfo(np.int16)
            picture = picture.clip(limits.min, limits.max)[..., None]
        written[number] = picture.astype(dtype)


def _parameters(track: CameraTrack) -> dict[str, NDArray[np.float32]]:
    """Camera matrices of each state; repeated poses are computed once."""
    count = len(track.pose)
    world, extrinsic = np.zeros((count, 4, 4)), np.zeros((count, 3, 4))
    world[:, 3, 3] = 1
    for state, pose in enumerate(track.pose.astype(np.float64)):
        if state and np.array_equal(track.pose[state], track.pose[state - 1]):
            world[state], extrinsic[state] = world[state - 1], extrinsic[state - 1]
            continue
        rotation, position = quat2mat(pose[3:]), pose[:3]
        world[state, :3, :3], world[state, :3, 3] = rotation @ _FROM_OPENGL.T, position
        into_camera = _FROM_OPENCV @ rotation.T
        extrinsic[state] = np.column_stack([into_camera, -into_camera @ position])
    intrinsic = np.tile(track.info.intrinsic, (count, 1, 1))
    found = {"extrinsic_cv": extrinsic, "cam2world_gl": world, "intrinsic_cv": intrinsic}
    return {name: values.astype(np.float32) for name, values in found.items()}
