"""Reads episodes of LeRobot datasets (version 3) for review."""

from __future__ import annotations

import math
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.parquet as pq
from numpy.typing import NDArray

from workbench.envs.camera_data import CameraInfo
from workbench.episodes.document import read_json
from workbench.episodes.encoded_pictures import MAX_PIXELS, EncodedPictures, LazyPictures
from workbench.episodes.episode import NO_SEED, CameraTrack, Episode, EpisodeInfo
from workbench.episodes.films import FilmPart
from workbench.episodes.lerobot import format as form
from workbench.episodes.row import Facts, UnreadableRecording, clean_text, integer
from workbench.machine.files import open_regular_file
from workbench.pictures.camera_conventions import intrinsic_from_fov

DEFAULT_FOVY_RADIANS = math.radians(60)
"""Placeholder for the vertical field of view: datasets have no camera parameters."""
MAX_EPISODES = 100_000
MAX_FRAMES = 20_000_000
"""Maximum number of frames of a dataset."""
MAX_EPISODE_FRAMES = 1_000_000
"""Maximum number of frames of an episode."""
_PLACE = re.compile(r"\{(?P<name>chunk_index|file_index|video_key)(:0?(?P<width>\d)d)?\}")
_NUMBER = re.compile(r"bool|u?int(8|16|32|64)|float(16|32|64)")


def lerobot_rows(folder: Path) -> tuple[Facts, ...]:
    """The episodes of the dataset in this folder; `Facts.success` is success at any frame.

    Raises:
        UnreadableRecording: it has an unsupported version, or is broken.
    """
    info = _info(folder)
    try:
        totals, successes = _of_episodes(Path(folder), info)
        ours = _workbench_entries(folder)
        rows = []
        for entry in _entries(folder):
            index = int(entry["episode_index"])
            of = ours[index] if 0 <= index < len(ours) else {}
            facts = Facts(
                "lerobot",
                task=clean_text(_task(entry)),
                trajectory=str(index),
                copy_of=clean_text(of.get("id")),
                seed=integer(of.get("seed")),
                length=int(entry["length"]),
                total_reward=None if totals is None else totals.get(index, 0.0),
                success=None if successes is None else successes.get(index, 0.0) > 0,
            )
            rows.append(facts)
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise _broken(folder, error) from error
    return tuple(rows)


def _of_episodes(
    folder: Path, info: dict[str, Any]
) -> tuple[dict[int, float] | None, dict[int, float] | None]:
    """(sum of rewards by episode, number of frames with success by episode); None in place of a dict if the
    dataset has no rewards or no success."""
    features = [key for key in (form.REWARD, form.SUCCESS) if key in info["features"]]
    if not features:
        return None, None
    data = ds.dataset(_tables(folder / "data"), format="parquet")
    if (frames := data.count_rows()) > MAX_FRAMES:
        raise ValueError(f"it claims {frames:,} frames")
    table = data.to_table(["episode_index", *features])
    indices, episode = np.unique(table["episode_index"].to_numpy(), return_inverse=True)
    sums = [
        dict(zip(indices.tolist(), np.bincount(episode, _flat(table[key])).tolist()))
        if key in features
        else None
        for key in (form.REWARD, form.SUCCESS)
    ]
    return sums[0], sums[1]


def _flat(column: pa.ChunkedArray) -> NDArray[np.float64]:
    """One number per frame, also if the dataset stores each number as a list with one item."""
    array: Any = column.combine_chunks()
    while pa.types.is_fixed_size_list(array.type) or pa.types.is_list(array.type):
        array = array.flatten()
    return array.to_numpy(zero_copy_only=False).astype(np.float64)


