"""Two robots: lift a bar that is too long for one of them, each at its end.

- `robot_uids` is a tuple, and so is the entry of `SUPPORTED_ROBOTS`;
- `_load_agent` gets a list of poses, one for each robot;
- `self.agent` is then a `MultiAgent`: the robots are `self.agent.agents`, in the order of the tuple, and
  each has its own joints, tcp and reset. There is no `self.agent.tcp`;
- an action is a dict with an entry for each robot ("panda-0", "panda-1"), and so is the robots' own part
  of an observation;
- numbers of each robot have an axis for the robots: `to_grips` is (N, 2, 3) and `held` is (N, 2). "Both" is
  then `all(dim=1)`.

To change: other robots are another tuple, in `SUPPORTED_ROBOTS` and as the default of `robot_uids`. A third
robot needs a third pose in `_load_agent`, and a third place in `to_grips`.
"""

from __future__ import annotations

from typing import Any

import sapien
import torch
from mani_skill.agents.multi_agent import MultiAgent
from mani_skill.agents.robots import Panda
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils
from mani_skill.utils.building.ground import build_ground
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs import Pose
from transforms3d.euler import euler2quat

BAR = [0.2, 0.02, 0.02]
"""Half sizes, metres."""
GRIP = 0.17
"""Each robot is to hold the bar this far from its middle."""
LIFTED = 0.1


@register_env("WorkbenchTwoRobots-v1", max_episode_steps=100)
class TwoRobotsEnv(BaseEnv):
    """Success: the bar is `LIFTED` above the ground and level, and both robots hold it."""

    SUPPORTED_ROBOTS = [("panda", "panda")]  # type: ignore[assignment]
    SUPPORTED_REWARD_MODES = ("normalized_dense", "dense", "sparse", "none")
    agent: MultiAgent[tuple[Panda, Panda]]

    def __init__(self, *args: Any, robot_uids: tuple[str, str] = ("panda", "panda"), **kwargs: Any):
        super().__init__(*args, robot_uids=robot_uids, **kwargs)

    def _load_agent(self, options: dict) -> None:
        # Apart enough that the hands do not meet, near enough that each reaches its end of the bar.
        facing_back = sapien.Pose(p=[0.78, 0, 0], q=euler2quat(0, 0, torch.pi))
        super()._load_agent(options, [sapien.Pose(p=[-0.78, 0, 0]), facing_back])

    def _load_scene(self, options: dict) -> None:
        build_ground(self.scene)
        builder = self.scene.create_actor_builder()
        builder.add_box_collision(half_size=BAR, density=300)  # like wood; the default is 1000, water
        builder.add_box_visual(
            half_size=BAR, material=sapien.render.RenderMaterial(base_color=[0.2, 0.45, 0.7, 1])
        )
        builder.initial_pose = sapien.Pose(p=[0, 0, BAR[2]])
        self.bar = builder.build(name="bar")

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        pose = sapien_utils.look_at(eye=[0, 0.9, 0.8], target=[0, 0, 0.05])
        return [CameraConfig("base_camera", pose=pose, width=128, height=128, fov=1.1, near=0.01, far=10)]

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        with torch.device(self.device):
            b = len(env_idx)
            for robot in self.agent.agents:
                rest = torch.tensor(robot.keyframes["rest"].qpos, dtype=torch.float32)
                robot.reset(rest.repeat(b, 1))
            place = torch.zeros((b, 3))
            place[:, 0] = 0.06 * torch.rand(b) - 0.03
            place[:, 1] = 0.2 * torch.rand(b) - 0.1
            place[:, 2] = BAR[2]
            self.bar.set_pose(Pose.create_from_pq(place))

    @property
    def to_grips(self) -> torch.Tensor:
        """From each robot's tcp to the place where it is to hold the bar: (N, 2, 3)."""
        return torch.stack(
            [
                (self.bar.pose * sapien.Pose(p=[side * GRIP, 0, 0])).p - robot.tcp.pose.p
                for side, robot in zip((-1, 1), self.agent.agents)
            ],
            dim=1,
        )

    def evaluate(self) -> dict[str, torch.Tensor]:
        held = torch.stack([robot.is_grasping(self.bar) for robot in self.agent.agents], dim=1)
        height = self.bar.pose.p[:, 2] - BAR[2]
        ends = [(self.bar.pose * sapien.Pose(p=[side * BAR[0], 0, 0])).p[:, 2] for side in (-1, 1)]
        level = (ends[0] - ends[1]).abs() < 0.03
        return {"success": held.all(dim=1) & level & (height > LIFTED), "held": held, "height": height}

    def _get_obs_extra(self, info: dict) -> dict[str, torch.Tensor]:
        obs = {"tcps": torch.cat([robot.tcp.pose.raw_pose for robot in self.agent.agents], dim=1)}
        if self.obs_mode_struct.use_state:
            obs["bar_pose"] = self.bar.pose.raw_pose
            obs["to_grips"] = self.to_grips.flatten(1)
        return obs

    def compute_dense_reward(self, obs: Any, action: Any, info: dict) -> torch.Tensor:
        # A mean over the robots of what each does alone. `lift` needs both, or one would drag the bar alone.
        reach = (1 - torch.tanh(4 * torch.linalg.norm(self.to_grips, dim=2))).mean(dim=1)
        held = info["held"].float().mean(dim=1)
        lift = info["held"].all(dim=1) * (info["height"] / LIFTED).clamp(0, 1)
        return torch.where(info["success"], 4.0, reach + held + lift)

    def compute_normalized_dense_reward(self, obs: Any, action: Any, info: dict) -> torch.Tensor:
        return self.compute_dense_reward(obs, action, info) / 4


# ManiSkill takes lists and sapien.Pose where its annotations do not say so.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportOptionalMemberAccess=false
