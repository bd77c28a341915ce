"""Slide a block over a line: a small task with one mistake to find and to fix.

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

HALF_SIZE = [0.03, 0.03, 0.02]
LINE = 0.25
"""Metres along x from the middle of the table."""


@register_env("BrokenSlideBlock-v1", max_episode_steps=50)
class SlideBlockEnv(BaseEnv):
    """Slide the block forward until its middle is over the line."""

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
        builder.add_box_collision(half_size=HALF_SIZE)
        builder.add_box_visual(
            half_size=HALF_SIZE, material=sapien.render.RenderMaterial(base_color=[0.8, 0.5, 0.1, 1])
        )
        builder.initial_pose = sapien.Pose(p=[0, 0, HALF_SIZE[2]])
        self.block = builder.build(name="block")

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        with torch.device(self.device):
            b = len(env_idx)
            self.table_scene.initialize(env_idx)
            block = torch.zeros((b, 3))
            block[:, :2] = (2 * torch.rand((b, 2)) - 1) * 0.08
            block[:, 2] = HALF_SIZE[2] / 2
            self.block.set_pose(Pose.create_from_pq(p=block, q=[1, 0, 0, 0]))

    def evaluate(self) -> dict[str, torch.Tensor]:
        to_line = (LINE - self.block.pose.p[:, 0]).clamp(min=0)
        return {"success": to_line == 0, "fail": self.block.pose.p[:, 2] < -0.1, "to_line": to_line}

    def _get_obs_extra(self, info: dict) -> dict[str, torch.Tensor]:
        obs = {"tcp_pose": self.agent.tcp.pose.raw_pose}
        if self.obs_mode_struct.use_state:
            obs["block_pose"] = self.block.pose.raw_pose
        return obs

    def compute_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        behind = self.block.pose.p.clone()
        behind[:, 0] -= HALF_SIZE[0] + 0.005
        distance = torch.linalg.norm(behind - self.agent.tcp.pose.p, dim=1)
        reward = 2 - torch.tanh(5 * distance) - torch.tanh(5 * info["to_line"])
        return torch.where(info["success"], 3.0, reward)

    def compute_normalized_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        return self.compute_dense_reward(obs, action, info) / 3


# ManiSkill takes lists and sapien.Pose where its annotations do not say so.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportOptionalMemberAccess=false
