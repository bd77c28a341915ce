"""What a killed process leaves becomes an episode, up to the last second; nothing else is touched."""

from __future__ import annotations

import dataclasses
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.recording.made import Made
from tests.recording.verify_rrd import verify_rrd
from tests.session.recordings import begin
from tests.session.recordings import made as small
from workbench.recording import make_files as making
from workbench.recording.journal import FOLDER, SYNC_SECONDS, Journal, read_journal
from workbench.recording.landing import RecordingError
from workbench.recording.mend import mend
from workbench.recording.read_episode import read_episode
from workbench.recording.recover import recover

Maker = Callable[..., Made]

CHILD = """
import sys, time
from pathlib import Path
import numpy as np
from workbench.core.geometry import Material, Mesh, SceneGeometry, Visual
from workbench.core.pictures import CameraInfo, Picture
from workbench.recording.episode import EpisodeInfo
from workbench.recording.episode_writer import EpisodeWriter
from workbench.recording.row import EpisodeRow

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
        writer.append(row(k))
        # What the parent holds it to: this row was appended then.
        sys.stdout.write(f"{episode} {k} {time.time()}\\n")
        sys.stdout.flush()
        time.sleep(0.002)
    writer.finish()
    sys.stdout.write(f"{episode} finished\\n")
    sys.stdout.flush()
"""


@pytest.mark.parametrize("steps", [60, 10**6])
def test_a_killed_writer_loses_a_second_of_one_episode(tmp_path: Path, steps: int) -> None:
    """Killed at random moments: between rows, while files are made, and while they get their names."""
    chance = random.Random(steps)
    for kill in range(4):
        folder = tmp_path / str(kill)
        child = subprocess.Popen(
            [sys.executable, "-c", CHILD, str(folder), str(steps)], stdout=subprocess.PIPE, text=True
        )
        assert child.stdout is not None and child.stdout.readline() == "begun\n"
        time.sleep(chance.uniform(0.6, 2.0))
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


def test_a_killed_writer_was_given_time_to_lose_nothing(make_episode: Maker, tmp_path: Path) -> None:
    """Rows that were appended long ago are there though none came after them."""
    episode = make_episode(5)
    writer = episode.writer(tmp_path)
    for k, row in enumerate(episode.rows()):
        if k == 4:
            writer.acted_by("somebody else")
        writer.append(row)
    journal = next((tmp_path / FOLDER).glob("*.arrow"))
    deadline = time.monotonic() + 20 * SYNC_SECONDS + 20
    while sum(entry.kind == "row" for entries in read_journal(journal) for entry in entries) < 6:
        assert time.monotonic() < deadline
        time.sleep(0.05)
    assert recover(tmp_path) == []  # its writer lives
    writer.close()
    (files,) = recover(tmp_path)
    found = read_episode(files.h5)
    acted_by = (*episode.info.acted_by, (3, "somebody else"))
    assert found.info == dataclasses.replace(episode.info, recovered=True, acted_by=acted_by)
    assert found.length == 5


def test_a_journal_may_end_anywhere(make_episode: Maker, tmp_path: Path) -> None:
    episode = make_episode(4)
    writer = episode.writer(tmp_path)
    ends = []
    for row in episode.rows():
        writer.append(row)
        writer._journal.write()
        ends.append(writer._journal.size)
    writer._journal.write()
    journal = next((tmp_path / FOLDER).glob("*.arrow"))
    whole = journal.read_bytes()
    writer.discard()
    chance = random.Random(0)
    cut = tmp_path / "cut.arrow"
    for end in [*ends, *(chance.randrange(len(whole)) for _ in range(40))]:
        cut.write_bytes(whole[:end])
        rows = sum(entry.kind == "row" for entries in read_journal(cut) for entry in entries)
        assert rows == sum(one <= end for one in ends)


def test_garbage_at_the_end_is_left_out(make_episode: Maker, tmp_path: Path) -> None:
    """After a power cut a file may be as long as it was meant to be, and hold something else."""
    episode = make_episode(4)
    writer = episode.writer(tmp_path)
    for row in episode.rows():
        writer.append(row)
    writer._journal.write()
    writer.close()
    journal = next((tmp_path / FOLDER).glob("*.arrow"))
    with journal.open("ab") as file:
        file.write(bytes(1000) + os.urandom(5000))
    (files,) = recover(tmp_path)
    assert read_episode(files.rrd).length == 4


