"""`workbench.Recorder` around an env of `workbench.make`: partial resets, auto-resets, and failing files."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch
from mani_skill.utils.wrappers.record import RecordEpisode
from mani_skill.vector.wrappers.gymnasium import ManiSkillVectorEnv

import workbench
from tests.drive.envs import CPU
from tests.drive.waiting import until
from workbench.episodes.episode import NO_SEED, Episode
from workbench.episodes.reader.read_episode import read_episode, read_maniskill
from workbench.episodes.writing import episode_writer
from workbench.episodes.writing.finish_or_recover import recover
from workbench.episodes.writing.publish import RecordingError
from workbench.machine.processes.family import children

TASKS = Path(__file__).parents[2] / "tasks"


def episodes_in(folder: Path) -> list[Episode]:
    read = [read_episode(path) for path in folder.glob("*.json")]
    return sorted(
        read, key=lambda episode: (episode.info.env_index, episode.info.written_at, -episode.length)
    )


def test_auto_resets_end_an_episode_and_begin_the_next(tmp_path: Path) -> None:
    env = workbench.make("PushCube-v1", 2, max_episode_steps=3, **CPU)
    env = ManiSkillVectorEnv(workbench.Recorder(env, tmp_path), ignore_terminations=True)
    env.reset(seed=[7, 8])
    for _ in range(4):
        env.step(env.action_space.sample())
    env.close()
    read = episodes_in(tmp_path)
    assert [(e.info.env_index, e.length) for e in read] == [(0, 3), (0, 1), (1, 3), (1, 1)]
    assert [e.info.seed for e in read] == [7, NO_SEED, 8, NO_SEED]  # an auto-reset has no seed
    assert read[0].info.acted_by == ((0, "a program"),)
    assert read[0].info.max_episode_steps == 3 and bool(read[0].truncated[-1])


def test_it_records_the_same_data_as_maniskills_own_recorder(child_process: None, tmp_path: Path) -> None:
    """One run through both, RecordEpisode wrapped around ours, gives equal states, actions, rewards and flags."""
    env = workbench.make(str(TASKS / "push_cube.py"), 2, **CPU)
    ours = workbench.Recorder(env, tmp_path / "ours")
    theirs_in = str(tmp_path / "theirs")
    both = RecordEpisode(ours, theirs_in, save_video=False, trajectory_name="run")  # type: ignore[arg-type]
    both.reset(seed=3)
    for step in range(5):
        both.step(torch.from_numpy(both.action_space.sample()))
        if step == 2:
            both.reset(options={"env_idx": torch.tensor([1])})
    both.close()
    path = tmp_path / "theirs" / "run.h5"
    with h5py.File(path) as file:
        names = [*file]
    theirs = [read_maniskill(path, str(name)) for name in names]
    read = episodes_in(tmp_path / "ours")
    assert sorted(e.length for e in read) == sorted(e.length for e in theirs) == [2, 3, 5]
    for one in read:
        (other,) = [e for e in theirs if e.length == one.length]
        # The partial reset had no seed; RecordEpisode repeats the seed of the previous episode.
        assert one.info.seed == (NO_SEED if one.length == 2 else other.info.seed)
        for name in ("action", "reward", "terminated", "truncated"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
        assert one.env_states.keys() == other.env_states.keys()
        for name, values in one.env_states.items():
            np.testing.assert_array_equal(values, other.env_states[name], err_msg=name)
        flat = np.concatenate([v.reshape(one.length + 1, -1) for v in one.obs.values()], axis=1)
        np.testing.assert_array_equal(flat, other.obs[""])


@pytest.mark.parametrize(("envs", "cores", "begun"), [(4, 2, 1), (4, 1, 0), (3, 2, 0)])
def test_a_subprocess_writes_the_files_where_it_is_worthwhile(
    child_process: None, tmp_path: Path, envs: int, cores: int, begun: int
) -> None:
    """It does not with few envs or without a spare core."""
    all_cores = os.sched_getaffinity(0)
    if len(all_cores) < cores:
        pytest.skip("this machine has one core")
    env = workbench.make("PushCube-v1", envs, **CPU)
    before = children(os.getpid())
    try:
        os.sched_setaffinity(0, sorted(all_cores)[:cores])
        env = workbench.Recorder(env, tmp_path)
    finally:
        os.sched_setaffinity(0, all_cores)
    assert len(set(children(os.getpid())) - set(before)) == begun
    env.reset(seed=0)
    env.step(env.action_space.sample())
    env.finish()
    assert set(children(os.getpid())) <= set(before)
    assert [episode.length for episode in episodes_in(tmp_path)] == [1] * envs
    env.close()


@pytest.mark.parametrize(
    "asked",
    [
        True,
        pytest.param(("render_camera",), marks=pytest.mark.slow),
        pytest.param(False, marks=pytest.mark.slow),
    ],
)
def test_the_requested_pictures_are_recorded_and_match_the_env(
    renderer: None, tmp_path: Path, asked: bool | tuple[str, ...]
) -> None:
    with pytest.warns(UserWarning, match="renders simplified meshes"):
        made = workbench.make("PushCube-v1", 2, obs_mode="rgb", pictures="fast", backend="cpu")
    env = workbench.Recorder(made, tmp_path, pictures=asked)
    observed = [env.reset(seed=0)[0]]
    observed += [env.step(env.action_space.sample())[0] for _ in range(2)]
    env.close()
    seen = np.array([obs["sensor_data"]["base_camera"]["rgb"].numpy() for obs in observed], np.int16)
    names = {True: {"base_camera", "render_camera"}, False: set[str]()}
    for number, episode in enumerate(episodes_in(tmp_path)):
        tracks = {track.info.name: track for track in episode.cameras}
        assert tracks.keys() == names.get(asked, {"render_camera"}) and episode.info.pictures == "fast"  # type: ignore[call-overload]
        for track in tracks.values():
            assert track.frame.tolist() == [0, 1, 2]
        if asked is True:
            kept = np.array([tracks["base_camera"].pictures["rgb"][step] for step in range(3)], np.int16)
            # JPEG is lossy, so each picture only has to be nearest to that of its own env and step.
            off = np.abs(kept[:, None, None] - seen).mean(axis=(-3, -2, -1))
            assert off.reshape(3, -1).argmin(axis=1).tolist() == [2 * step + number for step in range(3)]
            assert off.min(axis=(1, 2)).max() < 6


def test_a_full_disk_warns_once_and_the_run_goes_on(tmp_path: Path) -> None:
    in_the_way = tmp_path / "recordings"
    in_the_way.write_text("no folder")
    env = workbench.Recorder(workbench.make("PushCube-v1", 1, **CPU), in_the_way)
    with pytest.warns(UserWarning, match="is not a folder"):
        env.reset(seed=0)
    env.step(env.action_space.sample())
    assert env.problem is not None and env.episodes_written == 0
    env.close()


def test_files_that_cannot_be_made_end_the_recording_with_one_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*args: Any, **named: Any) -> None:
        raise RecordingError("the disk is full")

    env = workbench.Recorder(workbench.make("PushCube-v1", 2, **CPU), tmp_path)
    env.reset(seed=0)
    env.step(env.action_space.sample())
    with monkeypatch.context() as patched, pytest.warns(UserWarning, match="the disk is full") as warned:
        patched.setattr(episode_writer, "make_files", fails)
        env.reset(seed=1)
        until(lambda: env.step(env.action_space.sample()) and env.problem, "the problem")
    for _ in range(2):
        env.reset(seed=2)
        env.step(env.action_space.sample())
    env.close()
    assert len(warned) == 1 and env.episodes_written == 0 and not list(tmp_path.glob("*.h5"))


def test_steps_before_an_unseen_reset_are_kept(tmp_path: Path) -> None:
    env = workbench.Recorder(workbench.make("PushCube-v1", 2, **CPU), tmp_path)
    env.reset(seed=0)
    for _ in range(3):
        env.step(env.action_space.sample())
    env.unwrapped.reset(seed=5)
    with pytest.warns(UserWarning, match="step 4 was expected, but step 1 arrived"):
        env.step(env.action_space.sample())
    assert env.problem is not None
    env.close()
    assert sorted(episode.length for episode in episodes_in(tmp_path)) == [3, 3]


CHILD = """
import sys, time
import workbench

