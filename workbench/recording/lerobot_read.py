"""An episode of a LeRobot dataset (version 3) as an `Episode`, for review: its cameras, curves, observations.

A dataset holds no scene, so there is nothing to show in 3-D. What it holds of an episode is T decisions; the state
after the last of them was never written down and is NaN here, without a picture. Films are taken apart when a camera
is first looked at.
"""

from __future__ import annotations

import math
import subprocess
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, overload

import imageio_ffmpeg
import numpy as np
import pyarrow.dataset as ds
import pyarrow.parquet as pq

from workbench.core.pictures import CameraInfo
from workbench.recording import lerobot_format as form
from workbench.recording.encoded_pictures import EncodedPictures, encode_jpeg
from workbench.recording.episode import CameraTrack, Episode, EpisodeInfo
from workbench.recording.json_file import read_json
from workbench.recording.read_maniskill import UnreadableRecording

USUAL_FOVY = math.radians(60)
"""A dataset does not say how its cameras see; nothing is computed from this."""


@dataclass(frozen=True)
class LeRobotRow:
    """What a table says of an episode."""

    index: int
    task: str
    length: int
    total_reward: float | None
    success: bool | None
    """At some step; None where the dataset does not say."""
    seed: int | None


def is_lerobot(folder: Path) -> bool:
    return (Path(folder) / form.INFO).is_file()


def lerobot_rows(folder: Path) -> tuple[LeRobotRow, ...]:
    """The episodes of the dataset in this folder.

    Raises:
        UnreadableRecording: it is none of version 3, or broken; the message says what is wrong.
    """
    info = _info(folder)
    try:
        wanted = [key for key in (form.REWARD, form.SUCCESS) if key in info["features"]]
        table = ds.dataset(Path(folder) / "data", format="parquet").to_table(["episode_index", *wanted])
        of = table["episode_index"].to_numpy()
        values = {key: table[key].to_numpy().astype(np.float64) for key in wanted}
        ours = _ours(folder)
        rows = []
        for entry in _entries(folder):
            index = int(entry["episode_index"])
            mine = of == index
            reward, success = values.get(form.REWARD), values.get(form.SUCCESS)
            rows.append(
                LeRobotRow(
                    index,
                    ", ".join(entry["tasks"]),
                    int(entry["length"]),
                    None if reward is None else float(reward[mine].sum()),
                    None if success is None else bool(success[mine].any()),
                    ours[index].get("seed") if index < len(ours) else None,
                )
            )
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise _broken(folder, error) from error
    return tuple(rows)


def read_lerobot(folder: Path, index: int) -> Episode:
    """Episode `index` of the dataset in this folder.

    Raises:
        UnreadableRecording: it cannot be read; the message says what is wrong.
    """
    folder = Path(folder)
    info = _info(folder)
    try:
        entry = next((entry for entry in _entries(folder) if entry["episode_index"] == index), None)
        if entry is None:
            raise UnreadableRecording(f"The dataset {folder.name} has no episode {index}.")
        return _episode(folder, info, entry, index)
    except UnreadableRecording:
        raise
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise _broken(folder, error) from error


def _episode(folder: Path, info: dict[str, Any], entry: dict[str, Any], index: int) -> Episode:
    file = info["data_path"].format(
        chunk_index=entry["data/chunk_index"], file_index=entry["data/file_index"]
    )
    table = pq.read_table(_inside(folder, file), filters=[("episode_index", "=", index)])
    length, features = table.num_rows, info["features"]
    columns = {
        key: np.array(table[key].to_pylist(), dtype=feature["dtype"]).reshape(length, -1)
        for key, feature in features.items()
        if key in table.column_names and feature["dtype"] not in ("string", "image", "video")
    }
    action = columns.get(form.ACTION, np.zeros((length, 0))).astype(np.float32)
    names = features.get(form.ACTION, {}).get("names")
    done = columns.get(form.DONE, np.zeros((length, 1), np.bool_))[:, 0].astype(np.bool_)
    evaluate = {}
    if form.SUCCESS in columns:
        evaluate["success"] = np.concatenate([[False], columns[form.SUCCESS][:, 0].astype(np.bool_)])
    ours = _ours(folder)
    from_ours = ours[index] if index < len(ours) else {}
    return Episode(
        info=EpisodeInfo(
            task=", ".join(entry["tasks"]) or folder.name,
            env_index=0,
            seed=int(from_ours.get("seed", -1)),
            source_file=None,
            source_hash=str(from_ours.get("source_hash", "")),
            source={},
            control_dt=1.0 / float(info["fps"]),
            control_mode=None,
            backend="",
            id=f"{folder.name}-{index}",
            written_at="",
        ),
        geometry=None,
        segmentation={},
        poses=None,
        action=action,
        action_names=_names(names, action.shape[1]),
        reward=columns.get(form.REWARD, np.zeros((length, 1)))[:, 0].astype(np.float32),
        terminated=done,
        truncated=np.zeros(length, np.bool_),
        evaluate=evaluate,
        cameras=[
            _camera(folder, info, entry, key, length)
            for key, feature in features.items()
            if feature["dtype"] == "video"
        ],
        obs={
            key.removeprefix("observation."): np.concatenate([values, np.full((1, values.shape[1]), np.nan)])
            for key, values in columns.items()
            if key.startswith("observation.")
        },
    )


