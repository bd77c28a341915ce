"""Locomotion: a four-legged robot walks along the world's x axis, at a given speed.

A robot that walks is not fixed to the ground. What differs from a task for an arm:

- where its body is belongs to the episode, and the reset sets it (`set_pose`) beside the joints;
- the observation has height, directions and velocities, and neither x nor y: the ground is the same
  everywhere, and what is learnt for one place should hold for the next;
- there is no success: walking is never done. Each step is rewarded for its speed, and most at `SPEED`;
- a robot on its back ends the episode: `fail`. Otherwise most steps that a policy learns from are lying
  there. An upright step earns more than it can cost, or it would pay to fall early;
- a camera that is mounted on the body goes with it.

To change: `SPEED`, or a speed for each env that is drawn at the reset (`task_state.py` shows how to keep
it). Or the robot: "humanoid" and "unitree_g1_simplified_legs" come with ManiSkill too, "anymal_c" and
"unitree_go2_simplified_locomotion" are downloads. Each has keyframes and links of its own.
"""

from __future__ import annotations

from typing import Any

import sapien
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.envs.tasks.control.ant import AntRobot
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils
from mani_skill.utils.building.ground import build_ground
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs import Link, Pose
from mani_skill.utils.structs.types import SimConfig

SPEED = 0.5
"""Metres a second."""
CLOSE = 0.25
"""A speed that differs by this much from `SPEED` earns a third of what `SPEED` earns."""
MOST = 1.2
"""The reward of a perfect step."""


@register_env("WorkbenchLocomotion-v1", max_episode_steps=200)
class LocomotionEnv(BaseEnv):
    """Fail: the robot lies on its back. There is no success."""

    SUPPORTED_ROBOTS = [AntRobot]  # type: ignore[assignment]
    SUPPORTED_REWARD_MODES = ("normalized_dense", "dense", "none")
    agent: AntRobot

    # The ant has no name that can be asked for: it is given as its class.
    def __init__(self, *args: Any, robot_uids: str | type[AntRobot] = AntRobot, **kwargs: Any):
        super().__init__(*args, robot_uids=robot_uids, **kwargs)

    @property
    def _default_sim_config(self) -> SimConfig:
        # Light legs with strong motors need small steps. On the GPU all envs lie in one world, `spacing`
        # apart, and a robot that walks must not come to its neighbour.
        return SimConfig(sim_freq=200, control_freq=40, spacing=20)

    def _load_agent(self, options: dict) -> None:
        # In the air, so that it touches nothing while it is loaded. ManiSkill logs that it leaves out the
        # floor of the robot's file; `build_ground` makes one.
        super()._load_agent(options, sapien.Pose(p=[0, 0, 1]))

    def _load_scene(self, options: dict) -> None:
        build_ground(self.scene)

    @property
    def torso(self) -> Link:
        return self.agent.robot.links_map["torso"]

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        pose = sapien_utils.look_at(eye=[-1.5, -1.5, 1.2], target=[0, 0, 0])  # relative to the torso
        return [
            CameraConfig(
                "base_camera", pose=pose, width=128, height=128, fov=1.0, near=0.01, far=50, mount=self.torso
            )
        ]

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        with torch.device(self.device):
            b = len(env_idx)
            stand = self.agent.keyframes["stand"]
            # Any heading: it is to walk along x, and not straight ahead.
            heading = torch.pi * (2 * torch.rand(b) - 1)
            zero = torch.zeros(b)
            q = torch.stack([(heading / 2).cos(), zero, zero, (heading / 2).sin()], dim=1)
            p = torch.tensor(stand.pose.p).repeat(b, 1)
            self.agent.robot.set_pose(Pose.create_from_pq(p, q))
            # A little noise, so that no two episodes are the same.
            qpos = torch.tensor(stand.qpos, dtype=torch.float32) + 0.02 * torch.randn((b, len(stand.qpos)))
            self.agent.reset(qpos)

    def evaluate(self) -> dict[str, torch.Tensor]:
        up = self.torso.pose.to_transformation_matrix()[:, 2, 2]  # 1 upright, 0 on its side, -1 on its back
        return {"fail": up < 0, "upright": up, "speed": self.torso.linear_velocity[:, 0]}

    def _get_obs_extra(self, info: dict) -> dict[str, torch.Tensor]:
        if not self.obs_mode_struct.use_state:
            return {}
        axes = self.torso.pose.to_transformation_matrix()[:, :3, :3]
        return {
            "height": self.torso.pose.p[:, 2:],
            "ahead": axes[:, :, 0],
            "up": axes[:, :, 2],
            "velocity": self.torso.linear_velocity,
            "turning": self.torso.angular_velocity,
        }

    def compute_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        # `walk` is a bell around `SPEED`: a robot that stands gets 2 % of it.
        terms = {
            "walk": torch.exp(-(((info["speed"] - SPEED) / CLOSE) ** 2)),
            "upright": (MOST - 1) * info["upright"].clamp(0, 1),
            "effort": -0.05 * action.square().mean(dim=1),
        }
        info["reward_terms"] = terms
        return torch.stack(list(terms.values())).sum(dim=0)

    def compute_normalized_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        return self.compute_dense_reward(obs, action, info) / MOST


# ManiSkill takes lists and sapien.Pose where its annotations do not say so.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportOptionalMemberAccess=false
