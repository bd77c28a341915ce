"""Reach a marker on a short way: a small task with one mistake to find and to fix.

Something is wrong here: workbench check says what.
"""

from __future__ import annotations

from typing import Any

import sapien
import torch
from mani_skill.agents.robots import Panda
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils
from mani_skill.utils.registration import register_env
from mani_skill.utils.scene_builder.table import TableSceneBuilder
from mani_skill.utils.structs import Pose

RADIUS = 0.03
LONGEST_WAY = 3.0
"""Metres."""


@register_env("BrokenCalmReach-v1", max_episode_steps=50)
class CalmReachEnv(BaseEnv):
    """Bring the hand into the marker, and do not wave it about."""

    SUPPORTED_ROBOTS = ["panda"]
    SUPPORTED_REWARD_MODES = ("normalized_dense", "dense", "sparse", "none")
    agent: Panda

    def __init__(self, *args: Any, robot_uids: str = "panda", **kwargs: Any):
        super().__init__(*args, robot_uids=robot_uids, **kwargs)

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        pose = sapien_utils.look_at(eye=[0.9, 0, 0.7], target=[0, 0, 0.35])
        return [CameraConfig("base_camera", pose=pose, width=128, height=128, fov=1.0, near=0.01, far=10)]

    @property
    def _default_human_render_camera_configs(self) -> list[CameraConfig]:
        pose = sapien_utils.look_at(eye=[0.7, 0.7, 0.6], target=[0.0, 0.0, 0.2])
        return [CameraConfig("render_camera", pose=pose, width=512, height=512, fov=1.0, near=0.01, far=100)]

    def _load_agent(self, options: dict) -> None:
        super()._load_agent(options, sapien.Pose(p=[-0.615, 0, 0]))

    def _load_scene(self, options: dict) -> None:
        self.table_scene = TableSceneBuilder(self, robot_init_qpos_noise=0.02)
        self.table_scene.build()
        builder = self.scene.create_actor_builder()
        builder.add_sphere_visual(
            radius=RADIUS, material=sapien.render.RenderMaterial(base_color=[0.1, 0.3, 0.9, 1])
        )
        builder.initial_pose = sapien.Pose(p=[0, 0, 0.3])
        self.goal = builder.build_kinematic(name="goal")

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        with torch.device(self.device):
            b = len(env_idx)
            self.table_scene.initialize(env_idx)
            goal = torch.rand((b, 3)) * 0.2 - 0.1
            goal[:, 2] += 0.4
            self.goal.set_pose(Pose.create_from_pq(p=goal, q=[1, 0, 0, 0]))
            # Metres that the hand has gone in this episode.
            self.travelled = torch.zeros(self.num_envs)

    def _after_control_step(self) -> None:
        if self.gpu_sim_enabled:
            self.scene._gpu_fetch_all()
        self.travelled += torch.linalg.norm(self.agent.tcp.linear_velocity, dim=1) * self.control_timestep

    def evaluate(self) -> dict[str, torch.Tensor]:
        distance = torch.linalg.norm(self.goal.pose.p - self.agent.tcp.pose.p, dim=1)
        return {
            "success": distance < RADIUS,
            "fail": self.travelled > LONGEST_WAY,
            "tcp_to_goal": distance,
            "travelled": self.travelled.clone(),
        }

    def _get_obs_extra(self, info: dict) -> dict[str, torch.Tensor]:
        return {
            "tcp_pose": self.agent.tcp.pose.raw_pose,
            "goal_pos": self.goal.pose.p,
            "travelled": info["travelled"],
        }

    def compute_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        reward = 1 - torch.tanh(5 * info["tcp_to_goal"])
        reward[info["success"]] = 2
        return reward

    def compute_normalized_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        return self.compute_dense_reward(obs, action, info) / 2


# ManiSkill takes lists and sapien.Pose where its annotations do not say so.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportOptionalMemberAccess=false
