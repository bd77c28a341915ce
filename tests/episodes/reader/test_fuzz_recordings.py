"""Fuzzed recordings: each becomes a row or an error message, in bounded time and memory.

Real files of each kind are damaged in random ways from a seed: bytes changed, cut or doubled, numbers made huge.
Tests marked `slow` run longer; ``WORKBENCH_FUZZ_SEED`` sets another seed.
"""

from __future__ import annotations

import json
import os
import random
import re
import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import psutil
import pytest

from tests.drive.rows import EpisodeRow, append
from tests.episodes.foreign_h5 import write as write_h5
from workbench.envs.camera_data import CameraInfo, Picture
from workbench.envs.scene.shapes import Material, Mesh, SceneGeometry, Visual
from workbench.envs.task_drawings import Drawing
from workbench.episodes.episode import Episode, EpisodeInfo
from workbench.episodes.lerobot.export import export_lerobot
from workbench.episodes.reader import reading
from workbench.episodes.reader.read_episode import read_episode
from workbench.episodes.reader.scan import scan_folder
from workbench.episodes.row import Source, UnreadableRecording
from workbench.episodes.writing.episode_writer import EpisodeWriter
from workbench.review.view import find_events

pytestmark = pytest.mark.usefixtures("child_process")

SEED = int(os.environ.get("WORKBENCH_FUZZ_SEED", "0"))
MAX_SECONDS = 60.0
"""Limit for one damaged recording: it detects hangs and is no performance goal."""
MAX_GROWTH_BYTES = 1 << 30
"""Limit for the growth of this process; data of a closed recording must be freed."""
HUGE = [b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"\x00\x00\x00\x80", b"\x00" * 8, b"\xff" * 8]


@dataclass(frozen=True)
class Original:
    """An intact recording, and the names of its files to damage."""

    folder: Path
    files: tuple[str, ...]


def record(folder: Path) -> Path:
    """Write a workbench recording of six steps with a camera of all modalities."""
    corner = Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.uint32))
    visual = Visual(
        "box", corner, Material((1.0, 0.5, 0.0, 1.0)), np.zeros(2, np.int32), np.array([0, 1], np.int32)
    )
    geometry = SceneGeometry(1, ("floor", "cube"), ("static", "dynamic"), (False, False), (visual,))
    info = EpisodeInfo("PushCube-v1", 0, 3, None, "0" * 12, {"push.py": "x = 1\n"}, 0.05, None, "cpu")
    seen = ("rgb", "depth", "segmentation")
    camera = CameraInfo("base", "sensor", 16, 16, 1.0, 0.01, 10.0, np.eye(3, dtype=np.float32), None, seen)
    writer = EpisodeWriter(folder, info, geometry, {1: "cube"}, ("x", "y"), (camera,))
    poses = np.tile(np.array([0, 0, 0, 1, 0, 0, 0], np.float32), (2, 1))
    for step in range(7):
        rgb = np.full((16, 16, 3), step, np.uint8)
        flat = np.full((16, 16), step)
        picture = Picture("base", "sensor", 0, poses[0], rgb, flat.astype(np.float32), flat.astype(np.int32))
        action = None if step == 0 else np.zeros(2, np.float32)
        poses = poses + np.float32(0.01)
        states = {"actors/cube": np.zeros(13, np.float32)}
        row = EpisodeRow(
            poses,
            {"success": np.array(step == 6)},
            states,
            {"x": np.ones(3)},
            action,
            0.1,
            pictures=(picture,),
            drawn={"dot": Drawing("points", poses[None, :, :3]), "axes": Drawing("frames", poses[None])},
        )
        append(writer, row)
    return writer.finish().json


