"""Recording live, and afterwards from the history, gives the same files."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from tests.drive.session import BASE, TASKS, camera, live_session, moved, step, wait_until
from workbench.app.session import Session
from workbench.cameras.commands import PutMovedCamerasBack
from workbench.cameras.events import CameraPlaced
from workbench.episodes.episode import Episode
from workbench.episodes.lerobot.export import ExportOptions, export_lerobot
from workbench.episodes.lerobot.format import WORKBENCH_FILE
from workbench.episodes.maniskill.export import export_maniskill
from workbench.episodes.reader.read_episode import read_episode
from workbench.record.commands import StopRecording
from workbench.record.saving_state import SaveWanted
from workbench.record.state import RecordingStatus, RecordingWanted
from workbench.task.load import load_task

STEPS = 4


@pytest.fixture(scope="module")
def session(child_process: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Session]:
    folder = tmp_path_factory.mktemp("task")
    # Small pictures: software rendering of 512 x 512 would take most of the time.
    (folder / "push_cube.py").write_text((TASKS / "push_cube.py").read_text().replace("512", "64"))
    with live_session(folder / "push_cube.py", folder / "recordings", seed=5, draw=True) as session:
        yield session


def begin_recording(session: Session, envs: tuple[int, ...] | None = None) -> None:
    """Begin to record these envs (all if None), and wait for their reset."""
    session.dispatch(RecordingWanted(envs))
    begun = lambda status: status.active and status.waiting == 0  # noqa: E731
    wait_until(session, lambda view: begun(view.of(RecordingStatus)), "the recording")


def written(session: Session, count: int) -> list[Episode]:
    """Wait for this many episodes and return them, oldest first."""
    view = wait_until(session, lambda view: view.of(RecordingStatus).episodes_written >= count, "the files")
    paths = sorted(
        Path(view.of(RecordingStatus).folder).glob("*.json"), key=lambda path: path.stat().st_mtime_ns
    )
    assert len(paths) == count and view.of(RecordingStatus).problem is None
    return [read_episode(path) for path in paths]


def assert_same(one: Episode, other: Episode) -> None:
    """Assert that two episodes hold the same data, bit for bit; ids and dates may differ."""
    assert (one.info.seed, one.info.env_index) == (other.info.seed, other.info.env_index)
    assert one.info.acted_by == other.info.acted_by
    assert one.poses is not None and other.poses is not None
    for name in ("poses", "action", "reward", "terminated", "truncated"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
    for group in ("env_states", "obs", "evaluate"):
        ours, theirs = getattr(one, group), getattr(other, group)
        assert ours.keys() == theirs.keys() and ours
        for name, values in ours.items():
            np.testing.assert_array_equal(values, theirs[name], err_msg=f"{group}/{name}")
    assert len(one.cameras) == len(other.cameras) > 0
    for track, again in zip(one.cameras, other.cameras, strict=True):
        np.testing.assert_array_equal(track.pose, again.pose)
        for modality in ("rgb", "depth", "segmentation"):
            pictures, others = getattr(track, modality), getattr(again, modality)
            assert (pictures is None) == (others is None)
            for i in range(len(pictures or ())):
                np.testing.assert_array_equal(pictures[i], others[i], err_msg=f"{modality} {i}")


@pytest.mark.slow
def test_an_episode_saved_afterwards_equals_one_recorded_live(session: Session) -> None:
    begin_recording(session)
    step(session, STEPS)
    view = wait_until(session, lambda view: view.of(RecordingStatus).steps == 2 * STEPS, "the steps")
    assert view.of(RecordingStatus).bytes_written > 0
    session.do(StopRecording())
    live = written(session, 2)
    session.dispatch(SaveWanted())
    wait_until(session, lambda view: bool(view.of(RecordingStatus).saving.message), "the keeping")
    expected = f"Saved 2 episodes, {2 * STEPS} steps; none of them had ended"
    assert session.view().of(RecordingStatus).saving.message == expected
    every = written(session, 4)
    kept = {episode.info.env_index: episode for episode in every[2:]}
    assert kept.keys() == {0, 1}
    load_task(str(TASKS / "push_cube.py"))  # registers it
    stock: Any = gym.make("WorkbenchPushCube-v1", num_envs=1, sim_backend="physx_cpu", render_backend="none")
    for episode in live:
        stock.reset(seed=episode.info.seed)
        start = stock.unwrapped.get_state_dict()["actors"]["cube"][0].numpy()
        # The seed shown to the user reproduces the episode, though the page reset both envs.
        np.testing.assert_allclose(episode.env_states["actors/cube"][0], start, rtol=0, atol=1e-6)
    stock.close()
    for episode in live:
        assert episode.length == STEPS
        assert episode.info.acted_by == ((0, "random"),)
        assert_same(episode, kept[episode.info.env_index])


@pytest.mark.slow
def test_a_recording_holds_both_the_moved_and_the_files_camera_placement(
    session: Session, tmp_path: Path
) -> None:
    """This holds live and for saved past episodes, in the .json and in exports."""
    in_file = camera(session, BASE).now
    assert in_file is not None
    there = replace(in_file, position=(0.31, 0.02, 0.55))
    count = session.view().of(RecordingStatus).episodes_written
    session.dispatch(CameraPlaced(BASE, there))
    wait_until(session, lambda view: moved(view) == {BASE}, "the placement")
    begin_recording(session, (0,))
    step(session, 2)
    session.dispatch(SaveWanted((0,)))
    past = written(session, count + 1)[-1]
    session.do(PutMovedCamerasBack())
    wait_until(session, lambda view: not moved(view), "the file's placement")
    step(session, 2)
    view = wait_until(session, lambda view: view.of(RecordingStatus).steps == 4, "the steps")
    assert view.of(RecordingStatus).episodes == 0 and time.time() - view.of(RecordingStatus).since < 600
    session.do(StopRecording())
    live = written(session, count + 2)[-1]
    assert [(m.state, m.name, m.used, m.in_file) for m in live.info.moved_cameras] == [
        (0, "base_camera", there, in_file),
        (3, "base_camera", in_file, in_file),
    ]
    assert past.info.moved_cameras == live.info.moved_cameras[:1]
    # Each picture has its own pose.
    track = next(track for track in live.cameras if track.info.key == BASE)
    stood = np.array([(0.31, 0.02, 0.55)] * 3 + [(0.45, 0, 0.6)] * 2)
    np.testing.assert_allclose(track.pose[:, :3], stood, atol=1e-6)
    sources = [("live", lambda: live)]
    export_maniskill(sources, tmp_path / "all.h5")
    (episode,) = json.loads((tmp_path / "all.json").read_text())["episodes"]
    export_lerobot(sources, tmp_path / "set", ExportOptions())
    ours = json.loads((tmp_path / "set" / WORKBENCH_FILE).read_text())["episodes"][0]
    for exported in (episode, ours):
        assert [m["used"]["position"] for m in exported["moved_cameras"]] == [
            [0.31, 0.02, 0.55],
            list(in_file.position),
        ]
