"""Cameras: one in the hand, a stereo pair, and one that hangs a little differently in each env.

    env = gym.make("WorkbenchCameras-v1", obs_mode="rgb+depth")     # after importing this file

- `mount` fixes a camera to a link; its pose is then relative to that link. A camera looks along its
  x axis, and the hand's fingers point along the hand's z;
- a stereo pair is two cameras of one direction, apart along their own y axis. `look_at` twice on one
  target would turn them towards each other;
- a pose with one row for each env randomises a camera. Cameras are made when the scene is built, so
  its numbers come from `self._batched_episode_rng`, as those of objects do.

Small pictures: each step of each env renders all of them.
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
from mani_skill.utils.building.ground import build_ground
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs import Pose
from transforms3d.euler import euler2quat

HALF_SIZE = 0.03
BASELINE = 0.06
"""Metres between the eyes of the stereo pair."""
LOOSE = 0.05
"""The loose camera hangs up to this far from its place, along each axis, in metres."""


@register_env("WorkbenchCameras-v1", max_episode_steps=50)
class CamerasEnv(BaseEnv):
    """Success: the hand is at the block."""

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
        builder.add_box_visual(
            half_size=[HALF_SIZE] * 3, material=sapien.render.RenderMaterial(base_color=[0.6, 0.1, 0.5, 1])
        )
        builder.initial_pose = sapien.Pose(p=[0, 0, HALF_SIZE])
        self.block = builder.build(name="block")

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        lens = {"width": 128, "height": 128, "near": 0.01, "far": 10}

        # Beside the hand, turned so that its x axis is the hand's z axis.
        in_hand = CameraConfig(
            "hand_camera",
            pose=sapien.Pose(p=[0.07, 0, 0], q=euler2quat(0, -np.pi / 2, 0)),
            mount=self.agent.robot.links_map["panda_hand"],
            fov=1.4,
            **lens,
        )

        middle = sapien_utils.look_at(eye=[0.5, 0, 0.5], target=[0, 0, 0.02]).sp
        eyes = [
            CameraConfig(name, pose=middle * sapien.Pose(p=[0, offset, 0]), fov=0.9, **lens)
            for name, offset in (("left_eye", BASELINE / 2), ("right_eye", -BASELINE / 2))
        ]

        # (num_envs, 3) each: where it hangs, and what it looks at.
        shift = torch.as_tensor(self._batched_episode_rng.uniform(-LOOSE, LOOSE, size=3), dtype=torch.float32)
        eye = torch.tensor([0.1, 0.6, 0.5]) + shift
        pose = sapien_utils.look_at(eye=eye, target=torch.tensor([0, 0, 0.02]).expand_as(eye))
        loose = CameraConfig("loose_camera", pose=pose, fov=0.9, **lens)
        return [in_hand, *eyes, loose]

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        with torch.device(self.device):
            b = len(env_idx)
            rest = torch.tensor(self.agent.keyframes["rest"].qpos, dtype=torch.float32)
            self.agent.reset(rest.repeat(b, 1))
            place = torch.zeros((b, 3))
            place[:, :2] = 0.2 * torch.rand((b, 2)) - 0.1
            place[:, 2] = HALF_SIZE
            self.block.set_pose(Pose.create_from_pq(place))

    def evaluate(self) -> dict[str, torch.Tensor]:
        distance = torch.linalg.norm(self.block.pose.p - self.agent.tcp.pose.p, dim=1)
        return {"success": distance < 0.04, "distance": distance}

    def _get_obs_extra(self, info: dict) -> dict[str, torch.Tensor]:
        obs = {"tcp_pose": self.agent.tcp.pose.raw_pose}
        if self.obs_mode_struct.use_state:  # in visual modes the cameras tell where the block is
            obs["block_pose"] = self.block.pose.raw_pose
        return obs


# ManiSkill takes lists and sapien.Pose where its annotations do not say so.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportOptionalMemberAccess=false
