"""Reads recordings of ManiSkill's ``RecordEpisode``, such as its demonstrations, as episodes."""

from __future__ import annotations

import datetime
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from transforms3d.quaternions import mat2quat

from workbench.envs.camera_data import CameraInfo
from workbench.envs.keywords import one_mode
from workbench.episodes.document import Document, EpisodeJson, WrongDocument, read_document
from workbench.episodes.encoded_pictures import (
    MAX_PIXELS,
    MILLIMETRES_PER_METRE,
    MODALITIES,
    EncodedPictures,
    LazyPictures,
    Modality,
    encode,
)
from workbench.episodes.episode import NO_SEED, CameraTrack, Episode, EpisodeInfo
from workbench.episodes.maniskill.safe_h5 import H5Dataset, H5Group, RefusedH5, open_h5
from workbench.episodes.row import UnreadableRecording

_PICTURES = ("sensor_data", "sensor_param")
_DEFAULT_DT_SECONDS = 0.05
"""ManiSkill's default control period (20 Hz), if the file has none."""


def read_maniskill(path: Path, trajectory: str) -> Episode:
    """Episode `trajectory` (``traj_0``) of an .h5 with its .json, both written by ManiSkill's RecordEpisode.

    Such files have no geometry and no poses, and no entries of ``evaluate()`` but ``success`` and ``fail``, which are
    False for state 0. The control period is the env's `control_freq` if recorded, else ManiSkill's default of 1/20 s.

    Raises:
        UnreadableRecording: one of the two files is missing or broken, or has no such episode.
    """
    path = Path(path)
    document, entry = _read_entry(path.with_suffix(".json"), trajectory)
    try:
        with open_h5(path) as file:
            group = file.group(trajectory)
            if group is None:
                raise UnreadableRecording(f"{path.name} has no {trajectory}.")
            return _episode(group, document, entry, path, trajectory)
    except UnreadableRecording:
        raise
    except RefusedH5 as error:
        raise UnreadableRecording(f"{path.name} {error}.") from error
    except (OSError, RuntimeError, KeyError, TypeError, ValueError) as error:
        raise UnreadableRecording(
            f"{trajectory} of {path.name} cannot be read ({type(error).__name__}: {error})"
        ) from error


def leaves(
    node: H5Group | H5Dataset | None, prefix: str = "", skip: Sequence[str] = ()
) -> Iterator[tuple[str, NDArray]]:
    """Every dataset of numbers below `node` with its path ``a/b``; the path is ``""`` if `node` itself is a dataset."""
    if isinstance(node, H5Dataset):
        if node.is_numbers:
            yield prefix, node.read()
    elif node is not None:
        for name in node:
            if name not in skip:
                yield from leaves(node[name], f"{prefix}/{name}" if prefix else name)


def _read_entry(path: Path, trajectory: str) -> tuple[Document, EpisodeJson]:
    try:
        document = read_document(path)
        for number, entry in enumerate(document.data["episodes"]):
            if f"traj_{entry['episode_id']}" == trajectory:
                return document, document.episode(number)
    except OSError as error:
        raise UnreadableRecording(f"{path.name} cannot be read: {error.strerror}") from error
    except WrongDocument as error:
        raise UnreadableRecording(f"{path.name} {error}.") from error
    except (KeyError, TypeError) as error:
        raise UnreadableRecording(f"{path.name} is not a .json of ManiSkill's RecordEpisode.") from error
    raise UnreadableRecording(f"{path.name} has no entry for {trajectory}.")


def _episode(group: H5Group, document: Document, entry: EpisodeJson, path: Path, trajectory: str) -> Episode:
    env = document.env()
    kwargs = env.env_kwargs or {}
    actions, action_names = _actions(group["actions"])
    length = len(actions)
    flags = {
        name: np.concatenate([[False], group.numbers(name)]) for name in ("success", "fail") if name in group
    }
    rewards = group.numbers("rewards") if "rewards" in group else np.full(length, np.nan)
    frequency = (kwargs.get("sim_config") or {}).get("control_freq") or 0
    info = EpisodeInfo(
        task=env.env_id or "unknown task",
        env_index=0,
        seed=NO_SEED if entry.seed is None else entry.seed,
        source_file=None,
        source_hash="",
        source={},
        control_dt=1 / frequency if frequency else _DEFAULT_DT_SECONDS,
        control_mode=one_mode(entry.control_mode),
        backend=str(kwargs.get("sim_backend") or "physx_cpu"),
        env_kwargs=kwargs,
        reset_options=(entry.reset_kwargs and entry.reset_kwargs.options) or {},
        max_episode_steps=env.max_episode_steps,
        written_at=_written(path),
        id=f"{path.stem}/{trajectory}",
        acted_by=((0, document.source_type),) if document.source_type else (),
    )
    obs = group.get("obs")
    return Episode(
        info=info,
        geometry=None,
        segmentation={},
        poses=None,
        action=actions,
        action_names=action_names,
        reward=np.asarray(rewards, dtype=np.float32),
        terminated=group.numbers("terminated").astype(np.bool_),
        truncated=group.numbers("truncated").astype(np.bool_),
        evaluate=flags,
        cameras=_cameras(obs, path),
        env_states=dict(leaves(group.get("env_states"))),
        obs=dict(leaves(obs, skip=_PICTURES)),
    )


