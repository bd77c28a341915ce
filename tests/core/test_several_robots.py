"""Tasks with several robots: actions, states and grippers of each, against stock single envs."""

# ManiSkill annotates an env's members as the widest thing they may be, and vectors as tuples.
# pyright: reportAttributeAccessIssue=false, reportOptionalMemberAccess=false, reportArgumentType=false
# pyright: reportOptionalIterable=false

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from mani_skill.utils.registration import REGISTERED_ENVS

from tests.core.stock_env import batch_of, put_in_same_state, single

N = 3


@pytest.mark.parametrize(
    "env_id", ["TwoRobotPickCube-v1", pytest.param("TwoRobotStackCube-v1", marks=pytest.mark.slow)]
)
def test_each_robot_follows_its_own_actions_as_in_a_stock_env(env_id: str) -> None:
    task: Any = REGISTERED_ENVS[env_id].cls
    batch = batch_of(task, N)
    stocks = [single(task) for _ in range(N)]
    batch.reset(seed=[0, 1, 2])
    for env, stock in enumerate(stocks):
        stock.reset(seed=env)
        put_in_same_state(stock, batch, env)
    assert isinstance(batch.single_action_space, gym.spaces.Dict)
    names = list(batch.single_action_space)
    assert len(names) == 2
    rng = np.random.default_rng(0)
    for step in range(15):
        action = {
            name: rng.uniform(-1, 1, (N, *batch.single_action_space[name].shape)).astype(np.float32)
            for name in names
        }
        # The second robot of env 1 is told to stand still: only its own row of its own action may matter.
        action[names[1]][1] = 0
        batch.step(action)
        for env, stock in enumerate(stocks):
            stock.step({name: value[env : env + 1] for name, value in action.items()})
            assert batch.scene.px.systems[env].pack() == stock.scene.px.pack(), f"env {env}, step {step}"
            for ours, theirs in zip(batch.agent.agents, stock.agent.agents):
                assert torch.equal(ours.tcp.pose.raw_pose[env], theirs.tcp.pose.raw_pose[0])
                assert torch.equal(ours.is_static(0.2)[env], theirs.is_static(0.2)[0])
    first, second = batch.agent.agents
    assert not torch.allclose(first.robot.get_qpos(), second.robot.get_qpos(), atol=1e-2)
    for env in (batch, *stocks):
        env.close()


def test_a_partial_reset_returns_both_robots_of_an_env_to_their_places() -> None:
    env = batch_of(REGISTERED_ENVS["TwoRobotPickCube-v1"].cls, N)
    env.reset(seed=[0, 1, 2])
    for _ in range(5):
        env.step(env.action_space.sample())
    before = [agent.robot.get_qpos().clone() for agent in env.agent.agents]
    env.reset(options={"env_idx": torch.tensor([1])})
    for agent, qpos in zip(env.agent.agents, before):
        assert torch.equal(agent.robot.get_qpos()[[0, 2]], qpos[[0, 2]])
        assert not torch.allclose(agent.robot.get_qpos()[1], qpos[1], atol=1e-3)
    env.close()