@pytest.fixture(scope="module")
def originals(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Original]:
    ours = tmp_path_factory.mktemp("ours")
    path = record(ours)
    (ours / f"{path.stem}.notes").write_text(
        json.dumps({"workbench_notes": {"": {"tags": ["a"], "note": "b"}}})
    )
    alone = tmp_path_factory.mktemp("alone")
    shutil.copy(path.with_suffix(".rrd"), alone / "sent.rrd")
    theirs = tmp_path_factory.mktemp("theirs")

    def with_pictures(group: h5py.Group) -> None:
        group.create_dataset(
            "obs/sensor_data/base/rgb", data=np.zeros((4, 16, 16, 3), np.uint8), compression="gzip"
        )
        group["obs/agent/qpos"] = np.zeros((4, 9), np.float32)
        group["success"] = np.zeros(3, bool)

    write_h5(theirs, with_pictures)
    (theirs / "theirs.notes").write_text(
        json.dumps({"workbench_notes": {"traj_0": {"tags": ["a"], "note": "b"}}})
    )
    dataset = tmp_path_factory.mktemp("dataset") / "set"
    export_lerobot([("a", lambda: read_episode(path))], dataset)
    return {
        "ours": Original(ours, (f"{path.stem}.json", f"{path.stem}.h5", f"{path.stem}.rrd", f"{path.stem}.notes")),
        "alone": Original(alone, ("sent.rrd",)),
        "theirs": Original(theirs, ("theirs.json", "theirs.h5", "theirs.notes")),
        "dataset": Original(
            dataset,
            tuple(
                sorted(
                    file.relative_to(dataset).as_posix()
                    for file in dataset.rglob("*")
                    if file.is_file() and file.name not in ("stats.json", "tasks.parquet")
                )
            ),
        ),
    }  # fmt: skip


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
            try:
                if facts.kind == "lerobot":
                    if facts.trajectory is not None:
                        messages += opened(reading.read_recording(Source(path.parents[1], facts.trajectory)))
                elif facts.trajectory is not None:
                    messages += opened(
                        reading.read_recording(Source(path.with_suffix(".h5"), facts.trajectory))
                    )
                else:
                    suffix = ".json" if ".json" in found.sizes else ".rrd" if ".rrd" in found.sizes else ".h5"
                    messages += opened(reading.read_recording(Source(path.with_suffix(suffix))))
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


def fuzz(original: Original, folder: Path, count: int, seed: int) -> int:
    """Return how many of the damaged recordings were reported as damaged."""
    reported, process = 0, psutil.Process()
    before = process.memory_info().rss
    shutil.copytree(original.folder, folder)
    for number in range(count):
        rng = random.Random(f"{seed} {number} {original.files}")
        for name in original.files:
            shutil.copyfile(original.folder / name, folder / name)
        for name in rng.sample(original.files, k=1 if rng.random() < 0.8 else min(2, len(original.files))):
            path = folder / name
            path.write_bytes(damaged(path.read_bytes(), rng, path.suffix in (".json", ".notes")))
        began = time.monotonic()
        reported += bool(look_at(folder))
        assert time.monotonic() - began < MAX_SECONDS, f"seed {seed}, number {number}"
        assert process.memory_info().rss - before < MAX_GROWTH_BYTES, f"seed {seed}, number {number}"
    return reported


@pytest.mark.parametrize(
    "kind", ["ours", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("alone", "theirs", "dataset"))]
)
def test_damaged_recordings_become_rows_and_messages(
    kind: str, originals: dict[str, Original], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    original = originals[kind]
    shutil.copytree(original.folder, tmp_path / "whole")
    assert look_at(tmp_path / "whole") == []
    # One changed byte can make HDF5 search a group forever; this timeout then ends the reading.
    monkeypatch.setattr(reading, "ROW_SECONDS", 4.0)
    monkeypatch.setattr(reading, "OPEN_SECONDS", 4.0)
    assert fuzz(original, tmp_path / "set", 10, SEED) > 1


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("kind", ["ours", "alone", "theirs", "dataset"])
def test_very_many_damaged_recordings_become_rows_and_messages(
    kind: str, originals: dict[str, Original], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reading, "ROW_SECONDS", 4.0)
    monkeypatch.setattr(reading, "OPEN_SECONDS", 4.0)
    assert fuzz(originals[kind], tmp_path / "set", 240, SEED + 1) > 40