@pytest.mark.parametrize("linked", [0, 1, 2, 3])
def test_a_writer_that_died_between_two_names(
    make_episode: Maker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, linked: int
) -> None:
    episode = make_episode()
    writer = episode.writer(tmp_path)
    for row in episode.rows():
        writer.append(row)
    link = os.link
    done: list[str] = []

    class Death(BaseException):
        pass

    def dying(source: str, target: str) -> None:
        if len(done) == linked:
            raise Death
        link(source, target)
        done.append(target)

    # Death takes no time to clean up.
    monkeypatch.setattr(os, "link", dying)
    monkeypatch.setattr("workbench.recording.landing._remove", lambda paths: None)
    monkeypatch.setattr(Path, "unlink", lambda self, missing_ok=False: None)
    if linked == 3:
        monkeypatch.setattr(
            "workbench.recording.landing.sync_folder", lambda folder: (_ for _ in ()).throw(Death())
        )
    with pytest.raises(Death):
        writer._journal.finish()
        making.make_files(writer._journal.path, writer._header, tmp_path)
    monkeypatch.undo()
    writer.close()
    assert len([path for path in tmp_path.iterdir() if path.is_file()]) == linked
    recovered = recover(tmp_path)
    assert len(recovered) == (0 if linked == 3 else 1)
    (path,) = tmp_path.glob("*.json")
    assert read_episode(path).info.id == episode.info.id
    assert len(list(tmp_path.iterdir())) == 3


def test_a_journal_without_a_step_is_cleared_away(make_episode: Maker, tmp_path: Path) -> None:
    writer = make_episode().writer(tmp_path)
    writer.append(next(iter(make_episode().rows())))
    writer._journal.write()
    writer.close()
    Journal(tmp_path / FOLDER / "empty.arrow").close()
    (tmp_path / FOLDER / "stray.rrd").write_text("half")
    (tmp_path / "mine.txt").write_text("mine")
    assert recover(tmp_path) == []
    assert os.listdir(tmp_path) == ["mine.txt"]
    assert recover(tmp_path / "nowhere") == []


def test_without_its_meshes_an_episode_is_recovered_bare(make_episode: Maker, tmp_path: Path) -> None:
    episode = make_episode()
    writer = episode.writer(tmp_path)
    for row in episode.rows():
        writer.append(row)
    writer._journal.write()
    writer.close()
    scene = next((tmp_path / FOLDER).glob("*.scene"))
    scene.write_bytes(scene.read_bytes()[:-100])
    (files,) = recover(tmp_path)
    found = read_episode(files.rrd)
    assert found.geometry is not None and found.poses is not None
    assert found.geometry.visuals == () and found.geometry.body_names == episode.geometry.body_names
    np.testing.assert_array_equal(found.poses, episode.poses)


def test_mending_is_done_by_a_process_that_bears_what_a_folder_brings(tmp_path: Path) -> None:
    assert mend(tmp_path / "none") == mend(tmp_path) == ()
    begin(tmp_path, small(5, seed=8))
    for name in ("pipe.arrow", "pipe.scene"):
        os.mkfifo(tmp_path / FOLDER / name)
    (tmp_path / FOLDER / "zero.arrow").symlink_to("/dev/zero")
    (tmp_path / FOLDER / "noise.arrow").write_bytes(os.urandom(3000))
    assert len(mend(tmp_path)) == 1
    (path,) = tmp_path.glob("*.json")
    assert read_episode(path).length == 5 and read_episode(path).unread == ()


def test_files_of_another_folder_are_no_strays(tmp_path: Path) -> None:
    folder, other = tmp_path / "recordings", tmp_path / "other"
    folder.mkdir()
    other.mkdir()
    (other / "precious.json").write_text("{}")
    (folder / FOLDER).symlink_to(other)
    for recovering in (recover, mend):
        with pytest.raises(RecordingError, match="is a link"):
            recovering(folder)
    assert (other / "precious.json").exists()
