"""Push two blocks together. Something is wrong here: `workbench check` says what."""

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
TOGETHER = 0.05
"""Metres between the centres."""


@register_env("BrokenGatherBlocks-v1", max_episode_steps=50)
class GatherBlocksEnv(BaseEnv):
    """Success: the blocks lie side by side. Sparse reward only."""

    SUPPORTED_ROBOTS = ["panda"]
    SUPPORTED_REWARD_MODES = ("sparse", "none")
    agent: Panda

    def __init__(self, *args: Any, robot_uids: str = "panda", **kwargs: Any):
        super().__init__(*args, robot_uids=robot_uids, **kwargs)

    def _load_agent(self, options: dict) -> None:
        super()._load_agent(options, sapien.Pose(p=[-0.615, 0, 0]))

    def _load_scene(self, options: dict) -> None:
        build_ground(self.scene)
        builder = self.scene.create_actor_builder()
        builder.add_box_collision(half_size=[HALF_SIZE] * 3)
        builder.add_box_visual(half_size=[HALF_SIZE] * 3)
        builder.initial_pose = sapien.Pose(p=[0, -0.1, HALF_SIZE])
        self.left = builder.build(name="left")

        builder = self.scene.create_actor_builder()
        builder.add_box_collision(half_size=[HALF_SIZE] * 3)
        builder.add_box_visual(half_size=[HALF_SIZE] * 3)
        builder.inital_pose = sapien.Pose(p=[0, 0.1, HALF_SIZE])
        self.right = builder.build(name="right")

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        pose = sapien_utils.look_at(eye=[0.5, 0, 0.6], target=[0.05, 0, 0])
        return [CameraConfig("base_camera", pose=pose, width=128, height=128, fov=1.0, near=0.01, far=10)]

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        with torch.device(self.device):
            b = len(env_idx)
            self.agent.reset(torch.as_tensor(self.agent.keyframes["rest"].qpos).float())
            left = torch.zeros((b, 3))
            left[:, 0] = torch.rand(b) * 0.2 - 0.1
            left[:, 1] = -0.1
            left[:, 2] = HALF_SIZE
            right = left.clone()
            right[:, 1] = 0.05 + torch.rand(b) * 0.1
            self.left.set_pose(Pose.create_from_pq(p=left, q=[1, 0, 0, 0]))
            self.right.set_pose(Pose.create_from_pq(p=right, q=[1, 0, 0, 0]))

    def evaluate(self) -> dict[str, torch.Tensor]:
        apart = torch.linalg.norm(self.left.pose.p - self.right.pose.p, dim=1)
        return {"success": apart < TOGETHER, "apart": apart}

    def _get_obs_extra(self, info: dict) -> dict[str, torch.Tensor]:
        obs = {"tcp_pose": self.agent.tcp.pose.raw_pose}
        if self.obs_mode_struct.use_state:
            obs["left_pose"] = self.left.pose.raw_pose
            obs["right_pose"] = self.right.pose.raw_pose
        return obs


# ManiSkill takes lists and sapien.Pose where its annotations do not say so.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportOptionalMemberAccess=false
