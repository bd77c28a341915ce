"""A scene builder of its own: two steps between side walls, and a can that stands on the lower one.

A `SceneBuilder` holds what several tasks share: it builds the furniture once (`build`) and puts what
moves to its place at each reset (`initialize`). The task keeps what is its own: goal, reward, cameras.

- what never moves is built static, with its pose in the builder: it costs the least on a GPU;
- `scene_objects` and `movable_objects` tell a task what there is, by name;
- `initialize` gets `env_idx`, as `_initialize_episode` does, and makes that many rows.
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
from mani_skill.utils.scene_builder import SceneBuilder
from mani_skill.utils.structs import Pose
from transforms3d.euler import euler2quat

STEPS = {"lower_step": (0.0, 0.02), "upper_step": (0.14, 0.1)}
"""Where the middle of each is along x, and how high it is, in metres."""
HALF_DEPTH, HALF_WIDTH = 0.07, 0.25
RADIUS, HALF_HEIGHT = 0.025, 0.05


class StepsScene(SceneBuilder):
    """The ground, two steps, a wall at each side, and a can."""

    def build(self, build_config_idxs: list[int] | None = None) -> None:
        build_ground(self.scene)
        self.scene_objects = {}
        for name, (x, height) in STEPS.items():
            self._build_wood(name, [HALF_DEPTH, HALF_WIDTH, height / 2], [x, 0, height / 2])
        for name, side in (("left_wall", 1), ("right_wall", -1)):
            self._build_wood(
                name, [2 * HALF_DEPTH, 0.01, 0.07], [HALF_DEPTH, side * (HALF_WIDTH + 0.01), 0.07]
            )

        upright = sapien.Pose(q=euler2quat(0, np.pi / 2, 0))  # a cylinder's axis is x
        builder = self.scene.create_actor_builder()
        builder.add_cylinder_collision(upright, radius=RADIUS, half_length=HALF_HEIGHT)
        builder.add_cylinder_visual(
            upright,
            radius=RADIUS,
            half_length=HALF_HEIGHT,
            material=sapien.render.RenderMaterial(base_color=[0.75, 0.15, 0.1, 1]),
        )
        builder.initial_pose = sapien.Pose(p=[0, 0, STEPS["lower_step"][1] + HALF_HEIGHT])
        self.can = builder.build(name="can")
        self.movable_objects = {"can": self.can}
        self.scene_objects["can"] = self.can

    def _build_wood(self, name: str, half_size: list[float], place: list[float]) -> None:
        builder = self.scene.create_actor_builder()
        builder.add_box_collision(half_size=half_size)
        builder.add_box_visual(
            half_size=half_size, material=sapien.render.RenderMaterial(base_color=[0.65, 0.5, 0.35, 1])
        )
        builder.initial_pose = sapien.Pose(p=place)
        self.scene_objects[name] = builder.build_static(name=name)

    def initialize(self, env_idx: torch.Tensor, init_config_idxs: list[int] | None = None) -> None:
        with torch.device(self.env.device):
            b = len(env_idx)
            rest = torch.tensor(self.env.agent.keyframes["rest"].qpos, dtype=torch.float32)
            self.env.agent.reset(rest.repeat(b, 1))
            place = torch.zeros((b, 3))
            place[:, 0] = 0.06 * torch.rand(b) - 0.04
            place[:, 1] = 0.3 * torch.rand(b) - 0.15
            place[:, 2] = STEPS["lower_step"][1] + HALF_HEIGHT
            self.can.set_pose(Pose.create_from_pq(place))


@register_env("WorkbenchCustomScene-v1", max_episode_steps=100)
class CustomSceneEnv(BaseEnv):
    """Success: the can stands on the upper step, and the hand has let go."""

    SUPPORTED_ROBOTS = ["panda"]
    SUPPORTED_REWARD_MODES = ("sparse", "none")
    agent: Panda

    def __init__(self, *args: Any, robot_uids: str = "panda", **kwargs: Any):
        super().__init__(*args, robot_uids=robot_uids, **kwargs)

    def _load_agent(self, options: dict) -> None:
        super()._load_agent(options, sapien.Pose(p=[-0.5, 0, 0]))

    def _load_scene(self, options: dict) -> None:
        self.steps = StepsScene(self)
        self.steps.build()

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        pose = sapien_utils.look_at(eye=[-0.5, 0.5, 0.7], target=[0.05, 0, 0.08])
        return [CameraConfig("base_camera", pose=pose, width=128, height=128, fov=0.9, near=0.01, far=10)]

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        self.steps.initialize(env_idx)

    def evaluate(self) -> dict[str, torch.Tensor]:
        can, (step_x, step_height) = self.steps.can, STEPS["upper_step"]
        place = can.pose.p
        # Within 1 cm of where an upright can rests: one that lies or is held higher does not count.
        on_step = (place[:, 2] - step_height - HALF_HEIGHT).abs() < 0.01
        on_step &= (place[:, 0] - step_x).abs() < HALF_DEPTH
        resting = torch.linalg.norm(can.linear_velocity, dim=1) < 0.05
        let_go = ~self.agent.is_grasping(can)
        return {"success": on_step & resting & let_go, "height": place[:, 2] - HALF_HEIGHT}

    def _get_obs_extra(self, info: dict) -> dict[str, torch.Tensor]:
        obs = {"tcp_pose": self.agent.tcp.pose.raw_pose}
        if self.obs_mode_struct.use_state:
            obs["can_pose"] = self.steps.can.pose.raw_pose
        return obs


# ManiSkill takes lists and sapien.Pose where its annotations do not say so.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportOptionalMemberAccess=false
# pyright: reportOptionalSubscript=false
