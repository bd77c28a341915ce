"""A golden task in several modules. It stays as it is, for recordings name its text."""

from __future__ import annotations

from typing import Any

import arm  # noqa: F401  registers the robot
import judging
import sapien
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs import Pose

HALF = 0.02


@register_env("GoldenSeveral-v1", max_episode_steps=12)
class GoldenSeveral(BaseEnv):
    SUPPORTED_ROBOTS = ["golden_arm"]
    SUPPORTED_REWARD_MODES = ("normalized_dense", "dense", "sparse", "none")

    def __init__(self, *args: Any, robot_uids: str = "golden_arm", **kwargs: Any) -> None:
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
        builder.add_box_visual(half_size=[HALF] * 3)
        builder.initial_pose = sapien.Pose(p=[judging.BEGIN, 0, HALF])
        self.box = builder.build(name="box")

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        with torch.device(self.device):
            b = len(env_idx)
            self.agent.reset(torch.zeros((b, 2)))
            place = torch.zeros((b, 3))
            place[:, 0] = judging.BEGIN + 0.01 * torch.rand(b)
            place[:, 2] = HALF
            self.box.set_pose(Pose.create_from_pq(place))

    def evaluate(self) -> dict[str, torch.Tensor]:
        pushed = judging.pushed(self.box.pose.p)
        return {"success": pushed > judging.WANTED, "pushed": pushed}

    def _get_obs_extra(self, info: dict) -> dict[str, torch.Tensor]:
        return {"box": self.box.pose.raw_pose}

    def compute_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        return judging.share(self.box.pose.p)

    def compute_normalized_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        return self.compute_dense_reward(obs, action, info)


# The modules beside it are found when it runs. ManiSkill takes lists and sapien.Pose where its annotations do not say so.
# pyright: reportMissingImports=false, reportArgumentType=false, reportOptionalMemberAccess=false, reportIncompatibleVariableOverride=false
