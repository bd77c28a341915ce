"""The LeRobot dataset format 3.0: file names, features, statistics, and an episode as frames."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from workbench.episodes.episode import Episode, file_part
from workbench.episodes.films import cameras_by_name, picture_index

# As in lerobot 0.4.4 (``lerobot/datasets/utils.py``, ``compute_stats.py``, ``lerobot_dataset.py``), whose reader loads
# these datasets. ``meta/info.json`` describes the features, ``meta/tasks.parquet`` has the tasks' instructions,
# ``meta/episodes`` a row per episode (offsets of its frames and films, and its statistics), ``data`` a row per frame,
# ``videos`` mp4 files, each with one camera's pictures of several episodes.
VERSION = "v3.0"
INFO = "meta/info.json"
STATS = "meta/stats.json"
TASKS = "meta/tasks.parquet"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
WORKBENCH_FILE = "meta/workbench.json"
"""A file that is not part of the format: it names the recordings that the episodes were made from."""

CHUNK_SIZE = 1000
"""Maximum number of files per folder."""
DATA_MB, VIDEO_MB = 100, 200
"""Size from which a new file is started."""

IMAGES = "observation.images."
STATE, ENVIRONMENT, ACTION = "observation.state", "observation.environment_state", "action"
REWARD, DONE, SUCCESS = "next.reward", "next.done", "next.success"
OF_EVERY_FRAME = {
    name: {"dtype": "float32" if name == "timestamp" else "int64", "shape": [1], "names": None}
    for name in ("timestamp", "frame_index", "episode_index", "index", "task_index")
}
QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
MAX_SAMPLED_PICTURES = 100
"""Maximum number of pictures of an episode that its statistics use."""

Stats = dict[str, NDArray[Any]]


def next_file(chunk: int, file: int) -> tuple[int, int]:
    """Chunk and file numbers of the file that follows this one."""
    return (chunk + 1, 0) if file == CHUNK_SIZE - 1 else (chunk, file + 1)


def stats_of(values: NDArray) -> Stats:
    """Statistics of `values` (T, D), one feature of an episode: (D,) arrays, and ``count`` (1,)."""
    numbers = values.astype(np.float64)
    stats = {
        "min": numbers.min(axis=0),
        "max": numbers.max(axis=0),
        "mean": numbers.mean(axis=0),
        "std": numbers.std(axis=0),
        "count": np.array([len(numbers)]),
    }
    for name, value in zip(QUANTILES, np.quantile(numbers, list(QUANTILES.values()), axis=0)):
        stats[name] = value
    return stats


def picture_stats(pictures: list[NDArray[np.uint8]]) -> Stats:
    """Statistics of sampled pictures of one camera in an episode: (3, 1, 1) arrays in 0..1, and ``count`` (1,)."""
    thinned = []
    for picture in pictures:
        # As in lerobot: pictures of 300 pixels or more are subsampled to about 150.
        longer = max(picture.shape[:2])
        every = longer // 150 if longer >= 300 else 1
        thinned.append(picture[::every, ::every].reshape(-1, 3))
    stats = stats_of(np.concatenate(thinned))
    shaped = {name: (value / 255.0).reshape(3, 1, 1) for name, value in stats.items() if name != "count"}
    return {**shaped, "count": np.array([len(pictures)])}


def sampled(count: int) -> NDArray[np.int64]:
    """Indices of the pictures, out of `count`, that the statistics use."""
    return np.unique(np.linspace(0, count - 1, min(count, MAX_SAMPLED_PICTURES)).round().astype(np.int64))


def combined_stats(parts: list[Stats]) -> Stats:
    """Statistics of all episodes, combined from the statistics of each episode as lerobot does (quantiles are
    averaged)."""
    counts = np.array([float(part["count"][0]) for part in parts])
    weights = (counts / counts.sum()).reshape(-1, *[1] * parts[0]["mean"].ndim)
    means = np.stack([part["mean"] for part in parts])
    mean = (means * weights).sum(axis=0)
    spread = np.stack([part["std"] ** 2 for part in parts]) + (means - mean) ** 2
    return {
        "min": np.min([part["min"] for part in parts], axis=0),
        "max": np.max([part["max"] for part in parts], axis=0),
        "mean": mean,
        "std": np.sqrt((spread * weights).sum(axis=0)),
        "count": np.array([int(counts.sum())]),
        **{name: (np.stack([part[name] for part in parts]) * weights).sum(axis=0) for name in QUANTILES},
    }


def tasks_metadata() -> dict[bytes, bytes]:
    """Metadata that makes pandas use the instructions as the table's index, as lerobot's reader expects."""

    def column(name: str | None, field: str, pandas_type: str, numpy_type: str) -> dict[str, Any]:
        types = {"pandas_type": pandas_type, "numpy_type": numpy_type}
        return {"name": name, "field_name": field, **types, "metadata": None}

    index = "__index_level_0__"
    described = {
        "index_columns": [index],
        "column_indexes": [],
        "columns": [
            column("task_index", "task_index", "int64", "int64"),
            column(None, index, "unicode", "object"),
        ],
        "creator": {"library": "pyarrow", "version": "18.0.0"},
        "pandas_version": "2.2.0",
    }
    return {b"pandas": json.dumps(described).encode()}


# --- an episode as frames ----------------------------------------------------------------------------


@dataclass(frozen=True)
class Choice:
    """The parts of an episode that go into the dataset."""

    state: tuple[str, ...] = ()
    """Keys of the state observations for ``observation.state``; ``agent`` includes all keys below it. If no
    key is given: ``agent`` (the robot's own state), or all observations if there is no such key."""
    environment: tuple[str, ...] = ()
    """Keys for ``observation.environment_state``; empty leaves it out."""
    cameras: tuple[str, ...] | None = None
    """Names of cameras; None takes all with colour pictures."""
    every: int = 1
    """Keep every n-th step, with its action and the sum of the rewards until the next kept step."""


@dataclass(frozen=True)
class Frames:
    """Frames of an episode.

    LeRobot has a row per decision: the observation of state t, action t, and the result under ``next.``. An
    episode of ours has T actions and T + 1 states. If every step is kept, it becomes T rows: row t has state
    t, action t and the reward of that step. The last state is left out.
    """

    columns: dict[str, NDArray]
    names: dict[str, list[str]]
    episode: Episode
    cameras: tuple[str, ...]
    states: NDArray[np.int64]
    """(number of frames,) state index of each frame."""

    def pictures(self, camera: str) -> Iterator[NDArray[np.uint8]]:
        """One picture (H, W, 3) per frame."""
        track = cameras_by_name(self.episode)[camera]
        assert track.rgb is not None
        for state in self.states.tolist():
            yield track.rgb[picture_index(track, state)]

    def features(self) -> dict[str, dict]:
        """The features for ``meta/info.json``, without those that every dataset has (`OF_EVERY_FRAME`)."""
        features: dict[str, dict] = {}
        for camera in self.cameras:
            info = cameras_by_name(self.episode)[camera].info
            features[IMAGES + feature_name(camera)] = {
                "dtype": "video",
                "shape": [info.height, info.width, 3],
                "names": ["height", "width", "channels"],
            }
        for key, values in self.columns.items():
            features[key] = {
                "dtype": str(values.dtype),
                "shape": [values.shape[1]],
                "names": self.names.get(key),
            }
        return features


def feature_name(name: str) -> str:
    """A camera's name as part of a feature's name, which is also a folder's name."""
    return file_part(name)


def frames_of(episode: Episode, choice: Choice = Choice()) -> Frames:
    """The episode as frames.

    Raises:
        ValueError: it has no step, or lacks a chosen part; the message lists what it has.
    """
    if not episode.length:
        raise ValueError("has no step")
    states = np.arange(0, episode.length, choice.every)
    # A frame gets the sum of the rewards of its step and of the skipped steps after it. It is `done` if the
    # episode ended in one of these steps.
    rewards = np.add.reduceat(episode.reward.astype(np.float64), states).astype(np.float32)
    done = np.logical_or.reduceat(episode.terminated | episode.truncated, states)
    columns: dict[str, NDArray] = {}
    names: dict[str, list[str]] = {}
    sources = _numbers(episode)
    keys = {STATE: choice.state or _default_state(sources), ENVIRONMENT: choice.environment}
    for feature, prefixes in keys.items():
        chosen = [key for name in prefixes for key in _below(sources, name)]
        if chosen:
            columns[feature] = np.concatenate([sources[key][states] for key in chosen], axis=1)
            names[feature] = [part for key in chosen for part in _parts(key, sources[key].shape[1])]
    columns[ACTION] = episode.action[states].astype(np.float32)
    names[ACTION] = [str(name).replace("/", ".") for name in episode.action_names]
    columns[REWARD] = rewards[:, None]
    columns[DONE] = done[:, None]
    if (succeeded := episode.flag("success")) is not None:
        columns[SUCCESS] = np.logical_or.reduceat(succeeded[1:], states)[:, None]
    there = tuple(cameras_by_name(episode))
    cameras = there if choice.cameras is None else choice.cameras
    for camera in cameras:
        if camera not in there:
            raise ValueError(f"has no camera {camera!r} with pictures; it has {', '.join(there) or 'none'}")
    return Frames(columns, names, episode, cameras, states)


def _numbers(episode: Episode) -> dict[str, NDArray[np.float32]]:
    """State observations (T + 1, D) by key; if there are none, joint positions from the env states."""
    found = {
        key: values
        for key, values in episode.obs.items()
        if np.issubdtype(values.dtype, np.number) or values.dtype == bool
    }
    if not found:
        for name, values in episode.env_states.items():
            if name.startswith("articulations/"):
                # Pose of the root (7), its velocities (6), then positions and velocities of the joints.
                joints = (values.shape[1] - 13) // 2
                found[f"agent/{name.split('/', 1)[1]}/qpos"] = values[:, 13 : 13 + joints]
    return {
        key or "state": values.reshape(len(values), -1).astype(np.float32) for key, values in found.items()
    }


def _default_state(sources: dict[str, NDArray[np.float32]]) -> tuple[str, ...]:
    return ("agent",) if any(key.split("/")[0] == "agent" for key in sources) else tuple(sources)


def _below(sources: dict[str, NDArray[np.float32]], name: str) -> Sequence[str]:
    chosen = [key for key in sources if key == name or key.startswith(name.rstrip("/") + "/")]
    if not chosen:
        raise ValueError(f"has no observation {name!r}; it has {', '.join(sources) or 'none'}")
    return chosen


def _parts(key: str, width: int) -> list[str]:
    name = key.replace("/", ".")
    return [name] if width == 1 else [f"{name}.{index}" for index in range(width)]