def read_lerobot(folder: Path, index: int) -> Episode:
    """Episode `index` of the dataset in this folder, without a scene.

    A dataset lacks the state after the last action: the episode has NaN for it, and no picture. Films are
    decoded when a camera is first accessed. A dataset is untrusted: its paths must be in its folder, and
    claimed sizes are bounded.

    Raises:
        UnreadableRecording: it cannot be read; the message gives the reason.
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
    numbers = {"chunk_index": entry["data/chunk_index"], "file_index": entry["data/file_index"]}
    file = _path_in(folder, _format_path(info["data_path"], numbers))
    open_regular_file(file).close()
    table = pq.read_table(file, filters=[("episode_index", "=", index)])
    length, features = table.num_rows, info["features"]
    if length > MAX_EPISODE_FRAMES:
        raise ValueError(f"episode {index} claims {length:,} frames")
    columns = {
        key: np.array(table[key].to_pylist(), dtype=feature["dtype"]).reshape(length, -1)
        for key, feature in features.items()
        if key in table.column_names and np.dtype(_number_type(feature["dtype"])).kind in "biuf"
    }
    action = columns.get(form.ACTION, np.zeros((length, 0))).astype(np.float32)
    names = features.get(form.ACTION, {}).get("names")
    done = columns.get(form.DONE, np.zeros((length, 1), np.bool_))[:, 0].astype(np.bool_)
    evaluate = {}
    if form.SUCCESS in columns:
        evaluate["success"] = np.concatenate([[False], columns[form.SUCCESS][:, 0].astype(np.bool_)])
    ours = _workbench_entries(folder)
    from_ours = ours[index] if index < len(ours) else {}
    return Episode(
        info=EpisodeInfo(
            task=_task(entry) or folder.name,
            env_index=0,
            seed=int(from_ours.get("seed", NO_SEED)),
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
    if info["features"][key]["names"][0] == "channels":  # (3, H, W) in some datasets
        height, width = info["features"][key]["shape"][1:]
    if not 0 < width * height <= MAX_PIXELS:
        raise ValueError(f"{key} claims pictures of {width} x {height}")
    where = {
        "chunk_index": entry[f"videos/{key}/chunk_index"],
        "file_index": entry[f"videos/{key}/file_index"],
        "video_key": key,
    }
    film = _path_in(folder, _format_path(info["video_path"], where))
    part = FilmPart(film, float(entry[f"videos/{key}/from_timestamp"]), length, float(info["fps"]))
    pose = np.tile(np.array([0, 0, 0, 1, 0, 0, 0], np.float32), (length, 1))
    return CameraTrack(
        CameraInfo(
            name=key.removeprefix(form.IMAGES),
            kind="sensor",
            width=width,
            height=height,
            fovy=DEFAULT_FOVY_RADIANS,
            near=0.01,
            far=100.0,
            intrinsic=intrinsic_from_fov(DEFAULT_FOVY_RADIANS, width, height).astype(np.float32),
            mount=None,
            modalities=("rgb",),
        ),
        np.arange(length),
        pose,
        rgb=EncodedPictures("rgb", LazyPictures(length, part.one)),
    )


def _info(folder: Path) -> dict[str, Any]:
    try:
        info = read_json(Path(folder) / form.INFO)
        version = str(info["codebase_version"])
        if not isinstance(info["features"], dict) or not float(info["fps"]) > 0:
            raise ValueError("it has no features or no frame rate")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise _broken(Path(folder), error) from error
    if not version.startswith("v3."):
        raise UnreadableRecording(
            f"{Path(folder).name} is a LeRobot dataset of version {version}; only version 3 can be read. "
            "Convert an older one with lerobot: python -m lerobot.datasets.v30.convert_dataset_v21_to_v30."
        )
    return info


def _entries(folder: Path) -> list[dict[str, Any]]:
    data = ds.dataset(_tables(Path(folder) / "meta" / "episodes"), format="parquet")
    if (episodes := data.count_rows()) > MAX_EPISODES:
        raise ValueError(f"it claims {episodes:,} episodes, and {MAX_EPISODES:,} can be listed")
    return data.to_table([name for name in data.schema.names if not name.startswith("stats/")]).to_pylist()


def _task(entry: dict[str, Any]) -> str:
    return ", ".join(map(str, entry["tasks"] or ()))


def _tables(folder: Path) -> list[str]:
    """The parquet files below a folder; regular files only, since opening a pipe would block."""
    found = [
        os.path.join(below, name)
        for below, _, names in os.walk(folder)
        for name in sorted(names)
        if name.endswith(".parquet") and os.path.isfile(os.path.join(below, name))
    ]
    if not found:
        raise FileNotFoundError(f"it has no {folder.name}/*.parquet")
    return sorted(found)


def _number_type(name: object) -> str:
    """`name` if it is the name of a numpy type of numbers, else ``O``."""
    return name if isinstance(name, str) and _NUMBER.fullmatch(name) else "O"


def _format_path(pattern: str, values: dict[str, Any]) -> str:
    """``data/chunk-{chunk_index:03d}/...`` with these values. No other feature of ``str.format`` is supported."""

    def value(found: re.Match[str]) -> str:
        held = values[found["name"]]
        return f"{int(held):0{int(found['width'] or 0)}d}" if found["name"] != "video_key" else str(held)

    return _PLACE.sub(value, pattern)


def _workbench_entries(folder: Path) -> list[dict[str, Any]]:
    """Metadata of each episode's recording, by episode index; empty if the workbench did not write the
    dataset."""
    try:
        found = read_json(Path(folder) / form.WORKBENCH_FILE)["episodes"]
    except (OSError, ValueError, KeyError, TypeError):
        return []
    return found if isinstance(found, list) and all(isinstance(one, dict) for one in found) else []


def _path_in(folder: Path, path: str) -> Path:
    """Path of a file that the dataset names. Raises ValueError if it is outside the folder."""
    file = (folder / path).resolve()
    if not file.is_relative_to(folder.resolve()):
        raise ValueError(f"it names the file {path}, which is outside the dataset's folder")
    return file


def _names(names: Any, width: int) -> tuple[str, ...]:
    if isinstance(names, dict):  # {"motors": [...]}, in older datasets
        names = next(iter(names.values()), None)
    if isinstance(names, list) and len(names) == width:
        return tuple(map(str, names))
    return tuple(f"action[{index}]" for index in range(width))


def _broken(folder: Path, error: Exception) -> UnreadableRecording:
    return UnreadableRecording(f"{Path(folder).name} cannot be read as a LeRobot dataset: {error}.")
