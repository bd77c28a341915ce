"""A control task without success: swing a pendulum up and keep it there.

There is no moment at which such a task is done, so `evaluate` returns neither success nor fail. Every
episode lasts until its time limit, and how good it was is the sum of its rewards. "sparse" is not among
the reward modes: it would always be 0.

The pendulum is an agent that is built in code, without a file:

- `_load_articulation` builds it with the articulation builder and sets `self.robot`;
- `balance_passive_force=False` leaves gravity on. By default ManiSkill turns it off for robots;
- the motor follows a velocity with at most `TORQUE`, too little to lift the bob in one go;
- the joint turns for ever, so the observation has sine and cosine in place of the angle.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import sapien
import torch
from mani_skill.agents.base_agent import BaseAgent
from mani_skill.agents.controllers import PDJointVelControllerConfig
from mani_skill.agents.registration import register_agent
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils
from mani_skill.utils.building.ground import build_ground
from mani_skill.utils.registration import register_env
from transforms3d.euler import euler2quat

LENGTH = 0.5
HINGE = 0.7
"""Metres above the ground."""
TORQUE = 1.2
"""Newton metres; holding the rod level takes about 2.6."""


@register_agent()
class Pendulum(BaseAgent):
    """A bob on a rod that turns about a hinge; at `qpos` 0 it hangs straight down."""

    uid = "workbench_pendulum"

    def _load_articulation(self, initial_pose: Any = None) -> None:
        steel = sapien.render.RenderMaterial(base_color=[0.3, 0.32, 0.35, 1])
        red = sapien.render.RenderMaterial(base_color=[0.8, 0.15, 0.1, 1])
        builder = self.scene.create_articulation_builder()
        stand = builder.create_link_builder()
        stand.set_name("stand")
        stand.set_joint_properties("fixed", [], sapien.Pose(), sapien.Pose())
        stand.add_box_visual(sapien.Pose(p=[0, 0.06, HINGE / 2]), [0.02, 0.02, HINGE / 2], material=steel)

        rod = builder.create_link_builder(stand)
        rod.set_name("rod")
        rod.set_joint_name("hinge")
        # A joint turns about the x axis of its frame; here that is the world's y axis.
        to_y = euler2quat(0, 0, np.pi / 2)
        rod.set_joint_properties(
            "revolute_unwrapped",
            [[-np.inf, np.inf]],
            pose_in_parent=sapien.Pose(p=[0, 0, HINGE], q=to_y),
            pose_in_child=sapien.Pose(q=to_y),
        )
        rod.add_box_visual(sapien.Pose(p=[0, 0, -LENGTH / 2]), [0.012, 0.012, LENGTH / 2], material=steel)
        bob = sapien.Pose(p=[0, 0, -LENGTH])
        rod.add_sphere_collision(bob, radius=0.05)  # its mass is the pendulum's
        rod.add_sphere_visual(bob, radius=0.05, material=red)

        builder.initial_pose = initial_pose
        self.robot = builder.build(name=self.uid, fix_root_link=True)
        self.robot_link_names = [link.name for link in self.robot.get_links()]

    @property
    def _controller_configs(self) -> dict[str, Any]:
        motor = PDJointVelControllerConfig(["hinge"], -8, 8, damping=1.0, force_limit=TORQUE)
        return {"motor": {"hinge": motor, "balance_passive_force": False}}

    def get_proprioception(self) -> dict[str, torch.Tensor]:
        angle = self.robot.get_qpos()
        return {"cos": angle.cos(), "sin": angle.sin(), "speed": self.robot.get_qvel()}


@register_env("WorkbenchSwingUp-v1", max_episode_steps=200)
class SwingUpEnv(BaseEnv):
    """The reward of a step is 1 for a pendulum that stands upright and still, and 0 for one that hangs."""

    SUPPORTED_ROBOTS = ["workbench_pendulum"]
    SUPPORTED_REWARD_MODES = ("normalized_dense", "dense", "none")
    agent: Pendulum

    def __init__(self, *args: Any, robot_uids: str = "workbench_pendulum", **kwargs: Any):
        super().__init__(*args, robot_uids=robot_uids, **kwargs)

    def _load_agent(self, options: dict) -> None:
        super()._load_agent(options, sapien.Pose())

    def _load_scene(self, options: dict) -> None:
        build_ground(self.scene)

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        pose = sapien_utils.look_at(eye=[0.2, -1.3, 1.3], target=[0, 0, 0.6])
        return [CameraConfig("base_camera", pose=pose, width=128, height=128, fov=1.0, near=0.01, far=10)]

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        with torch.device(self.device):
            self.agent.reset(0.2 * torch.rand((len(env_idx), 1)) - 0.1)

    def evaluate(self) -> dict[str, torch.Tensor]:
        upright = (1 - self.agent.robot.get_qpos()[:, 0].cos()) / 2
        return {"upright": upright}

    def _get_obs_extra(self, info: dict) -> dict[str, torch.Tensor]:
        return {}  # all there is to know is the robot's own

    def compute_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        calm = 1 - torch.tanh(self.agent.robot.get_qvel()[:, 0].abs() / 8)
        return info["upright"] * (0.5 + 0.5 * calm)

    def compute_normalized_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        return self.compute_dense_reward(obs, action, info)  # it lies within 0 and 1


# ManiSkill takes lists and sapien.Pose where its annotations do not say so.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportOptionalMemberAccess=false
