"""The batched CPU core against ManiSkill's own single CPU env, as the reference."""

# ManiSkill annotates an env's members as the widest thing they may be in any task.
# pyright: reportAttributeAccessIssue=false, reportArgumentType=false, reportCallIssue=false
# pyright: reportOptionalMemberAccess=false, reportIndexIssue=false, reportOptionalSubscript=false

from __future__ import annotations

from collections.abc import Iterator

import mani_skill.envs  # noqa: F401  registers the ids
import numpy as np
import pytest
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils.registration import REGISTERED_ENVS
from mani_skill.utils.structs.pose import Pose

from workbench.core.env.cpu_scene import batched_class
from workbench.core.rules import Degree

STATE_ONLY = {"obs_mode": "state", "render_backend": "none"}


def batched(env_id: str, num_envs: int, rules: Degree | None = None) -> BaseEnv:
    return batched_class(REGISTERED_ENVS[env_id].cls, rules=rules)(num_envs=num_envs, **STATE_ONLY)


@pytest.fixture(scope="module")
def pick_cubes() -> Iterator[BaseEnv]:
    env = batched("PickCube-v1", 4)
    yield env
    env.close()


def test_link_velocities_are_those_of_the_links(pick_cubes: BaseEnv) -> None:
    pick_cubes.reset(seed=[0, 1, 2, 3])
    for _ in range(5):
        pick_cubes.step(pick_cubes.action_space.sample())
    for link in pick_cubes.agent.robot.links:
        expected = torch.tensor(np.array([body.linear_velocity for body in link._bodies]))
        assert torch.equal(link.linear_velocity, expected)


@pytest.mark.filterwarnings("ignore:The pose of link")
@pytest.mark.parametrize("rules", ["off", None])
def test_a_root_that_was_set_stays_set_when_the_velocity_of_a_link_is_read_before_it_is_applied(
    rules: Degree | None,
) -> None:
    env = batched("PickCube-v1", 2, rules)
    env.reset(seed=[0, 1])
    env.step(env.action_space.sample())
    robot, wanted = env.agent.robot, env.agent.robot.pose.raw_pose.clone()
    wanted[:, 0] -= 0.1
    fast = torch.full((2, 3), 0.5)
    robot.set_pose(Pose.create(wanted))
    robot.set_root_linear_velocity(fast)
    assert robot.links[3].linear_velocity.shape == (2, 3)
    assert torch.equal(robot.root_linear_velocity, fast)
    env.scene._gpu_apply_all()
    assert np.allclose([a.root_pose.p for a in robot._objs], wanted[:, :3], atol=1e-6)
    env.scene.px.gpu_update_articulation_kinematics()
    env.scene._gpu_fetch_all()
    assert torch.allclose(robot.pose.raw_pose, wanted, atol=1e-6)
    env.close()


def test_a_pose_with_nan_is_refused_with_the_name_of_the_body(pick_cubes: BaseEnv) -> None:
    pick_cubes.reset(seed=[0, 1, 2, 3])
    state = pick_cubes.get_state_dict()
    state["actors"]["cube"][1, 0] = float("nan")
    with pytest.raises(ValueError, match="cube"):
        pick_cubes.set_state_dict(state)
    pick_cubes.scene._needs_fetch = False
    pick_cubes.scene._gpu_fetch_all()


def test_a_velocity_of_what_the_task_moves_itself_is_not_given_to_physx(pick_cubes: BaseEnv) -> None:
    pick_cubes.reset(seed=[0, 1, 2, 3])
    for actor in (pick_cubes.goal_site, pick_cubes.cube):
        actor.set_linear_velocity(torch.full((4, 3), 0.5))
    pick_cubes.scene._gpu_apply_all()
    assert not any(body.linear_velocity.any() for body in pick_cubes.goal_site._bodies)
    assert all((body.linear_velocity == 0.5).all() for body in pick_cubes.cube._bodies)


def test_every_env_has_its_own_ground() -> None:
    class DropsACube(REGISTERED_ENVS["PickCube-v1"].cls):
        """The cube falls beside the table, onto the floor that the table scene builds 0.92 m below."""

        def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
            super()._initialize_episode(env_idx, options)
            pose = self.cube.pose.raw_pose.clone()
            pose[:, :3] = torch.tensor([-2.0, 0.0, -0.7])
            self.cube.set_pose(Pose.create(pose[env_idx]))

    env = batched_class(DropsACube)(num_envs=3, **STATE_ONLY)
    env.reset(seed=[0, 1, 2])
    for _ in range(20):
        env.step(np.zeros((3, 8), np.float32))
    heights = env.cube.pose.p[:, 2]
    assert torch.allclose(heights, heights[:1]), heights
    assert float(heights.min()) > -0.95, "fell through the floor"
    env.close()
