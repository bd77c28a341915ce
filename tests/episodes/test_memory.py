"""A long episode with cameras takes no more memory than a short one: recorded, written and viewed."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.episodes.verify_rrd import verify_rrd

CHILD = """
import json, sys
from pathlib import Path
import numpy as np
from tests.drive.rows import EpisodeRow, append
from workbench.envs.scene.shapes import SceneGeometry
from workbench.envs.camera_data import CameraInfo, Picture
from workbench.episodes.episode import EpisodeInfo
from workbench.episodes.writing.episode_writer import EpisodeWriter

def peak():
    # Not getrusage: after a fork from a larger process its peak is that of the parent.
    (line,) = [line for line in open("/proc/self/status") if line.startswith("VmHWM")]
    return int(line.split()[1]) / 1024

folder, steps = Path(sys.argv[1]), int(sys.argv[2])
bodies, size = 15, 128
geometry = SceneGeometry(1, tuple(f"body{b}" for b in range(bodies)), ("dynamic",) * bodies, (False,) * bodies, ())
cameras = [
    CameraInfo(f"eye{c}", "sensor", size, size, 1.0, 0.01, 10.0, np.eye(3, dtype=np.float32), None, ("rgb",))
    for c in range(4)
]
chance = np.random.default_rng(0)
colours = chance.integers(0, 120, (32, size, size, 3), dtype=np.uint8)
colours[:, :, 48:] //= 64
pose = np.array([0, 0, 0, 1, 0, 0, 0], np.float32)

def row(k):
    pictures = tuple(
        Picture(camera.name, "sensor", 0, pose, rgb=np.roll(colours[(k + c) % 32], k % 50, 0))
        for c, camera in enumerate(cameras)
    )
    return EpisodeRow(
        chance.normal(size=(bodies, 7)).astype(np.float32),
        {"success": np.bool_(False), "distance": np.float32(k)},
        {f"actors/{b}": chance.normal(size=13).astype(np.float32) for b in range(bodies)},
        {"agent/qpos": chance.normal(size=9).astype(np.float32)},
        None if k == 0 else chance.normal(size=8).astype(np.float32),
        float(k),
        pictures=pictures,
    )

info = EpisodeInfo("Long-v1", 0, 0, None, "", {}, 0.05, None, "cpu")
writer = EpisodeWriter(folder, info, geometry, {}, [f"a{i}" for i in range(8)], cameras)
for k in range(steps + 1):
    append(writer, row(k))
appended = peak()
files = writer.finish()
sizes = [path.stat().st_size for path in (files.rrd, files.h5, files.json)]
print(json.dumps(dict(appended=appended, finished=peak(), files=sizes, rrd=str(files.rrd))))
"""


READER = """
import json, sys
from pathlib import Path
import rerun.chunk  # noqa: F401  (not measured)
from workbench.episodes.reader.read_episode import read_episode

def peak():
    (line,) = [line for line in open("/proc/self/status") if line.startswith("VmHWM")]
    return int(line.split()[1]) / 1024

before = peak()
episode = read_episode(Path(sys.argv[1]))
opened = peak()
for state in range(0, len(episode.reward), 61):
    for camera in episode.cameras:
        assert camera.rgb[state].shape == (128, 128, 3)
print(json.dumps(dict(opened=opened - before, looked=peak() - before)))
"""


def run(program: str, *arguments: object) -> dict[str, Any]:
    """Run the program in a process of its own; returns what it prints."""
    command = [sys.executable, "-c", program, *map(str, arguments)]
    return json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


@pytest.mark.slow
def test_ten_thousand_steps_at_four_cameras_do_not_grow_the_process(tmp_path: Path) -> None:
    short, long = run(CHILD, tmp_path / "short", 500), run(CHILD, tmp_path / "long", 10_000)
    assert sum(long["files"]) > 100e6, "too little was recorded for a meaningful test"
    assert long["appended"] - short["appended"] < 80, "MB; the recording has hundreds of MB"
    assert long["finished"] - short["finished"] < 80
    assert verify_rrd(Path(long["rrd"]), timeout=300) is None
    read = run(READER, long["rrd"])
    assert read["opened"] < 100, "most of it is pictures, and none was viewed yet"
    assert read["looked"] < 220, "only the last viewed pictures are cached"
