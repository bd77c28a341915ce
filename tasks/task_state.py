"""State of the task beside that of the bodies: touch the cube that is asked for.

Which cube is asked for is no pose of any body: ManiSkill does not know of it. What an episode has
beside poses and velocities belongs into `get_state_dict`, and comes back in `set_state_dict`.
Otherwise a replayed demonstration, or a planner that goes back to a state, meets another goal than
the recorded one. Three things to keep:

- rows: a tensor with one row for each env, made once, and at a reset only the rows of `env_idx` set;
- `set_state_dict` may be asked for some envs only (`env_idx`);
- a flat state (`set_state`) holds bodies alone, so what is missing is left as it is.
"""

from __future__ import annotations

from typing import Any

import sapien
import torch
from mani_skill.agents.robots import Panda
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils
from mani_skill.utils.building.ground import build_ground
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs import Pose

COLORS = {"red": [0.8, 0.1, 0.1, 1], "green": [0.1, 0.6, 0.2, 1], "blue": [0.1, 0.3, 0.8, 1]}
HALF_SIZE = 0.025
CLOSE = 0.04
"""Metres from the point between the fingers to the middle of the cube."""


@register_env("WorkbenchTaskState-v1", max_episode_steps=60)
class TaskStateEnv(BaseEnv):
    """Success: the fingers are at the cube of the colour that is wanted. Fail: at another one."""

    SUPPORTED_ROBOTS = ["panda"]
    SUPPORTED_REWARD_MODES = ("sparse", "none")
    agent: Panda

    def __init__(self, *args: Any, robot_uids: str = "panda", **kwargs: Any):
        super().__init__(*args, robot_uids=robot_uids, **kwargs)

    def _load_agent(self, options: dict) -> None:
        super()._load_agent(options, sapien.Pose(p=[-0.615, 0, 0]))

    def _load_scene(self, options: dict) -> None:
        build_ground(self.scene)
        self.cubes = []
        for number, (name, color) in enumerate(COLORS.items()):
            builder = self.scene.create_actor_builder()
            builder.add_box_collision(half_size=[HALF_SIZE] * 3)
            builder.add_box_visual(
                half_size=[HALF_SIZE] * 3, material=sapien.render.RenderMaterial(base_color=color)
            )
            builder.initial_pose = sapien.Pose(p=[0, 0.15 * (number - 1), HALF_SIZE])
            self.cubes.append(builder.build(name=name))
        self.wanted = torch.zeros(self.num_envs, dtype=torch.int64, device=self.device)

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        pose = sapien_utils.look_at(eye=[0.5, 0, 0.6], target=[0, 0, 0])
        return [CameraConfig("base_camera", pose=pose, width=128, height=128, fov=0.9, near=0.01, far=10)]

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        with torch.device(self.device):
            b = len(env_idx)
            rest = torch.tensor(self.agent.keyframes["rest"].qpos, dtype=torch.float32)
            self.agent.reset(rest.repeat(b, 1))
            # Three places along y, in another order in each env, and each cube a little off its place.
            places = torch.rand((b, 3)).argsort(dim=1)
            for number, cube in enumerate(self.cubes):
                place = torch.zeros((b, 3))
                place[:, 0] = 0.1 * torch.rand(b)
                place[:, 1] = 0.15 * (places[:, number] - 1)
                place[:, 2] = HALF_SIZE
                cube.set_pose(Pose.create_from_pq(place))
            self.wanted[env_idx] = torch.randint(len(COLORS), (b,))

    def get_state_dict(self) -> dict[str, Any]:
        state: dict[str, Any] = super().get_state_dict()  # type: ignore[assignment]
        state["task"] = {"wanted": self.wanted[:, None].clone()}
        return state

    def set_state_dict(self, state: dict[str, Any], env_idx: torch.Tensor | None = None) -> None:
        super().set_state_dict(state, env_idx)
        if "task" in state:
            rows = slice(None) if env_idx is None else env_idx
            wanted = torch.as_tensor(state["task"]["wanted"], device=self.device)
            self.wanted[rows] = wanted[:, 0].to(self.wanted.dtype)

    def evaluate(self) -> dict[str, torch.Tensor]:
        places = torch.stack([cube.pose.p for cube in self.cubes], dim=1)  # (N, 3 cubes, 3)
        touched = torch.linalg.norm(places - self.agent.tcp.pose.p[:, None], dim=2) < CLOSE  # (N, 3 cubes)
        right = touched.gather(1, self.wanted[:, None])[:, 0]
        return {"success": right, "fail": touched.any(dim=1) & ~right, "wanted": self.wanted.clone()}

    def _get_obs_extra(self, info: dict) -> dict[str, torch.Tensor]:
        # What is wanted is told in every mode: no picture shows it.
        obs = {
            "tcp_pose": self.agent.tcp.pose.raw_pose,
            "wanted": torch.nn.functional.one_hot(self.wanted, len(COLORS)).float(),
        }
        if self.obs_mode_struct.use_state:
            obs["cube_positions"] = torch.cat([cube.pose.p for cube in self.cubes], dim=1)
        return obs


# ManiSkill takes lists and sapien.Pose where its annotations do not say so.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportOptionalMemberAccess=false
