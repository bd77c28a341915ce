"""Roll the ball over the line. Something is wrong here: `workbench check` says what."""

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

RADIUS = 0.03
LINE = 0.25
"""Metres, along x."""


@register_env("BrokenNudgeBall-v1", max_episode_steps=50)
class NudgeBallEnv(BaseEnv):
    """Success: the ball is behind the line. Reward: up to 1 for a gripper at the ball, 2 for success."""

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
        builder.add_sphere_collision(radius=RADIUS)
        builder.add_sphere_visual(radius=RADIUS)
        builder.initial_pose = sapien.Pose(p=[0, 0, RADIUS])
        self.ball = builder.build(name="ball")

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        pose = sapien_utils.look_at(eye=[0.5, 0, 0.6], target=[0.05, 0, 0])
        return [CameraConfig("base_camera", pose=pose, width=128, height=128, fov=1.0, near=0.01, far=10)]

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        with torch.device(self.device):
            b = len(env_idx)
            self.agent.reset(torch.as_tensor(self.agent.keyframes["rest"].qpos).float())
            ball = torch.zeros((b, 3))
            ball[:, :2] = torch.rand((b, 2)) * 0.2 - 0.1
            ball[:, 2] = RADIUS
            self.ball.set_pose(Pose.create_from_pq(p=ball, q=[1, 0, 0, 0]))

    def evaluate(self) -> dict[str, torch.Tensor]:
        return {"success": self.ball.pose.p[:, 0] > LINE}

    def _get_obs_extra(self, info: dict) -> dict[str, torch.Tensor]:
        obs = {"tcp_pose": self.agent.tcp.pose.raw_pose}
        if self.obs_mode_struct.use_state:
            obs["ball_pose"] = self.ball.pose.raw_pose
        return obs

    def compute_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        distance = torch.linalg.norm(self.ball.pose.p - self.agent.tcp.pose.p, dim=1)
        near = [1 - min(each.item(), 1) for each in distance]
        reward = torch.tensor(near, device=self.device)
        reward[info["success"]] = 2
        return reward

    def compute_normalized_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        return self.compute_dense_reward(obs, action, info) / 2


# ManiSkill takes lists and sapien.Pose where its annotations do not say so.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportOptionalMemberAccess=false
