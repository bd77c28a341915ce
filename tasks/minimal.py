"""The least that a task can be: a robot, a cube, and when it is done. Copy it and go on from here."""

import sapien
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils.building.ground import build_ground
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs import Pose


@register_env("WorkbenchMinimal-v1", max_episode_steps=50)
class MinimalEnv(BaseEnv):
    """Knock the cube away: success is when it lies more than 5 cm from where it started."""

    SUPPORTED_ROBOTS = ["panda"]
    SUPPORTED_REWARD_MODES = ("sparse", "none")  # there is no compute_dense_reward

    def __init__(self, *args, robot_uids="panda", **kwargs):
        super().__init__(*args, robot_uids=robot_uids, **kwargs)

    def _load_agent(self, options: dict):
        """Where the robot stands, once: in a place where it touches nothing."""
        super()._load_agent(options, sapien.Pose(p=[-0.6, 0, 0]))

    def _load_scene(self, options: dict):
        """What there is, once, for all environments together."""
        build_ground(self.scene)
        builder = self.scene.create_actor_builder()
        builder.add_box_collision(half_size=[0.03] * 3)
        builder.add_box_visual(half_size=[0.03] * 3)
        builder.initial_pose = sapien.Pose(p=[0, 0, 0.03])
        self.cube = builder.build(name="cube")

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict):
        """Where it is, at every reset, for the environments `env_idx` and no others."""
        self.agent.reset(self.agent.keyframes["rest"].qpos)
        p = torch.tensor([0, 0, 0.03], device=self.device).repeat(len(env_idx), 1)
        self.cube.set_pose(Pose.create_from_pq(p=p))

    def evaluate(self):
        """How each environment stands, at every step: a bool for each, shape (num_envs,)."""
        return {"success": torch.linalg.norm(self.cube.pose.p[:, :2], dim=1) > 0.05}


# ManiSkill takes lists and sapien.Pose where its annotations do not say so.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportOptionalMemberAccess=false