def _written(path: Path) -> str:
    when = datetime.datetime.fromtimestamp(path.stat().st_mtime, datetime.timezone.utc)
    return when.isoformat(timespec="seconds")


def _actions(node: H5Group | H5Dataset) -> tuple[NDArray[np.float32], tuple[str, ...]]:
    """(T, A) actions of all robots, concatenated, and the names of the A dimensions."""
    parts = [(name, array.reshape(len(array), -1)) for name, array in leaves(node)]
    names = [f"{name or 'action'}[{i}]" for name, array in parts for i in range(array.shape[1])]
    return np.concatenate([array for _, array in parts], axis=1).astype(np.float32), tuple(names)


# --- cameras --------------------------------------------------------------------------------------


def _picture(path: Path, place: str, modality: Modality, number: int) -> NDArray:
    """Picture `number` of a dataset (P, H, W, C), in the format of `EncodedPictures`."""
    with open_h5(path) as file:
        dataset = file[place]
        if not isinstance(dataset, H5Dataset):
            raise OSError(f"{path.name} has changed since it was opened")
        picture = dataset.row(number)
    if modality == "rgb":
        return np.ascontiguousarray(picture[..., :3])
    plain = picture.reshape(picture.shape[:2])
    if modality == "depth":
        # Integers are millimetres; floats, from ray-tracing shaders, are metres.
        scale = MILLIMETRES_PER_METRE if plain.dtype.kind in "iu" else 1.0
        return plain.astype(np.float32) / np.float32(scale)
    return plain.astype(np.int32)


def _encoded(path: Path, place: str, modality: Modality, number: int) -> bytes:
    return encode(modality, _picture(path, place, modality, number))


def _cameras(obs: H5Group | H5Dataset | None, path: Path) -> list[CameraTrack]:
    sensors = obs.group("sensor_data") if isinstance(obs, H5Group) else None
    if sensors is None or not isinstance(obs, H5Group):
        return []
    tracks = []
    for name in sensors:
        held: dict[Modality, EncodedPictures] = {}
        size = (0, 0)
        count = 0
        camera = sensors.group(name)
        for key in camera or ():
            modality: Modality | None = next((known for known in MODALITIES if known == key), None)
            dataset = None if camera is None or modality is None else camera[key]
            if modality is None or not isinstance(dataset, H5Dataset):
                continue
            if dataset.ndim != 4 or not dataset.is_numbers:
                raise RefusedH5(
                    f"has pictures of shape {dataset.shape} and type {dataset.dtype} (at {dataset.name})"
                )
            count, size = len(dataset), (dataset.shape[1], dataset.shape[2])
            if dataset.shape[1] * dataset.shape[2] > MAX_PIXELS:
                raise RefusedH5(
                    f"claims pictures of {dataset.shape[2]} x {dataset.shape[1]} pixels (at {dataset.name})"
                )
            where = path, dataset.name, modality
            blobs = LazyPictures(count, partial(_encoded, *where))
            held[modality] = EncodedPictures(modality, blobs, partial(_picture, *where))
        if held:
            parameters = obs.group(f"sensor_param/{name}")
            info = _camera_info(name, size, tuple(held), parameters)
            pose = _poses(parameters, count)
            tracks.append(CameraTrack(info, np.arange(count), pose, **held))
    return tracks


def _camera_info(
    name: str, size: tuple[int, int], modalities: tuple[str, ...], parameters: H5Group | None
) -> CameraInfo:
    height, width = size
    intrinsic = np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]], dtype=np.float32)
    if parameters is not None and "intrinsic_cv" in parameters:
        intrinsic = parameters.numbers("intrinsic_cv")[0].astype(np.float32)
    fovy = float(2 * np.arctan2(height / 2, intrinsic[1, 1]))
    return CameraInfo(name, "sensor", width, height, fovy, 0.01, 100.0, intrinsic, None, modalities)


def _poses(parameters: H5Group | None, count: int) -> NDArray[np.float32]:
    """Poses (P, 7) in ManiSkill's camera frame, from OpenGL's (x right, y up, z backward)."""
    poses = np.tile(np.array([0, 0, 0, 1, 0, 0, 0], dtype=np.float32), (count, 1))
    if parameters is None or "cam2world_gl" not in parameters:
        return poses
    matrices = parameters.numbers("cam2world_gl")
    for index, matrix in enumerate(matrices):
        if index and np.array_equal(matrix, matrices[index - 1]):
            poses[index] = poses[index - 1]
            continue
        right, up, back = matrix[:3, 0], matrix[:3, 1], matrix[:3, 2]
        poses[index, :3] = matrix[:3, 3]
        poses[index, 3:] = mat2quat(np.stack([-back, -right, up], axis=1))
    return poses
