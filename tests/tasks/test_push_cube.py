"""The tutorial's task is solvable, reports correct values, and is visible in its pictures."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch

from tests.drive.render_device import RENDER_BACKEND

Make = Callable[..., Any]


def scripted_push(env: Any, seed: int) -> tuple[dict, list[float]]:
    """Move behind the cube, down and forward with ``pd_ee_delta_pos``; return the last info and all rewards.

    One unit of an action is 0.1 m.
    """
    base = env.unwrapped
    _, info = env.reset(seed=seed)
    rewards: list[float] = []
    leg = 0
    for _ in range(50):
        tcp, cube, goal = base.agent.tcp.pose.p, base.cube.pose.p, base.goal.pose.p
        behind = cube + torch.tensor([-0.09, 0, 0])
        waypoints = [
            torch.cat([behind[:, :2], torch.full((1, 1), 0.15)], dim=1),
            torch.cat([behind[:, :2], torch.full((1, 1), 0.02)], dim=1),
            torch.cat([goal[:, :2], torch.full((1, 1), 0.02)], dim=1),
        ]
        if leg < 2 and torch.linalg.norm(waypoints[leg] - tcp) < 0.03:
            leg += 1
        move = ((waypoints[leg] - tcp) / 0.1).clamp(-1, 1)
        if leg == 2:
            move = move.clamp(-0.3, 0.3)
        closed = torch.full((1, 1), -1.0)
        _, reward, terminated, _, info = env.step(torch.cat([move, closed], dim=1))
        rewards.append(float(reward))
        if terminated.any():
            break
    return info, rewards


def test_a_scripted_push_succeeds_on_every_seed(make: Make) -> None:
    env = make("push_cube", control_mode="pd_ee_delta_pos")
    for seed in range(3):
        info, rewards = scripted_push(env, seed)
        assert info["success"].all() and info["cube_to_goal"] < 0.1
        assert rewards[-1] == 1.0
        assert max(rewards[:-1]) < 0.9 and min(rewards) >= 0
        # A dense reward rises in most steps.
        better = [later > earlier for earlier, later in zip(rewards, rewards[1:], strict=False)]
        assert sum(better) > 0.8 * len(better)


def test_a_cube_that_fell_off_the_table_fails_and_earns_nothing(make: Make) -> None:
    env = make("push_cube", control_mode="pd_joint_delta_pos")
    base = env.unwrapped
    env.reset(seed=0)
    pose = base.cube.pose.raw_pose.clone()
    pose[:, :3] = torch.tensor([0.8, 0, 0.02])
    base.cube.set_pose(type(base.cube.pose).create(pose))
    for _ in range(30):
        _, reward, terminated, _, info = env.step(torch.zeros(env.action_space.shape))
    assert info["fail"].all() and not info["success"].any()
    assert terminated.all() and reward == 0
    assert info["cube_height"] < -0.1


def test_evaluate_agrees_with_the_poses(make: Make) -> None:
    env = make("push_cube")
    _, info = env.reset(seed=5)
    cube, goal = env.unwrapped.cube.pose.p, env.unwrapped.goal.pose.p
    torch.testing.assert_close(goal[:, :2] - cube[:, :2], torch.tensor([[0.2, 0.0]]))
    torch.testing.assert_close(info["cube_to_goal"], torch.tensor([0.2]))
    assert (cube[:, :2].abs() <= 0.1).all()
    torch.testing.assert_close(info["cube_height"], torch.zeros(1), atol=1e-4, rtol=0)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_sensor_camera_sees_cube_and_goal_and_no_background(
    seed: int, make: Make, renderer: None
) -> None:
    env = make("push_cube", render_backend=RENDER_BACKEND, obs_mode="rgb+depth+segmentation")
    obs, _ = env.reset(seed=seed)
    data = {name: picture.cpu() for name, picture in obs["sensor_data"]["base_camera"].items()}
    base = env.unwrapped
    for actor, pixels in ((base.cube, 20), (base.goal, 300)):
        seen = data["segmentation"] == actor.per_scene_id.reshape(-1, 1, 1, 1)
        assert seen.sum() > pixels
    depth = data["depth"]
    assert 0 < depth.min() and depth.max() < 1500, "depth in millimetres, where 0 means background"
    blue = data["rgb"][(data["segmentation"] == base.cube.per_scene_id.reshape(-1, 1, 1, 1))[..., 0]].float()
    assert (blue[:, 2] > blue[:, 0] + 40).all()
