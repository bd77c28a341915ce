"""ManiSkill's own ``replay_trajectory`` replays our recordings on its stock env, by states and by actions."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from workbench.episodes.episode import Episode
from workbench.episodes.reader.read_episode import read_episode, read_maniskill
from workbench.record.job import record
from workbench.record.job_worker import RecordOptions
from workbench.task.description import TaskOptions

pytestmark = pytest.mark.usefixtures("child_process")

HERE = Path(__file__).parents[1] / "live"
POLICIES = {
    "PickCube-v1": HERE / "lifter.py",
    "PushCube-v1": HERE.parent / "browser" / "pusher.py",
}


@pytest.fixture(scope="module", params=["PushCube-v1", pytest.param("PickCube-v1", marks=pytest.mark.slow)])
def recorded(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The .h5 of an episode that succeeds, in a batch of two."""
    what = RecordOptions(
        request.param,
        tmp_path_factory.mktemp("recorded"),
        successes=1,
        actions=f"{POLICIES[request.param]}:act",
        pictures=False,
        options=TaskOptions(num_envs=2, seed=1, env_kwargs={"control_mode": "pd_ee_delta_pos"}),
    )
    (written,) = record(what).written
    return written.path.with_suffix(".h5")


def replayed(path: Path, *arguments: str) -> Episode:
    """The episode that ``--save-traj`` wrote."""
    command = [sys.executable, "-m", "mani_skill.trajectory.replay_trajectory", "--traj-path", str(path)]
    options = ["--save-traj", "--record-rewards", "--reward-mode", "normalized_dense", *arguments]
    done = subprocess.run([*command, *options], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    assert "1/1=100.00% demos saved" in done.stdout
    return read_maniskill(path.with_suffix(".state.pd_ee_delta_pos.physx_cpu.h5"), "traj_0")


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["--use-env-states", "--use-first-env-state"])
def test_a_replay_succeeds_and_equals_the_episode(recorded: Path, mode: str) -> None:
    ours, again = read_episode(recorded), replayed(recorded, mode)
    assert again.info.seed == ours.info.seed
    np.testing.assert_array_equal(again.action, ours.action)
    assert bool(again.evaluate["success"][-1]) and bool(ours.evaluate["success"][-1])
    np.testing.assert_array_equal(again.evaluate["success"][1:], ours.evaluate["success"][1:])
    assert again.env_states.keys() == ours.env_states.keys()
    for name, values in ours.env_states.items():
        poses = again.env_states[name][:, :3], values[:, :3]
        np.testing.assert_allclose(*poses, atol=2e-3, err_msg=name)
    np.testing.assert_allclose(again.reward, ours.reward, atol=1e-2)