env = workbench.make("PushCube-v1", 3, backend="cpu", render_backend="none")
env = workbench.Recorder(env, sys.argv[1])
env.reset(seed=0)
print("begun", flush=True)
for step in range(1, 10**6):
    env.step(env.action_space.sample())
    print(step, time.time(), flush=True)
"""


@pytest.mark.slow
def test_a_killed_program_loses_a_second(child_process: None, tmp_path: Path) -> None:
    """Everything that waits is written within a second."""
    child = subprocess.Popen([sys.executable, "-c", CHILD, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    assert child.stdout is not None and child.stdout.readline() == "begun\n"
    lines, begun = [child.stdout.readline()], time.time()
    while time.time() < begun + 1.5:  # until there are steps older than a second
        lines.append(child.stdout.readline())
    child.send_signal(signal.SIGKILL)
    killed = time.time()
    lines += child.stdout.read().splitlines(keepends=True)
    made = [line.split() for line in lines if line.endswith("\n")]
    child.wait()
    old = max(int(step) for step, at in made if float(at) < killed - 1.0)
    assert len(recover(tmp_path)) == 3
    for episode in episodes_in(tmp_path):
        assert episode.info.recovered and old <= episode.length <= len(made) + 1
        assert (
            np.isfinite(episode.reward).all() and len(episode.env_states["actors/cube"]) == episode.length + 1
        )
