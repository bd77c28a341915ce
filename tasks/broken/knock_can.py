"""Knock over a can: a small task with one mistake to find and to fix.

Something is wrong here: workbench check says what.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import sapien
import torch
from mani_skill.agents.robots import Panda
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils
from mani_skill.utils.registration import register_env
from mani_skill.utils.scene_builder.table import TableSceneBuilder
from mani_skill.utils.structs import Pose

RADIUS, HALF_HEIGHT = 0.03, 0.06


@register_env("BrokenKnockCan-v1", max_episode_steps=50)
class KnockCanEnv(BaseEnv):
    """Knock over the can that stands on the table."""

    SUPPORTED_ROBOTS = ["panda"]
    SUPPORTED_REWARD_MODES = ("normalized_dense", "dense", "sparse", "none")
    agent: Panda

    def __init__(self, *args: Any, robot_uids: str = "panda", **kwargs: Any):
        super().__init__(*args, robot_uids=robot_uids, **kwargs)

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        pose = sapien_utils.look_at(eye=[0.45, 0, 0.6], target=[0.08, 0, 0])
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
        upright = sapien.Pose(q=[0.7071068, 0, 0.7071068, 0])  # a cylinder's axis is its x axis
        builder.add_cylinder_collision(pose=upright, radius=RADIUS, half_length=HALF_HEIGHT)
        builder.add_cylinder_visual(
            pose=upright,
            radius=RADIUS,
            half_length=HALF_HEIGHT,
            material=sapien.render.RenderMaterial(base_color=[0.8, 0.1, 0.1, 1]),
        )
        builder.initial_pose = sapien.Pose(p=[0, 0, HALF_HEIGHT])
        self.can = builder.build(name="can")

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        with torch.device(self.device):
            b = len(env_idx)
            self.table_scene.initialize(env_idx)
            can = torch.zeros((b, 3))
            can[:, :2] = torch.tensor(np.random.uniform(-0.08, 0.08, (b, 2)))
            can[:, 2] = HALF_HEIGHT
            self.can.set_pose(Pose.create_from_pq(p=can, q=[1, 0, 0, 0]))

    def evaluate(self) -> dict[str, torch.Tensor]:
        upward = self.can.pose.to_transformation_matrix()[:, 2, 2]
        return {"success": upward < 0.5, "upward": upward}

    def _get_obs_extra(self, info: dict) -> dict[str, torch.Tensor]:
        obs = {"tcp_pose": self.agent.tcp.pose.raw_pose}
        if self.obs_mode_struct.use_state:
            obs["can_pose"] = self.can.pose.raw_pose
        return obs

    def compute_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        distance = torch.linalg.norm(self.can.pose.p - self.agent.tcp.pose.p, dim=1)
        reward = 1 - torch.tanh(5 * distance) + (1 - info["upward"]).clamp(0, 1)
        return torch.where(info["success"], 3.0, reward)

    def compute_normalized_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        return self.compute_dense_reward(obs, action, info) / 3


# ManiSkill takes lists and sapien.Pose where its annotations do not say so.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportOptionalMemberAccess=false
