"""Read a dataset that ``workbench export`` wrote with the real ``lerobot``, and print a summary.

lerobot pins other versions of torch and of other packages than the workbench, so it needs its own environment:

    python -m venv lerobot-env && lerobot-env/bin/pip install lerobot==0.4.4
    lerobot-env/bin/python tests/sweeps/lerobot_loads.py DATASET

Every frame of every episode is read and its video decoded; the first and last frame of each are compared with the table.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq


def main(folder: Path, backend: str) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset  # type: ignore[import-not-found]

    dataset: Any = LeRobotDataset("local/export", root=folder, video_backend=backend)
    table = pq.read_table(folder / "data").to_pylist()
    assert len(dataset) == len(table) == dataset.meta.total_frames
    for index, row in enumerate(table):
        item = dataset[index]
        for key, value in row.items():
            assert np.allclose(np.asarray(item[key]), np.asarray(value)), (index, key)
        for key in dataset.meta.video_keys:
            height, width, _ = dataset.meta.features[key]["shape"]
            assert tuple(item[key].shape) == (3, height, width), item[key].shape
            # The videos' statistics must describe the decoded frames.
            mean = np.asarray(dataset.meta.stats[key]["mean"]).reshape(3)
            assert np.abs(np.asarray(item[key]).mean(axis=(1, 2)) - mean).max() < 0.2
    shifts = {"action": [0.0, 1 / dataset.fps], "observation.state": [-1 / dataset.fps, 0.0]}
    window = LeRobotDataset("local/export", root=folder, video_backend=backend, delta_timestamps=shifts)[1]
    assert window["action"].shape[0] == 2 and window["observation.state"].shape[0] == 2
    print(
        f"{dataset.meta.total_episodes} episodes, {len(dataset)} frames, fps {dataset.fps}, {dataset.meta.video_keys}"
    )
    print("tasks:", list(dataset.meta.tasks.index), " stats:", sorted(dataset.meta.stats))


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2] if len(sys.argv) > 2 else "pyav")
