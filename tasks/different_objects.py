"""Different objects in different envs: push whatever lies there over the line.

A builder makes its body in all envs, or in those of `set_scene_idxs`. Here each env gets a builder of
its own, with another shape, size and colour, and `Actor.merge` makes one actor of them, so all that
comes later (poses, rewards) stays one batch. What to keep in mind:

- random numbers come from `self._batched_episode_rng[i]`, the generator of env i: then what is built
  for a seed does not depend on how many envs there are, and a demonstration finds its object again;
- of the parts and the merged actor only the merged one is in the state;
- what differs, as the half height, is kept with one row for each env and read by `env_idx`;
- objects are drawn when the scene is built. A single env rebuilds it at each reset
  (`reconfiguration_freq`), or it would train on one object for ever.
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
from mani_skill.utils.structs import Actor, Pose
from transforms3d.euler import euler2quat

LINE = 0.15
"""The object is to get past this x."""
KINDS = ("box", "disc", "cross")


@register_env("WorkbenchDifferentObjects-v1", max_episode_steps=60)
class DifferentObjectsEnv(BaseEnv):
    """Success: the object's middle is past the white line."""

    SUPPORTED_ROBOTS = ["panda"]
    SUPPORTED_REWARD_MODES = ("sparse", "none")
    agent: Panda

    def __init__(
        self,
        *args: Any,
        robot_uids: str = "panda",
        num_envs: int = 1,
        reconfiguration_freq: int | None = None,
        **kwargs: Any,
    ):
        if reconfiguration_freq is None:
            reconfiguration_freq = 1 if num_envs == 1 else 0
        super().__init__(
            *args,
            robot_uids=robot_uids,
            num_envs=num_envs,
            reconfiguration_freq=reconfiguration_freq,
            **kwargs,
        )

    def _load_agent(self, options: dict) -> None:
        super()._load_agent(options, sapien.Pose(p=[-0.615, 0, 0]))

    def _load_scene(self, options: dict) -> None:
        build_ground(self.scene)
        builder = self.scene.create_actor_builder()
        builder.add_box_visual(
            half_size=[0.005, 0.3, 0.001], material=sapien.render.RenderMaterial(base_color=[1, 1, 1, 1])
        )
        builder.initial_pose = sapien.Pose(p=[LINE, 0, 0.001])
        builder.build_static(name="line")

        objects, half_heights = [], []
        for env in range(self.num_envs):
            actor, half_height = self._build_object(env, self._batched_episode_rng[env])
            self.remove_from_state_dict_registry(actor)
            objects.append(actor)
            half_heights.append(half_height)
        self.object = Actor.merge(objects, name="object")
        self.add_to_state_dict_registry(self.object)
        self.half_height = torch.tensor(half_heights, dtype=torch.float32, device=self.device)

    def _build_object(self, env: int, rng: np.random.RandomState) -> tuple[Actor, float]:
        """The object of one env, and half its height."""
        kind = KINDS[rng.randint(len(KINDS))]
        size, half_height = rng.uniform(0.025, 0.045), rng.uniform(0.015, 0.03)
        material = sapien.render.RenderMaterial(base_color=[*rng.uniform(0.1, 0.9, 3), 1])
        builder = self.scene.create_actor_builder()
        if kind == "disc":
            upright = sapien.Pose(q=euler2quat(0, np.pi / 2, 0))  # a cylinder's axis is x
            builder.add_cylinder_collision(upright, radius=size, half_length=half_height)
            builder.add_cylinder_visual(upright, radius=size, half_length=half_height, material=material)
        elif kind == "box":
            builder.add_box_collision(half_size=[size, size, half_height])
            builder.add_box_visual(half_size=[size, size, half_height], material=material)
        else:
            for half_size in ([size, size / 3, half_height], [size / 3, size, half_height]):
                builder.add_box_collision(half_size=half_size)
                builder.add_box_visual(half_size=half_size, material=material)
        builder.set_scene_idxs([env])
        builder.initial_pose = sapien.Pose(p=[0, 0, half_height])
        return builder.build(name=f"{kind}_{env}"), half_height

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        pose = sapien_utils.look_at(eye=[0.5, 0.2, 0.6], target=[0, 0, 0])
        return [CameraConfig("base_camera", pose=pose, width=128, height=128, fov=1.0, near=0.01, far=10)]

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        with torch.device(self.device):
            b = len(env_idx)
            rest = torch.tensor(self.agent.keyframes["rest"].qpos, dtype=torch.float32)
            self.agent.reset(rest.repeat(b, 1))
            place = torch.zeros((b, 3))
            place[:, :2] = 0.2 * torch.rand((b, 2)) - 0.1
            place[:, 2] = self.half_height[env_idx]
            self.object.set_pose(Pose.create_from_pq(place))

    def evaluate(self) -> dict[str, torch.Tensor]:
        missing = LINE - self.object.pose.p[:, 0]
        return {"success": missing < 0, "missing": missing}

    def _get_obs_extra(self, info: dict) -> dict[str, torch.Tensor]:
        obs = {"tcp_pose": self.agent.tcp.pose.raw_pose}
        if self.obs_mode_struct.use_state:
            obs["object_pose"] = self.object.pose.raw_pose
            obs["half_height"] = self.half_height[:, None]
        return obs


# ManiSkill takes lists and sapien.Pose where its annotations do not say so.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportOptionalMemberAccess=false
