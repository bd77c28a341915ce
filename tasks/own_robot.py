"""A robot of your own: a small arm from `own_robot.urdf`, which lies beside this file.

An agent class says how a robot is loaded and moved; `@register_agent()` makes its `uid` known, so that
`robot_uids="workbench_pen_arm"` works in each task that lists it.

- the URDF is found from `__file__`: the task runs from any folder;
- `_controller_configs` has one entry for each control mode, the first is the default. An action of 1
  is the upper bound of its joint here, -1 the lower;
- stiffness, damping and force limit must hold the arm at rest: `workbench check` looks (robot-holds);
- `keyframes` are poses with a name; a task resets the robot to one of them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import sapien
import torch
from mani_skill.agents.base_agent import BaseAgent, Keyframe
from mani_skill.agents.controllers import PDJointPosControllerConfig
from mani_skill.agents.registration import register_agent
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils
from mani_skill.utils.building.ground import build_ground
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs import Pose
from transforms3d.euler import euler2quat

REACH = (0.25, 0.42)
"""The mark lies this far from the arm's base, in metres; the arm reaches 0.45."""
CLOSE = 0.025


@register_agent()
class PenArm(BaseAgent):
    """Two joints that turn in the plane, and one that lowers the pen."""

    uid = "workbench_pen_arm"
    urdf_path = str(Path(__file__).parent / "own_robot.urdf")
    keyframes = {"rest": Keyframe(qpos=np.array([0.0, 1.2, 0.0]), pose=sapien.Pose())}

    @property
    def _controller_configs(self) -> dict[str, Any]:
        joints = ["shoulder", "elbow", "lower"]
        drive = {"stiffness": 400, "damping": 40, "force_limit": 20}
        step = [0.15, 0.15, 0.02]
        return {
            "pd_joint_delta_pos": PDJointPosControllerConfig(
                joints, [-size for size in step], step, use_delta=True, **drive
            ),
            "pd_joint_pos": PDJointPosControllerConfig(joints, None, None, normalize_action=False, **drive),
        }

    def _after_init(self) -> None:
        self.tip = self.robot.links_map["tip"]


@register_env("WorkbenchOwnRobot-v1", max_episode_steps=50)
class OwnRobotEnv(BaseEnv):
    """Success: the tip of the pen is on the green mark."""

    SUPPORTED_ROBOTS = ["workbench_pen_arm"]
    SUPPORTED_REWARD_MODES = ("normalized_dense", "dense", "sparse", "none")
    agent: PenArm

    def __init__(self, *args: Any, robot_uids: str = "workbench_pen_arm", **kwargs: Any):
        super().__init__(*args, robot_uids=robot_uids, **kwargs)

    def _load_agent(self, options: dict) -> None:
        super()._load_agent(options, sapien.Pose())

    def _load_scene(self, options: dict) -> None:
        build_ground(self.scene)
        builder = self.scene.create_actor_builder()
        builder.add_cylinder_visual(
            sapien.Pose(q=euler2quat(0, np.pi / 2, 0)),  # a cylinder's axis is x
            radius=CLOSE,
            half_length=0.002,
            material=sapien.render.RenderMaterial(base_color=[0.1, 0.6, 0.2, 1]),
        )
        builder.initial_pose = sapien.Pose(p=[REACH[0], 0, 0.002])
        self.mark = builder.build_kinematic(name="mark")

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        pose = sapien_utils.look_at(eye=[0.7, 0.1, 0.8], target=[0.15, 0, 0.05])
        return [CameraConfig("base_camera", pose=pose, width=128, height=128, fov=1.1, near=0.01, far=10)]

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        with torch.device(self.device):
            b = len(env_idx)
            rest = torch.tensor(self.agent.keyframes["rest"].qpos, dtype=torch.float32)
            self.agent.reset(rest + 0.1 * torch.rand((b, 3)) * torch.tensor([1, 1, 0]))
            angle = 2 * torch.rand(b) - 1
            distance = REACH[0] + (REACH[1] - REACH[0]) * torch.rand(b)
            place = torch.stack(
                [distance * angle.cos(), distance * angle.sin(), torch.full((b,), 0.002)], dim=1
            )
            self.mark.set_pose(Pose.create_from_pq(place))

    def evaluate(self) -> dict[str, torch.Tensor]:
        distance = torch.linalg.norm(self.mark.pose.p - self.agent.tip.pose.p, dim=1)
        return {"success": distance < CLOSE, "distance": distance}

    def _get_obs_extra(self, info: dict) -> dict[str, torch.Tensor]:
        obs = {"tip": self.agent.tip.pose.p}
        if self.obs_mode_struct.use_state:
            obs["mark"] = self.mark.pose.p[:, :2]
        return obs

    def compute_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        return torch.where(info["success"], 2.0, 1 - torch.tanh(4 * info["distance"]))

    def compute_normalized_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        return self.compute_dense_reward(obs, action, info) / 2


# ManiSkill takes lists and sapien.Pose where its annotations do not say so.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportOptionalMemberAccess=false
