"""An .rrd is whole whatever the process and the disk around its writer are like, or it is an error."""

from __future__ import annotations

import dataclasses
import errno
import os
import resource
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader

from tests.drive.episodes import Made, header_of, journal_of
from tests.drive.rows import append
from tests.recording.verify_rrd import verify_rrd
from workbench.core.scene.shapes import Material, Mesh, SceneGeometry, Visual
from workbench.machine.processes.child_python import child_environment, python_command
from workbench.recording.reader.read_episode import read_episode
from workbench.recording.rerun import shared_bytes
from workbench.recording.rerun import write as rrd
from workbench.recording.rerun.append_blueprint import blueprint_stream
from workbench.recording.writing.from_journal import episode_in
from workbench.recording.writing.journal import JournalReader

Maker = Callable[..., Made]


@pytest.mark.parametrize("most_kept", [0, 1])
def test_a_disk_that_is_full_at_any_byte_is_an_error_of_the_disk(
    child_process: None,
    make_episode: Maker,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    most_kept: int,
) -> None:
    """Also where the last that it takes is a part of the blueprint, or of the index; with the scene's bytes kept and not."""
    monkeypatch.setattr(shared_bytes, "_MOST_KEPT", most_kept)
    episode = make_episode(30, action=np.random.default_rng(0).random((30, 1)).astype(np.float32))
    writer = episode.writer(tmp_path)
    for row in episode.rows():
        append(writer, row)
    journal = journal_of(writer)
    journal.finish()
    reader = JournalReader(journal.path)
    recorded = episode_in(reader, header_of(journal.path))
    assert recorded is not None
    path = tmp_path / "some.rrd"

    def size_with_room(room: int) -> int:
        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (room, hard))
        try:
            rrd.write_rrd(recorded, path)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        return path.stat().st_size

    whole = [size_with_room(1 << 30) for _ in range(3)][-1]
    before = len(os.listdir("/proc/self/fd"))
    fitted = 0
    for room in [*range(0, whole - 128, whole // 80), *range(whole - 128, whole, 8)]:
        try:
            size = size_with_room(room)
        except OSError as error:
            assert error.errno == errno.EFBIG, room
        else:
            # Where what is compressed says when it was written, two files differ by some bytes: this one found room.
            assert room > whole - 128 and size <= room and verify_rrd(path) is None, (room, size, whole)
            fitted += 1
    assert fitted < 8, "the last bytes were hardly ever too many"
    assert len(os.listdir("/proc/self/fd")) == before
    assert size_with_room(whole + 64) > 0
    assert verify_rrd(path) is None
    reader.close()
    writer.discard()


def test_whoever_has_turned_rerun_off_still_gets_the_whole_recording(
    child_process: None, make_episode: Maker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RERUN", "off")
    episode = make_episode()
    # Blueprints are kept by the task's name.
    episode.info = dataclasses.replace(episode.info, task="NobodyElses-v1")
    files = episode.write(tmp_path)
    assert len(RrdReader(files.rrd).blueprints()) == 1
    assert os.environ["RERUN"] == "off"


@pytest.mark.slow
def test_threads_that_write_episodes_of_one_scene_share_its_meshes(
    child_process: None, make_episode: Maker, tmp_path: Path
) -> None:
    """A scene that names its bodies by env has more entities of one mesh than are kept."""
    envs = 80
    mesh = Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.uint32))
    each = np.arange(envs, dtype=np.int32)
    geometry = SceneGeometry(
        num_envs=envs,
        body_names=tuple(f"cube_{env}" for env in each),
        body_kinds=("dynamic",) * envs,
        body_hidden=(False,) * envs,
        visuals=(Visual("cube", mesh, Material((1.0, 0.5, 0.0, 1.0)), each, each),),
    )
    failed: list[BaseException] = []
    written: list[Path] = []

    def write(envs: range) -> None:
        try:
            for env in envs:
                poses = np.full((2, geometry.num_envs, 7), np.nan, np.float32)
                poses[:, env] = [env, 0, 0, 1, 0, 0, 0]
                episode = make_episode(1, geometry=geometry, poses=poses)
                episode.info = dataclasses.replace(episode.info, env_index=env, id=f"{env}")
                written.append(episode.write(tmp_path).json)
        except BaseException as error:
            failed.append(error)

    threads = [threading.Thread(target=write, args=(range(k, envs, 8),)) for k in range(8)]
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    finally:
        sys.setswitchinterval(interval)
    assert not failed and len(written) == envs
    for path in written[::16]:
        found = read_episode(path)
        assert found.geometry is not None
        (visual,) = found.geometry.visuals
        assert visual.bodies.tolist() == [found.info.env_index]


def test_a_material_of_whole_numbers_leaves_those_behind_it_as_they_are(
    child_process: None, tmp_path: Path
) -> None:
    # In a process of its own: rerun takes the type of the first value for all that follow.
    program = """
import sys
from pathlib import Path
import numpy as np
from tests.drive.rows import EpisodeRow, append
from workbench.core.scene.shapes import Material, Mesh, SceneGeometry, Visual
from workbench.recording.episode.episode import EpisodeInfo
from workbench.recording.writing.episode_writer import EpisodeWriter
mesh, zero = Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.uint32)), np.zeros(1, np.int32)
for seed, material in enumerate((Material((1, 0, 0, 1), 1, 0), Material((0.8, 0.5, 0.2, 1.0), 0.25, 0.5))):
    visual = Visual("cube/0", mesh, material, zero, zero)
    geometry = SceneGeometry(1, ("cube",), ("dynamic",), (False,), (visual,))
    info = EpisodeInfo("Painted-v1", 0, seed, None, "", {}, 0.05, None, "cpu")
    writer = EpisodeWriter(Path(sys.argv[1]), info, geometry, {}, (), ())
    append(writer, EpisodeRow(np.array([[0, 0, 0, 1, 0, 0, 0]], np.float32), {}, {}, {}, None, 0.0))
    append(writer, EpisodeRow(np.array([[0, 0, 0, 1, 0, 0, 0]], np.float32), {}, {}, {}, np.zeros(0, np.float32), 0.0))
    print(writer.finish().rrd)
"""
    command = python_command("-c", program, str(tmp_path))
    made = subprocess.run(command, env=child_environment(), capture_output=True, text=True, timeout=60)
    paths = made.stdout.split()
    assert len(paths) == 2, made.stderr
    for path, color, numbers in zip(
        paths, [(1, 0, 0, 1), (0.8, 0.5, 0.2, 1.0)], [(1, 0), (0.25, 0.5)], strict=True
    ):
        geometry = read_episode(Path(path)).geometry
        assert geometry is not None
        (visual,) = geometry.visuals
        assert visual.material.base_color == color
        assert (visual.material.metallic, visual.material.roughness) == numbers


def test_a_blueprint_can_be_shown_before_the_recording(make_episode: Maker, tmp_path: Path) -> None:
    path = make_episode().write(tmp_path).rrd
    (inside,) = RrdReader(path).blueprints()
    alone = tmp_path / "alone.rbl"
    content = blueprint_stream(path)
    assert content is not None
    alone.write_bytes(content)
    again = RrdReader(alone)
    assert [entry.recording_id for entry in again.blueprints()] == [inside.recording_id]
    assert again.recordings() == []
