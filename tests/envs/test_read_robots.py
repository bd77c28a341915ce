"""What is read of robots: the column of each joint among those of all articulations."""

from __future__ import annotations

from typing import Any

import numpy as np

from tests.drive.envs import batched
from workbench.envs import action_vector
from workbench.envs.read_robots import named_agents, read_robots
from workbench.envs.task_env import TaskEnv


def test_each_joint_of_two_robots_is_found_in_its_own_column() -> None:
    task = TaskEnv(batched("TwoRobotPickCube-v1", 2))
    env: Any = task.env
    task.reset(0)
    qpos = task.step(action_vector.random_action(task.parts, 2, np.random.default_rng(0))).qpos
    robots = read_robots(env)
    assert len(robots) == 2 and qpos is not None
    for robot, agent in zip(robots, named_agents(env).values(), strict=True):
        columns = [joint.column for joint in robot.joints]
        np.testing.assert_allclose(qpos[:, columns], agent.robot.get_qpos().numpy(), atol=1e-6)
        assert [joint.name for joint in robot.joints] == [one.name for one in agent.robot.active_joints]
    task.close()
