"""The LeRobot dataset format, version 3.0: names of its files, features, and statistics.

Written after lerobot 0.4.4 (``lerobot/datasets/utils.py``, ``compute_stats.py``, ``lerobot_dataset.py``), whose own
reader loads what is written here. A dataset is a folder: ``meta/info.json`` says what there is, ``meta/tasks.parquet``
the tasks in words, ``meta/episodes`` one row an episode (where its frames and its film begin and end, and its
statistics), ``data`` one row a frame, ``videos`` one mp4 a camera with the episodes one after another.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

VERSION = "v3.0"
INFO = "meta/info.json"
STATS = "meta/stats.json"
TASKS = "meta/tasks.parquet"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
OURS = "meta/workbench.json"
"""Not of the format: which recordings the episodes were made from."""

CHUNK_SIZE = 1000
"""Files in a folder."""
DATA_MB, VIDEO_MB = 100, 200
"""A file that has grown to this is followed by the next."""

IMAGES = "observation.images."
STATE, ENVIRONMENT, ACTION = "observation.state", "observation.environment_state", "action"
REWARD, DONE, SUCCESS = "next.reward", "next.done", "next.success"
OF_EVERY_FRAME = {
    name: {"dtype": "float32" if name == "timestamp" else "int64", "shape": [1], "names": None}
    for name in ("timestamp", "frame_index", "episode_index", "index", "task_index")
}
QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
MOST_SAMPLED = 100
"""Pictures of an episode that its statistics are made from."""

Stats = dict[str, NDArray[Any]]


def next_file(chunk: int, file: int) -> tuple[int, int]:
    """Chunk and file that follow these."""
    return (chunk + 1, 0) if file == CHUNK_SIZE - 1 else (chunk, file + 1)


def stats_of(values: NDArray) -> Stats:
    """Of one feature over an episode: `values` (T, D); (D,) each, and ``count`` (1,)."""
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
    """Of one camera over an episode: (3, 1, 1) each in 0..1, of sampled pictures and every few pixels of large ones."""
    thinned = []
    for picture in pictures:
        # lerobot's own measure: pictures from 300 pixels on are thinned to about 150.
        longer = max(picture.shape[:2])
        every = longer // 150 if longer >= 300 else 1
        thinned.append(picture[::every, ::every].reshape(-1, 3))
    stats = stats_of(np.concatenate(thinned))
    shaped = {name: (value / 255.0).reshape(3, 1, 1) for name, value in stats.items() if name != "count"}
    return {**shaped, "count": np.array([len(pictures)])}


def sampled(count: int) -> NDArray[np.int64]:
    """Which of `count` pictures statistics are made from."""
    return np.unique(np.linspace(0, count - 1, min(count, MOST_SAMPLED)).round().astype(np.int64))


def together(parts: list[Stats]) -> Stats:
    """The statistics of all episodes from those of each, as lerobot puts them together (quantiles are means of them)."""
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
    """What pandas needs to take the tasks' words for the index of the table, as lerobot's reader does."""

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
