"""Fuzzed recordings: each becomes a row or an error message, in bounded time and memory.

Real files of each kind are damaged in random ways from a seed: bytes changed, cut or doubled, numbers made huge.
``WORKBENCH_FUZZ_SEED`` sets another seed.
"""

from __future__ import annotations

import json
import os
import random
import re
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import h5py
import numpy as np
import psutil
import pytest

from tests.drive.episodes import Made, Track
from tests.episodes.foreign_h5 import write as write_h5
from workbench.envs.camera_data import CameraInfo
from workbench.envs.task_drawings import Drawing
from workbench.episodes.episode import Episode
from workbench.episodes.lerobot.export import export_lerobot
from workbench.episodes.reader import reading
from workbench.episodes.reader.read_episode import read_episode
from workbench.episodes.reader.scan import scan_folder
from workbench.episodes.row import Source, UnreadableRecording
from workbench.review.view import find_events

pytestmark = pytest.mark.usefixtures("child_process")

SEED = int(os.environ.get("WORKBENCH_FUZZ_SEED", "0"))
MAX_SECONDS = 60.0
"""Limit for one damaged recording: it detects hangs and is no performance goal."""
MAX_GROWTH_BYTES = 1 << 30
"""Limit for the growth of this process; data of a closed recording must be freed."""
HUGE = [b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"\x00\x00\x00\x80", b"\x00" * 8, b"\xff" * 8]


@pytest.fixture(scope="module")
def originals(
    make_episode: Callable[..., Made], tmp_path_factory: pytest.TempPathFactory
) -> dict[str, tuple[Path, list[str]]]:
    """By kind, an intact recording and the names of its files to damage."""
    states = np.arange(7)
    flat = np.tile(states[:, None, None], (1, 16, 16))
    modalities = ("rgb", "depth", "segmentation")
    camera = CameraInfo(
        "base", "sensor", 16, 16, 1.0, 0.01, 10.0, np.eye(3, dtype=np.float32), None, modalities
    )
    pose = np.tile(np.array([0, 0, 0, 1, 0, 0, 0], np.float32), (7, 1))
    rgb, depth, ids = (
        np.stack([flat] * 3, axis=3).astype(np.uint8),
        flat.astype(np.float32),
        flat.astype(np.int32),
    )
    episode = make_episode(
        6,
        evaluate={"success": states == 6},
        env_states={"actors/cube": np.zeros((7, 13), np.float32)},
        obs={"x": np.ones((7, 3))},
        cameras=[Track(camera, states, pose, rgb, depth, ids)],
    )
    episode.drawn = [
        {"dot": Drawing("points", poses[None, :, :3]), "axes": Drawing("frames", poses[None])}
        for poses in episode.poses
    ]
    ours, alone, theirs, dataset = (
        tmp_path_factory.mktemp(name) for name in ("ours", "alone", "theirs", "dataset")
    )
    path = episode.write(ours).json
    notes = {"tags": ["a"], "note": "b"}
    path.with_suffix(".notes").write_text(json.dumps({"workbench_notes": {"": notes}}))
    shutil.copy(path.with_suffix(".rrd"), alone / "sent.rrd")

    def with_pictures(group: h5py.Group) -> None:
        colours = np.zeros((4, 16, 16, 3), np.uint8)
        group.create_dataset("obs/sensor_data/base/rgb", data=colours, compression="gzip")
        group["obs/agent/qpos"] = np.zeros((4, 9), np.float32)
        group["success"] = np.zeros(3, bool)

    write_h5(theirs, with_pictures)
    (theirs / "theirs.notes").write_text(json.dumps({"workbench_notes": {"traj_0": notes}}))
    export_lerobot([("a", lambda: read_episode(path))], dataset / "set")
    folders = {"ours": ours, "alone": alone, "theirs": theirs, "dataset": dataset / "set"}
    return {
        kind: (
            folder,
            sorted(
                file.relative_to(folder).as_posix()
                for file in folder.rglob("*")
                if file.is_file() and file.name not in ("stats.json", "tasks.parquet")
            ),
        )
        for kind, folder in folders.items()
    }


