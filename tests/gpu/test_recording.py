"""A recording of GPU simulation holds the env's values and is read like any other."""

# pyright: reportAttributeAccessIssue=false, reportArgumentType=false, reportOptionalSubscript=false
# pyright: reportOptionalMemberAccess=false

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from mani_skill.vector.wrappers.gymnasium import ManiSkillVectorEnv

import workbench
from tests.gpu.conftest import Simulation
from workbench.episodes.reader.read_episode import read_episode


def test_every_step_and_reward_is_in_the_file(tmp_path: Path, simulation: Simulation) -> None:
    env = workbench.make(
        "PushCube-v1", 3, backend=simulation, obs_mode="state", render_backend="none", max_episode_steps=5
    )
    env: Any = ManiSkillVectorEnv(workbench.Recorder(env, tmp_path), ignore_terminations=True)
    env.reset(seed=[7, 8, 9])
    rewards, cubes = [], [env.unwrapped.obj.pose.p.cpu().numpy()]
    for _ in range(4):
        rewards.append(env.step(env.action_space.sample())[1].cpu().numpy())
        cubes.append(env.unwrapped.obj.pose.p.cpu().numpy().copy())
    env.close()
    episodes = {e.info.env_index: e for e in map(read_episode, tmp_path.glob("*.json"))}
    assert sorted(episodes) == [0, 1, 2]
    for number, episode in episodes.items():
        assert episode.length == 4 and episode.info.seed == 7 + number
        assert ("gpu" in episode.info.backend) == (simulation == "gpu")
        np.testing.assert_allclose(episode.reward, np.array(rewards)[:, number], atol=1e-6)
        cube = episode.poses[:, list(episode.geometry.body_names).index("cube"), :3]
        np.testing.assert_allclose(cube, np.array(cubes)[:, number], atol=1e-5)
