"""Fail conditions: push a glass to the red end of a board, without tipping it and without pushing it off.

`evaluate` may return `fail` beside `success`; both end the episode. Three things are worth knowing:

- each reason has an entry of its own, so that a curve or a log says which of them happens;
- success and fail are never true together: what has failed has not succeeded;
- fail is for what cannot be fixed. A hand that is only far away is no failure.

The sparse reward is +1 at success and -1 at failure, and needs no code.
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
from mani_skill.utils.geometry.rotation_conversions import quaternion_to_matrix
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs import Pose
from transforms3d.euler import euler2quat

BOARD = [0.2, 0.15, 0.02]
"""Half sizes, metres."""
GOAL_X = 0.1
"""From here to the far end the board is red."""
RADIUS, HALF_HEIGHT = 0.025, 0.05
STANDING = 2 * BOARD[2] + HALF_HEIGHT
"""Height of the glass's middle."""


@register_env("WorkbenchFailConditions-v1", max_episode_steps=80)
class FailConditionsEnv(BaseEnv):
    """Success: the glass stands on the red end. Fail: it has tipped over, or is off the board."""

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
        builder.add_box_collision(half_size=BOARD)
        builder.add_box_visual(
            half_size=BOARD, material=sapien.render.RenderMaterial(base_color=[0.7, 0.55, 0.4, 1])
        )
        end = (BOARD[0] - GOAL_X) / 2
        builder.add_box_visual(
            pose=sapien.Pose(p=[GOAL_X + end, 0, BOARD[2]]),
            half_size=[end, BOARD[1], 0.001],
            material=sapien.render.RenderMaterial(base_color=[0.8, 0.1, 0.1, 1]),
        )
        builder.initial_pose = sapien.Pose(p=[0, 0, BOARD[2]])
        builder.build_static(name="board")

        upright = sapien.Pose(q=euler2quat(0, np.pi / 2, 0))  # a cylinder's axis is x
        builder = self.scene.create_actor_builder()
        builder.add_cylinder_collision(pose=upright, radius=RADIUS, half_length=HALF_HEIGHT)
        builder.add_cylinder_visual(
            pose=upright,
            radius=RADIUS,
            half_length=HALF_HEIGHT,
            material=sapien.render.RenderMaterial(base_color=[0.2, 0.6, 0.8, 1]),
        )
        builder.initial_pose = sapien.Pose(p=[0, 0, STANDING])
        self.glass = builder.build(name="glass")

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        pose = sapien_utils.look_at(eye=[0.55, 0.3, 0.6], target=[0, 0, 0.1])
        return [CameraConfig("base_camera", pose=pose, width=128, height=128, fov=0.9, near=0.01, far=10)]

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        with torch.device(self.device):
            b = len(env_idx)
            rest = torch.tensor(self.agent.keyframes["rest"].qpos, dtype=torch.float32)
            self.agent.reset(rest.repeat(b, 1))
            place = torch.zeros((b, 3))
            place[:, 0] = -0.1 + 0.1 * torch.rand(b)
            place[:, 1] = 0.2 * torch.rand(b) - 0.1
            place[:, 2] = STANDING
            self.glass.set_pose(Pose.create_from_pq(place))

    def evaluate(self) -> dict[str, torch.Tensor]:
        place = self.glass.pose.p
        # The third column of the matrix is the glass's own z axis; its z is 1 while it stands.
        upright = quaternion_to_matrix(self.glass.pose.q)[:, 2, 2]
        tipped = upright < 0.5
        off_board = (place[:, 0].abs() > BOARD[0]) | (place[:, 1].abs() > BOARD[1])
        fail = tipped | off_board
        return {
            "success": (place[:, 0] > GOAL_X + RADIUS) & (upright > 0.95) & ~fail,
            "fail": fail,
            "tipped": tipped,
            "off_board": off_board,
        }

    def _get_obs_extra(self, info: dict) -> dict[str, torch.Tensor]:
        obs = {"tcp_pose": self.agent.tcp.pose.raw_pose}
        if self.obs_mode_struct.use_state:
            obs["glass_pose"] = self.glass.pose.raw_pose
        return obs


# ManiSkill takes lists and sapien.Pose where its annotations do not say so.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportOptionalMemberAccess=false
