"""A reward with named parts: lift a cube.

`info["reward_terms"]` holds each part of the reward, one number for each env. Whoever shows or logs
`info` can then tell which part a policy earns, and which it never gets. The parts add up to the
reward, since the reward is made by adding them up: the two cannot drift apart.

- a part opens the next one: `lift` is earned only while the cube is grasped;
- `calm` is a cost, at most as large as what a good step gains;
- success has a part of its own that fills up to the most, so that waiting before it pays nothing.
"""

from __future__ import annotations

from typing import Any

import sapien
import torch
from mani_skill.agents.robots import Panda
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils
from mani_skill.utils.building.ground import build_ground
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs import Pose

HALF_SIZE = 0.02
LIFTED = 0.1
"""Metres above where the cube lies."""
MOST = 5.0
"""The reward of a step in success."""


@register_env("WorkbenchRewardTerms-v1", max_episode_steps=60)
class RewardTermsEnv(BaseEnv):
    """Success: the hand holds the cube `LIFTED` above the ground."""

    SUPPORTED_ROBOTS = ["panda"]
    SUPPORTED_REWARD_MODES = ("normalized_dense", "dense", "sparse", "none")
    agent: Panda

    def __init__(self, *args: Any, robot_uids: str = "panda", **kwargs: Any):
        super().__init__(*args, robot_uids=robot_uids, **kwargs)

    def _load_agent(self, options: dict) -> None:
        super()._load_agent(options, sapien.Pose(p=[-0.615, 0, 0]))

    def _load_scene(self, options: dict) -> None:
        build_ground(self.scene)
        builder = self.scene.create_actor_builder()
        builder.add_box_collision(half_size=[HALF_SIZE] * 3)
        builder.add_box_visual(
            half_size=[HALF_SIZE] * 3, material=sapien.render.RenderMaterial(base_color=[0.9, 0.5, 0.1, 1])
        )
        builder.initial_pose = sapien.Pose(p=[0, 0, HALF_SIZE])
        self.cube = builder.build(name="cube")

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        pose = sapien_utils.look_at(eye=[0.4, 0.2, 0.5], target=[0, 0, 0.05])
        return [CameraConfig("base_camera", pose=pose, width=128, height=128, fov=0.9, near=0.01, far=10)]

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        with torch.device(self.device):
            b = len(env_idx)
            rest = torch.tensor(self.agent.keyframes["rest"].qpos, dtype=torch.float32)
            self.agent.reset(rest.repeat(b, 1))
            place = torch.zeros((b, 3))
            place[:, :2] = 0.2 * torch.rand((b, 2)) - 0.1
            place[:, 2] = HALF_SIZE
            self.cube.set_pose(Pose.create_from_pq(place))

    def evaluate(self) -> dict[str, torch.Tensor]:
        height = self.cube.pose.p[:, 2] - HALF_SIZE
        grasped = self.agent.is_grasping(self.cube)
        return {"success": grasped & (height > LIFTED), "grasped": grasped, "height": height}

    def _get_obs_extra(self, info: dict) -> dict[str, torch.Tensor]:
        obs = {"tcp_pose": self.agent.tcp.pose.raw_pose}
        if self.obs_mode_struct.use_state:
            obs["cube_pose"] = self.cube.pose.raw_pose
            obs["tcp_to_cube"] = self.cube.pose.p - self.agent.tcp.pose.p
        return obs

    def compute_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        grasped = info["grasped"].float()
        distance = torch.linalg.norm(self.cube.pose.p - self.agent.tcp.pose.p, dim=1)
        speed = torch.linalg.norm(self.agent.robot.get_qvel()[:, :-2], dim=1)
        terms = {
            "reach": 1 - torch.tanh(5 * distance),
            "grasp": grasped,
            "lift": grasped * (info["height"] / LIFTED).clamp(0, 1),
            "calm": -0.2 * torch.tanh(0.2 * speed),
        }
        so_far = torch.stack(list(terms.values())).sum(dim=0)
        terms["success"] = torch.where(info["success"], MOST - so_far, 0.0)
        info["reward_terms"] = terms
        return so_far + terms["success"]

    def compute_normalized_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        return self.compute_dense_reward(obs, action, info) / MOST


# ManiSkill takes lists and sapien.Pose where its annotations do not say so.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportOptionalMemberAccess=false
