"""Export of many recordings to one demonstration file, which ManiSkill's dataset class loads and its own tool replays."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import mani_skill.envs  # noqa: F401  registers the ids
import numpy as np
import pytest
from mani_skill.trajectory.dataset import ManiSkillTrajectoryDataset
from mani_skill.utils.wrappers.record import RecordEpisode

from tests.drive.commands import exit_code
from tests.drive.render_device import RENDER_BACKEND
from workbench.episodes.reader.read_episode import read_episode
from workbench.record.job import record
from workbench.record.job_worker import RecordOptions
from workbench.task.description import TaskOptions

pytestmark = pytest.mark.usefixtures("child_process")

PUSHER = Path(__file__).parents[2] / "browser" / "pusher.py"
PUSHED = {"control_mode": "pd_ee_delta_pos", "render_backend": "none"}


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """The .rrd files of three episodes that succeed and one that does not."""
    out, options = tmp_path_factory.mktemp("recorded"), TaskOptions(num_envs=3, seed=1, env_kwargs=PUSHED)
    pushed = RecordOptions("PushCube-v1", out, 3, actions=f"{PUSHER}:act", pictures=False, options=options)
    held = RecordOptions("PushCube-v1", out, 1, actions="hold", pictures=False, max_steps=3, options=options)
    return [one.path for what in (pushed, held) for one in record(what).written]


@pytest.mark.slow
def test_maniskills_dataset_class_and_its_replay_accept_exported_recordings(
    recordings: list[Path], tmp_path: Path
) -> None:
    file = tmp_path / "demos.h5"
    assert exit_code("export", *recordings, "--maniskill", file, "--only-successes") == 0
    data: Any = ManiSkillTrajectoryDataset(str(file), success_only=True)
    ours = [read_episode(path) for path in recordings[:3]]
    assert data.env_id == "PushCube-v1" and data.env_kwargs["control_mode"] == "pd_ee_delta_pos"
    assert len(data) == sum(one.length for one in ours)
    np.testing.assert_array_equal(np.concatenate([one.action for one in ours]), data.actions)
    np.testing.assert_array_equal(np.concatenate([one.reward for one in ours]), data.rewards)
    stock: Any = gym.make(
        "PushCube-v1", obs_mode="state", render_backend="none", control_mode="pd_ee_delta_pos"
    )
    obs, _ = stock.reset(seed=ours[0].info.seed)
    np.testing.assert_allclose(data.obs[0], obs[0].numpy(), atol=1e-5)
    stock.close()
    command = [sys.executable, "-m", "mani_skill.trajectory.replay_trajectory", "--traj-path", str(file)]
    done = subprocess.run(
        [*command, "--save-traj", "--use-env-states"], capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert "3/3=100.00% demos saved" in done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("obs_mode", ["rgb+depth+segmentation", "state+rgb"])
def test_observed_pictures_are_stored_as_maniskills_recorder_stores_them(
    renderer: None, tmp_path: Path, obs_mode: str, capsys: pytest.CaptureFixture[str]
) -> None:
    task, seed = "PickCube-v1", 7
    actions = np.random.default_rng(0).uniform(-1, 1, (4, 8)).astype(np.float32)
    np.save(tmp_path / "actions.npy", actions)
    for name, pictures in (("seen", True), ("blind", False)):
        options = TaskOptions(num_envs=1, seed=seed, env_kwargs={"obs_mode": obs_mode})
        given = str(tmp_path / "actions.npy")
        record(RecordOptions(task, tmp_path / name, 1, actions=given, pictures=pictures, options=options))
    stock: Any = gym.make(task, obs_mode=obs_mode, render_backend=RENDER_BACKEND)
    stock = RecordEpisode(stock, str(tmp_path), trajectory_name="theirs", save_video=False)
    stock.reset(seed=seed)
    for action in actions:
        stock.step(action)
    stock.close()
    assert exit_code("export", tmp_path / "seen", "--maniskill", tmp_path / "ours.h5") == 0
    ours, theirs = (obs_of(tmp_path / f"{name}.h5") for name in ("ours", "theirs"))
    assert {name: (one.shape, one.dtype) for name, one in ours.items()} == {
        name: (one.shape, one.dtype) for name, one in theirs.items()
    }
    assert any(name.startswith("sensor_data") for name in ours)
    for name, values in theirs.items():
        apart = np.abs(ours[name].astype(float) - values.astype(float))
        # Ours are JPEG; depth is whole millimetres: one side rounds, the other truncates.
        if name.endswith("rgb"):
            assert apart.mean() < 6
        else:
            assert apart.max() <= (1 if name.endswith("depth") else 1e-4), name
    data: Any = ManiSkillTrajectoryDataset(str(tmp_path / "ours.h5"))
    assert data.obs["sensor_data"]["base_camera"]["rgb"].shape == (4, 128, 128, 3)

    # ManiSkill's own file is exported unchanged.
    assert exit_code("export", tmp_path / "theirs.h5", "--maniskill", tmp_path / "again.h5") == 0
    for name, values in obs_of(tmp_path / "again.h5").items():
        np.testing.assert_allclose(values, theirs[name], atol=1e-6, err_msg=name)

    capsys.readouterr()
    assert exit_code("export", tmp_path / "blind", "--maniskill", tmp_path / "blind.h5") == 0
    (blind,) = (tmp_path / "blind").glob("*.json")
    assert blind.stem in capsys.readouterr().err
    assert not any(name.startswith("sensor_data") for name in obs_of(tmp_path / "blind.h5"))


def obs_of(file: Path) -> dict[str, Any]:
    """Observations of the first trajectory, by path."""
    found: dict[str, Any] = {}
    with h5py.File(file) as opened:
        obs: Any = opened["traj_0/obs"]
        obs.visititems(
            lambda name, node: found.update({name: node[()]}) if isinstance(node, h5py.Dataset) else None
        )
    return found
