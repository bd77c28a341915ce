"""The walking robot's failure condition."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from mani_skill.utils.structs import Pose

Make = Callable[..., Any]


def test_a_robot_fails_on_its_back_but_not_while_it_stands(make: Make) -> None:
    env = make("locomotion")
    env.reset(seed=0)
    for _ in range(40):
        *_, terminated, _, info = env.step(torch.zeros(env.action_space.shape))
        assert not terminated.any()
    assert info["upright"] > 0.9 and "success" not in info
    robot = env.unwrapped.agent.robot
    robot.set_pose(Pose.create_from_pq(p=torch.tensor([[0, 0, 2.0]]), q=torch.tensor([[0, 1.0, 0, 0]])))
    *_, terminated, _, info = env.step(torch.zeros(env.action_space.shape))
    assert info["fail"].all() and terminated.all()
