"""Point the hand along an arrow: a small task with one mistake to find and to fix.

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

NEAR = 0.03
"""Metres."""


@register_env("BrokenMatchArrow-v1", max_episode_steps=50)
class MatchArrowEnv(BaseEnv):
    """Bring the hand to the arrow, and turn it so that its x axis lies along it."""

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
        builder.add_box_visual(
            half_size=[0.06, 0.01, 0.01],
            material=sapien.render.RenderMaterial(base_color=[0.1, 0.6, 0.3, 1]),
        )
        builder.initial_pose = sapien.Pose(p=[0, 0, 0.3])
        self.arrow = builder.build_kinematic(name="arrow")

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        with torch.device(self.device):
            b = len(env_idx)
            self.table_scene.initialize(env_idx)
            p = torch.rand((b, 3)) * 0.2 - 0.1
            p[:, 2] += 0.3
            # Level, and turned about the vertical by up to an eighth to either side.
            half = (torch.rand(b) - 0.5) * torch.pi / 4
            q = torch.zeros((b, 4))
            q[:, 2], q[:, 3] = torch.sin(half), torch.cos(half)
            self.arrow.set_pose(Pose.create_from_pq(p=p, q=q))

    def evaluate(self) -> dict[str, torch.Tensor]:
        distance = torch.linalg.norm(self.arrow.pose.p - self.agent.tcp.pose.p, dim=1)
        arrow = self.arrow.pose.to_transformation_matrix()[:, :3, 0]
        hand = self.agent.tcp.pose.to_transformation_matrix()[:, :3, 0]
        along = (arrow * hand).sum(dim=1).abs()
        return {"success": (distance < NEAR) & (along > 0.98), "tcp_to_arrow": distance, "along": along}

    def _get_obs_extra(self, info: dict) -> dict[str, torch.Tensor]:
        return {"tcp_pose": self.agent.tcp.pose.raw_pose, "arrow_pose": self.arrow.pose.raw_pose}

    def compute_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        reward = 1 - torch.tanh(5 * info["tcp_to_arrow"]) + info["along"]
        return torch.where(info["success"], 3.0, reward)

    def compute_normalized_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        return self.compute_dense_reward(obs, action, info) / 3


# ManiSkill takes lists and sapien.Pose where its annotations do not say so.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportOptionalMemberAccess=false
