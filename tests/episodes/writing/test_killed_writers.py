"""The journal of a killed process is recovered to an episode, up to the last second, in a subprocess."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from tests.drive.episodes import begin
from tests.drive.episodes import made as small
from tests.episodes.verify_rrd import verify_rrd
from workbench.episodes.reader.read_episode import read_episode
from workbench.episodes.reader.reading import recover_confined
from workbench.episodes.writing.finish_or_recover import recover
from workbench.episodes.writing.journal import FOLDER
from workbench.machine.processes.confinement import landlock_version

pytestmark = pytest.mark.usefixtures("child_process")

CHILD = """
import sys, time
from pathlib import Path
import numpy as np
from tests.drive.rows import EpisodeRow, append
from workbench.envs.scene.shapes import Material, Mesh, SceneGeometry, Visual
from workbench.envs.camera_data import CameraInfo, Picture
from workbench.episodes.episode import EpisodeInfo
from workbench.episodes.writing.episode_writer import EpisodeWriter

folder, steps = Path(sys.argv[1]), int(sys.argv[2])
mesh = Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.uint32))
zero = np.zeros(1, np.int32)
geometry = SceneGeometry(1, ("cube",), ("dynamic",), (False,), (Visual("cube/0", mesh, Material((1, 0, 0, 1)), zero, zero),))
camera = CameraInfo("eye", "sensor", 8, 8, 1.0, 0.01, 10.0, np.eye(3, dtype=np.float32), None, ("rgb",))

def row(k):
    picture = Picture("eye", "sensor", 0, np.array([k, 0, 0, 1, 0, 0, 0], np.float32), rgb=np.full((8, 8, 3), k % 200, np.uint8))
    poses = np.array([[k, 0, 0, 1, 0, 0, 0]], np.float32)
    entries = {"success": np.bool_(k > 3), "number": np.int64(k)}
    action = None if k == 0 else np.array([k], np.float32)
    return EpisodeRow(poses, entries, {"actors/cube": np.full(13, k, np.float32)}, {}, action, float(k), pictures=(picture,))

print("begun", flush=True)
for episode in range(10**6):
    info = EpisodeInfo("Killed-v1", 0, episode, None, "", {}, 0.05, None, "cpu")
    writer = EpisodeWriter(folder, info, geometry, {}, ("a",), (camera,))
    for k in range(steps + 1):
        append(writer, row(k))
        # Tells the parent that this row was appended at this time.
        sys.stdout.write(f"{episode} {k} {time.time()}\\n")
        sys.stdout.flush()
        time.sleep(0.002)  # about the duration of a step
    writer.finish()
    sys.stdout.write(f"{episode} finished\\n")
    sys.stdout.flush()
"""


@pytest.mark.parametrize(
    ("steps", "kills"),
    [(10**6, 1), *(pytest.param(steps, 6, marks=pytest.mark.slow) for steps in (60, 10**6))],
)
def test_a_killed_writer_loses_a_second_of_one_episode(tmp_path: Path, steps: int, kills: int) -> None:
    """The writer is killed at random moments: between rows, while files are written, and while they are renamed."""
    chance = random.Random(steps)
    for kill in range(kills):
        folder = tmp_path / str(kill)
        child = subprocess.Popen(
            [sys.executable, "-c", CHILD, str(folder), str(steps)], stdout=subprocess.PIPE, text=True
        )
        assert child.stdout is not None and child.stdout.readline() == "begun\n"
        time.sleep(chance.uniform(0.6, 2.0))  # at any moment
        child.send_signal(signal.SIGKILL)
        killed = time.time()
        lines = [line.split() for line in child.stdout.read().splitlines() if line]
        child.wait()

        finished = {int(line[0]) for line in lines if line[1] == "finished"}
        appended = [(int(line[0]), int(line[1]), float(line[2])) for line in lines if len(line) == 3]
        recover(folder)
        assert not (folder / FOLDER).exists()
        found = {read_episode(path).info.seed: path for path in folder.glob("*.json")}
        assert finished <= found.keys() <= {*finished, max(finished, default=-1) + 1}
        assert len(list(folder.iterdir())) == 3 * len(found)
        for seed, path in found.items():
            episode = read_episode(path)
            assert verify_rrd(path.with_suffix(".rrd")) is None
            states = np.arange(episode.length + 1)
            assert episode.poses is not None
            np.testing.assert_array_equal(episode.poses[:, 0, 0], states)
            np.testing.assert_array_equal(episode.evaluate["number"], states)
            np.testing.assert_array_equal(episode.env_states["actors/cube"][:, 5], states)
            np.testing.assert_array_equal(episode.reward, states[1:])
            np.testing.assert_array_equal(episode.cameras[0].frame, states)
            assert episode.geometry is not None and len(episode.geometry.visuals) == 1
            if seed in finished:
                assert episode.length == steps and not episode.info.recovered
        under_way = max(finished, default=-1) + 1
        old = [k for episode, k, at in appended if episode == under_way and at < killed - 1.0]
        if old and max(old) > 0:
            assert read_episode(found[under_way]).length >= max(old)
        assert recover(folder) == []


def test_recovery_runs_in_a_process_that_survives_damaged_folders(tmp_path: Path) -> None:
    assert recover_confined(tmp_path / "none") == recover_confined(tmp_path) == ()
    begin(tmp_path, small(5, seed=8))
    for name in ("pipe.arrow", "pipe.scene"):
        os.mkfifo(tmp_path / FOLDER / name)
    (tmp_path / FOLDER / "zero.arrow").symlink_to("/dev/zero")
    (tmp_path / FOLDER / "noise.arrow").write_bytes(os.urandom(3000))
    assert len(recover_confined(tmp_path)) == 1
    (path,) = tmp_path.glob("*.json")
    assert read_episode(path).length == 5 and read_episode(path).broken_files == ()


@pytest.mark.skipif(not landlock_version(), reason="this kernel has no Landlock")
@pytest.mark.parametrize("outside", [False, True])
def test_recovery_reads_nothing_outside_the_folder(tmp_path: Path, outside: bool) -> None:
    folder, elsewhere = tmp_path / "recordings", tmp_path / "elsewhere"
    begin(folder, small(5, seed=8))
    if outside:
        (scene,) = (folder / FOLDER).glob("*.scene")
        scene.rename(elsewhere)
        scene.symlink_to(elsewhere)
    assert len(recover_confined(folder)) == 1
    geometry = read_episode(next(folder.glob("*.json"))).geometry
    assert bool(geometry and geometry.visuals) != outside