def _camera(folder: Path, info: dict[str, Any], entry: dict[str, Any], key: str, length: int) -> CameraTrack:
    height, width = info["features"][key]["shape"][:2]
    if info["features"][key]["names"][0] == "channels":  # (3, H, W), as some datasets say it
        height, width = info["features"][key]["shape"][1:]
    focal = height / 2 / math.tan(USUAL_FOVY / 2)
    where = {
        "chunk_index": entry[f"videos/{key}/chunk_index"],
        "file_index": entry[f"videos/{key}/file_index"],
    }
    film = _inside(folder, info["video_path"].format(video_key=key, **where))
    pose = np.tile(np.array([0, 0, 0, 1, 0, 0, 0], np.float32), (length, 1))
    return CameraTrack(
        CameraInfo(
            name=key.removeprefix(form.IMAGES),
            kind="sensor",
            width=width,
            height=height,
            fovy=USUAL_FOVY,
            near=0.01,
            far=100.0,
            intrinsic=np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], np.float32),
            mount=None,
            modalities=("rgb",),
        ),
        np.arange(length),
        pose,
        rgb=EncodedPictures(
            "rgb",
            FilmPictures(film, float(entry[f"videos/{key}/from_timestamp"]), length, float(info["fps"])),
        ),
    )


class FilmPictures(Sequence[bytes]):
    """The frames of a part of a film as JPEG; all of the part is taken out when one is first asked for."""

    def __init__(self, film: Path, begin: float, count: int, fps: float) -> None:
        self._film, self._begin, self._count, self._fps = film, begin, count, fps
        self._blobs: list[bytes] | None = None
        self._taking = threading.Lock()

    def __len__(self) -> int:
        return self._count

    @overload
    def __getitem__(self, index: int) -> bytes: ...

    @overload
    def __getitem__(self, index: slice) -> Sequence[bytes]: ...

    def __getitem__(self, index: int | slice) -> bytes | Sequence[bytes]:
        with self._taking:
            if self._blobs is None:
                self._blobs = self._take_out()
        return self._blobs[index]

    def _take_out(self) -> list[bytes]:
        # Half a frame early, so that rounding cannot skip the first one.
        begin = max(0.0, self._begin - 0.5 / self._fps)
        frames = imageio_ffmpeg.read_frames(
            str(self._film),
            input_params=["-ss", f"{begin:.6f}"],
            output_params=["-frames:v", str(self._count)],
        )
        try:
            width, height = next(frames)["size"]
            blobs = [
                encode_jpeg(np.frombuffer(frame, np.uint8).reshape(height, width, 3)) for frame in frames
            ]
        except (OSError, RuntimeError, StopIteration, subprocess.SubprocessError) as error:
            raise UnreadableRecording(f"The film {self._film.name} cannot be read: {error}") from error
        if len(blobs) < self._count:
            raise UnreadableRecording(
                f"The film {self._film.name} ends after {len(blobs)} of the {self._count} frames of this episode."
            )
        return blobs


def _info(folder: Path) -> dict[str, Any]:
    try:
        info = read_json(Path(folder) / form.INFO)
        version = str(info["codebase_version"])
        if not isinstance(info["features"], dict) or not float(info["fps"]) > 0:
            raise ValueError("it names no features or no rate")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise _broken(Path(folder), error) from error
    if not version.startswith("v3."):
        raise UnreadableRecording(
            f"{Path(folder).name} is a LeRobot dataset of version {version}; version 3 can be read. lerobot converts older "
            "ones: python -m lerobot.datasets.v30.convert_dataset_v21_to_v30."
        )
    return info


def _entries(folder: Path) -> list[dict[str, Any]]:
    table = ds.dataset(Path(folder) / "meta" / "episodes", format="parquet")
    wanted = [name for name in table.schema.names if not name.startswith("stats/")]
    return table.to_table(wanted).to_pylist()


def _ours(folder: Path) -> list[dict[str, Any]]:
    """Which recordings the episodes come from, where we wrote the dataset."""
    try:
        found = read_json(Path(folder) / form.OURS)["episodes"]
    except (OSError, ValueError, KeyError, TypeError):
        return []
    return found if isinstance(found, list) and all(isinstance(one, dict) for one in found) else []


def _inside(folder: Path, path: str) -> Path:
    """A file that the dataset names; one outside of its folder is none of it."""
    file = (folder / path).resolve()
    if not file.is_relative_to(folder.resolve()):
        raise ValueError(f"it names the file {path}, which lies outside of it")
    return file


def _names(names: Any, width: int) -> tuple[str, ...]:
    if isinstance(names, dict):  # {"motors": [...]}, in older datasets
        names = next(iter(names.values()), None)
    if isinstance(names, list) and len(names) == width:
        return tuple(map(str, names))
    return tuple(f"action[{index}]" for index in range(width))


def _broken(folder: Path, error: Exception) -> UnreadableRecording:
    return UnreadableRecording(f"{Path(folder).name} is no LeRobot dataset that can be read: {error}.")
