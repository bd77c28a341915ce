"""A scene that reacts to changed physics settings: two colliding boxes and a swinging chain."""

# ManiSkill annotates vectors and poses as what they become.
# pyright: reportAttributeAccessIssue=false, reportArgumentType=false

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import sapien
import torch
from mani_skill.utils.structs.pose import Pose

from tests.envs.by_hand import BOX, box, by_hand
from tests.envs.stock_env import Bare

Change = Callable[[Any], None]


def nothing(env: Any) -> None:
    pass


class Collision(Bare):
    """Box a slides into box b; a chain of two hinges swings freely."""

    on_load: Change = staticmethod(nothing)
    on_step: Change = staticmethod(nothing)
    material: Any = None

    def _load_scene(self, options: dict) -> None:
        self.floor = box(self, "floor", [3, 3, 0.1], sapien.Pose([0, 0, -0.1]), "static")
        builder = self.scene.create_actor_builder()
        builder.add_box_collision(half_size=BOX, material=self.material)
        builder.initial_pose = sapien.Pose([0, 0, 0.06])
        self.a = builder.build("a")
        self.b = box(self, "b", BOX, sapien.Pose([0.2, 0.02, 0.06]))
        self.chain = by_hand(self, 2)
        type(self).on_load(self)

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        number = torch.tensor(self.env_numbers())[env_idx]
        y = torch.stack([torch.zeros(len(env_idx)), 0.01 * number, torch.full((len(env_idx),), 0.06)], dim=1)
        self.a.set_pose(Pose.create_from_pq(y))
        self.a.set_linear_velocity(torch.tensor([2.0, 0.0, 0.0]))
        self.a.set_angular_velocity(torch.tensor([[0.0, 0.0, 1.0]]))
        self.b.set_pose(sapien.Pose([0.2, 0.02, 0.06]))
        self.chain.set_qpos(torch.tensor([0.2, 0.3]))

    def _before_control_step(self) -> None:
        type(self).on_step(self)
