"""A scene with fixed cameras and cameras mounted on a link and an actor."""

# ManiSkill annotates vectors and poses as what they become.
# pyright: reportAttributeAccessIssue=false, reportArgumentType=false

from __future__ import annotations

from typing import Any

import numpy as np
import sapien
import torch
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils.structs.pose import Pose

from tests.drive.render_device import RENDER_BACKEND
from tests.envs.by_hand import by_hand
from tests.envs.stock_env import Bare

RENDERED = {
    "obs_mode": "rgb+depth+segmentation",
    "render_backend": RENDER_BACKEND,
    "render_mode": "rgb_array",
}

COLOURS = [[1.0, 0, 0, 1], [0, 1.0, 0, 1], [0, 0, 1.0, 1]]


class Watched(Bare):
    """A coloured wall, a fixed camera, cameras on a link and a moving actor, and a marker hidden from sensors."""

    def _load_scene(self, options: dict) -> None:
        self.chain = by_hand(self, 2)
        self.wall = []
        for i in range(3):
            builder = self.scene.create_actor_builder()
            builder.add_box_visual(
                half_size=[0.05, 0.5, 0.5], material=sapien.render.RenderMaterial(base_color=COLOURS[i])
            )
            builder.initial_pose = sapien.Pose([2, 1.2 * (i - 1), 1])
            self.wall.append(builder.build_static(f"wall-{i}"))
        builder = self.scene.create_actor_builder()
        builder.add_box_visual(half_size=[0.02] * 3)
        builder.initial_pose = sapien.Pose([0, 0, 1.5])
        self.rider = builder.build_kinematic("rider")
        builder = self.scene.create_actor_builder()
        builder.add_sphere_visual(radius=0.2, material=sapien.render.RenderMaterial(base_color=[1, 1, 1, 1]))
        builder.initial_pose = sapien.Pose([1, 0, 1])
        self.marker = builder.build_kinematic("marker")
        self._hidden_objects.append(self.marker)

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        small = {"width": 32, "height": 24, "fov": 1.5, "near": 0.01, "far": 10}
        return [
            CameraConfig("on_link", pose=sapien.Pose([0.3, 0, 0]), mount=self.chain.links[-1], **small),
            CameraConfig("on_actor", pose=sapien.Pose(), mount=self.rider, **small),
            CameraConfig("beside", pose=sapien.Pose([0, 0, 1]), **small),
        ]

    @property
    def _default_human_render_camera_configs(self) -> CameraConfig:
        return CameraConfig("people", sapien.Pose([0, 0, 1]), 32, 24, 1.5, 0.01, 10)

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        number = torch.tensor(self.env_numbers())[env_idx]
        b = len(env_idx)
        self.chain.set_qpos(torch.stack([0.2 * number, -0.1 * number], dim=1))
        p = torch.stack([torch.zeros(b), 0.6 * (number - 1), torch.full((b,), 1.0)], dim=1)
        self.rider.set_pose(Pose.create_from_pq(p))
        self.marker.set_pose(
            Pose.create_from_pq(torch.stack([torch.ones(b), 0.1 * number, torch.ones(b)], dim=1))
        )


def pictures(obs: Any) -> dict[str, np.ndarray]:
    return {
        f"{camera}/{texture}": np.asarray(value)
        for camera, data in obs["sensor_data"].items()
        for texture, value in data.items()
    }
