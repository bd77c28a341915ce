"""The task of the golden recordings: a paddle of boxes pushes a box. It stays as it is, for they name its text."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import sapien
import torch
from mani_skill.agents.base_agent import BaseAgent
from mani_skill.agents.controllers import PDJointPosControllerConfig
from mani_skill.agents.registration import register_agent
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs import Pose

HALF = 0.02
WANTED = 0.02
"""How far the box is to be pushed, metres."""


@register_agent()
class GoldenPusher(BaseAgent):
    uid = "golden_pusher"
    urdf_path = str(Path(__file__).parent / "pusher.urdf")

    @property
    def _controller_configs(self) -> dict[str, Any]:
        joints = ["forward", "sideways"]
        return {
            "pd_joint_delta_pos": PDJointPosControllerConfig(
                joints, -0.02, 0.02, stiffness=1e3, damping=1e2, force_limit=50, use_delta=True
            )
        }


@register_env("GoldenPush-v1", max_episode_steps=12)
class GoldenPush(BaseEnv):
    """Success: the box is `WANTED` further along x than where it began."""

    SUPPORTED_ROBOTS = ["golden_pusher"]
    SUPPORTED_REWARD_MODES = ("normalized_dense", "dense", "sparse", "none")

    def __init__(self, *args: Any, robot_uids: str = "golden_pusher", **kwargs: Any) -> None:
        super().__init__(*args, robot_uids=robot_uids, **kwargs)

    def _load_agent(self, options: dict) -> None:
        super()._load_agent(options, sapien.Pose(p=[0, 0, 0.03]))

    def _load_scene(self, options: dict) -> None:
        builder = self.scene.create_actor_builder()
        builder.add_box_collision(half_size=[1, 1, 0.05])
        builder.add_box_visual(half_size=[1, 1, 0.05])
        builder.initial_pose = sapien.Pose(p=[0, 0, -0.05])
        builder.build_static(name="floor")
        builder = self.scene.create_actor_builder()
        builder.add_box_collision(half_size=[HALF] * 3)
        builder.add_box_visual(
            half_size=[HALF] * 3, material=sapien.render.RenderMaterial(base_color=[0.8, 0.3, 0.1, 1])
        )
        builder.initial_pose = sapien.Pose(p=[0.06, 0, HALF])
        self.box = builder.build(name="box")

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        pose = sapien_utils.look_at(eye=[0.3, 0.2, 0.4], target=[0.05, 0, 0])
        return [CameraConfig("eye", pose=pose, width=64, height=48, fov=0.8, near=0.01, far=10)]

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        with torch.device(self.device):
            b = len(env_idx)
            self.agent.reset(torch.zeros((b, 2)))
            place = torch.zeros((b, 3))
            place[:, 0] = 0.06 + 0.01 * torch.rand(b)
            place[:, 2] = HALF
            self.box.set_pose(Pose.create_from_pq(place))

    def evaluate(self) -> dict[str, torch.Tensor]:
        pushed = self.box.pose.p[:, 0] - 0.06
        return {"success": pushed > WANTED, "pushed": pushed}

    def _get_obs_extra(self, info: dict) -> dict[str, torch.Tensor]:
        return {"box": self.box.pose.raw_pose}

    def compute_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        return (info["pushed"] / WANTED).clamp(-1, 1)

    def compute_normalized_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        return self.compute_dense_reward(obs, action, info)


# ManiSkill takes lists and sapien.Pose where its annotations do not say so.
# pyright: reportArgumentType=false, reportOptionalMemberAccess=false, reportIncompatibleVariableOverride=false
