"""Tip the block over. Something is wrong here: `workbench check` says what."""

from __future__ import annotations

from typing import Any

import sapien
import torch
from mani_skill.agents.robots import Panda
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils
from mani_skill.utils.building.ground import build_ground
from mani_skill.utils.geometry.rotation_conversions import quaternion_to_matrix
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs import Pose

HALF_SIZE = [0.02, 0.02, 0.05]


@register_env("BrokenTipBlock-v1", max_episode_steps=50)
class TipBlockEnv(BaseEnv):
    """Success: the block lies on its side and rests. Sparse reward only."""

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
        builder.add_box_collision(half_size=HALF_SIZE)
        builder.add_box_visual(half_size=HALF_SIZE)
        builder.initial_pose = sapien.Pose(p=[0, 0, HALF_SIZE[2]])
        self.block = builder.build(name="block")

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        pose = sapien_utils.look_at(eye=[0.5, 0, 0.6], target=[0.05, 0, 0])
        return [CameraConfig("base_camera", pose=pose, width=128, height=128, fov=1.0, near=0.01, far=10)]

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        with torch.device(self.device):
            b = len(env_idx)
            self.agent.reset(torch.as_tensor(self.agent.keyframes["rest"].qpos).float())
            block = torch.zeros((b, 3))
            block[:, :2] = torch.rand((b, 2)) * 0.2 - 0.1
            block[:, 2] = HALF_SIZE[2]
            self.block.set_pose(Pose.create_from_pq(p=block, q=[1, 0, 0, 0]))

    def evaluate(self) -> dict[str, torch.Tensor]:
        upright = quaternion_to_matrix(self.block.pose.q)[:, 2, 2]
        speed = torch.linalg.norm(self.block.linear_velocity, dim=1)
        tipped = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)
        for i in range(self.num_envs):
            tipped[i] = (upright[i] < 0.3) & (speed[i] < 0.05)
        return {"success": tipped, "upright": upright}

    def _get_obs_extra(self, info: dict) -> dict[str, torch.Tensor]:
        obs = {"tcp_pose": self.agent.tcp.pose.raw_pose}
        if self.obs_mode_struct.use_state:
            obs["block_pose"] = self.block.pose.raw_pose
        return obs


# ManiSkill takes lists and sapien.Pose where its annotations do not say so.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportOptionalMemberAccess=false