def damaged(content: bytes, rng: random.Random, is_text: bool) -> bytes:
    way = rng.choice(["bytes", "cut", "huge", "doubled", "zeros", "number" if is_text else "huge"])
    if not content:
        return b"x"
    place = rng.randrange(len(content))
    if way == "bytes":
        changed = bytearray(content)
        for _ in range(rng.randint(1, 12)):
            changed[rng.randrange(len(changed))] = rng.randrange(256)
        return bytes(changed)
    if way == "cut":
        return content[:place]
    if way == "huge":
        value = rng.choice(HUGE)
        return content[:place] + value + content[place + len(value) :]
    if way == "doubled":
        return content[:place] + content[max(0, place - 200) : place] + content[place:]
    if way == "zeros":
        return content[:place] + bytes(min(64, len(content) - place)) + content[place + 64 :]
    numbers = list(re.finditer(rb"(?<=[ \[,:])-?\d+(\.\d+)?", content))
    if not numbers:
        return content[:place]
    found = rng.choice(numbers)
    value = rng.choice(
        [b"-1", b"1e308", b"99999999999999999999999", b"NaN", b'"x"', b"[]", b"{}", b"null", b"1000000000"]
    )
    return content[: found.start()] + value + content[found.end() :]


def look_at(folder: Path) -> list[str]:
    """Read all that is shown of a folder; returns the error messages and raises any other error."""
    messages = []
    for found, entries in reading.read_rows(folder, scan_folder(folder).found.values()):
        for facts, _ in entries:
            messages += [facts.problem] if facts.problem else []
            path = folder / found.key
            if facts.kind == "lerobot" and facts.trajectory is None:
                continue
            if facts.kind == "lerobot":
                source = Source(path.parents[1], facts.trajectory)
            elif facts.trajectory is not None:
                source = Source(path.with_suffix(".h5"), facts.trajectory)
            else:
                source = Source(
                    path.with_suffix(next(one for one in (".json", ".rrd", ".h5") if one in found.sizes))
                )
            try:
                messages += opened(reading.read_recording(source))
            except (UnreadableRecording, OSError) as error:
                assert str(error)
                messages.append(str(error))
    return messages


def opened(episode: Episode) -> Iterator[str]:
    yield from (broken.sentence for broken in episode.broken_files)
    find_events(episode)
    for camera in episode.cameras:
        for pictures in (camera.rgb, camera.depth, camera.segmentation):
            if pictures is not None and len(pictures):
                try:
                    assert pictures[len(pictures) - 1].size
                except OSError as error:
                    yield str(error)


@pytest.mark.timeout(1800)
@pytest.mark.parametrize(
    ("kind", "count"),
    [
        ("ours", 10),
        *(pytest.param(kind, 240, marks=pytest.mark.slow) for kind in ("ours", "alone", "theirs", "dataset")),
    ],
)
def test_damaged_recordings_become_rows_and_messages(
    kind: str,
    count: int,
    originals: dict[str, tuple[Path, list[str]]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # One changed byte can make HDF5 search a group forever; this timeout then ends the reading.
    monkeypatch.setattr(reading, "ROW_SECONDS", 4.0)
    monkeypatch.setattr(reading, "OPEN_SECONDS", 4.0)
    original, files = originals[kind]
    folder = Path(shutil.copytree(original, tmp_path / "set"))
    assert look_at(folder) == []
    reported, process = 0, psutil.Process()
    before = process.memory_info().rss
    for number in range(count):
        rng = random.Random(f"{SEED} {number} {files}")
        for name in files:
            shutil.copyfile(original / name, folder / name)
        for name in rng.sample(files, k=1 if rng.random() < 0.8 else min(2, len(files))):
            path = folder / name
            path.write_bytes(damaged(path.read_bytes(), rng, path.suffix in (".json", ".notes")))
        began = time.monotonic()
        reported += bool(look_at(folder))
        assert time.monotonic() - began < MAX_SECONDS, f"seed {SEED}, number {number}"
        assert process.memory_info().rss - before < MAX_GROWTH_BYTES, f"seed {SEED}, number {number}"
    assert reported > count // 6
