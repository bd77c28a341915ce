"""Tasks that set different numbers in each env, to compare a batch with single envs."""

# ManiSkill annotates an env's members as the widest thing they may be in any task.
# pyright: reportAttributeAccessIssue=false, reportArgumentType=false, reportCallIssue=false

from __future__ import annotations

from typing import Any

import numpy as np
import sapien
import torch
from mani_skill.utils.structs.pose import Pose

from tests.envs.by_hand import box, by_hand
from tests.envs.stock_env import Bare


class Written(Bare):
    """A falling box, a box at rest on the floor, a marker, a wall and a chain; numbers differ by env."""

    def _load_scene(self, options: dict) -> None:
        self.floor = box(self, "floor", [3, 3, 0.1], sapien.Pose([0, 0, -0.1]), "static")
        self.wall = box(self, "wall", pose=sapien.Pose([0.5, 0.5, 0.05]), kind="static")
        self.falls = box(self, "falls", pose=sapien.Pose([0, 0, 0.3]))
        self.lies = box(self, "lies", pose=sapien.Pose([0.5, 0, 0.05]))
        builder = self.scene.create_actor_builder()
        builder.initial_pose = sapien.Pose([0, 0, 2])
        self.marker = builder.build_kinematic("marker")
        self.chain = by_hand(self, 2)
        self.last, (self.first_joint, self.second_joint) = self.chain.links[-1], self.chain.active_joints
        self.seen: dict[str, torch.Tensor] = {}
        self.built()

    def built(self) -> None:
        pass

    def see(self, **values: Any) -> None:
        """Store values, (N, ...) each, for the comparison."""
        self.seen.update({name: torch.as_tensor(np.asarray(value)) for name, value in values.items()})

    def per_env(self, env_idx: torch.Tensor | None, *columns: tuple[float, float]) -> torch.Tensor:
        """Return (b, W): for each column ``(start, step)`` and env, start + env index * step."""
        numbers = torch.tensor(self.env_numbers(), dtype=torch.float32)
        numbers = numbers if env_idx is None else numbers[env_idx]
        return torch.stack([start + step * numbers for start, step in columns], dim=1)

    def place(self, env_idx: torch.Tensor | None, height: float = 0.1) -> Pose:
        return Pose.create_from_pq(self.per_env(env_idx, (0, 0.02), (0, 0), (height, 0.01)))


class ThrowsAFreeChain(Written):
    def built(self) -> None:
        self.free = by_hand(self, 1, "free", fixed=False)

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        self.free.set_pose(Pose.create_from_pq(self.per_env(env_idx, (-0.5, 0.1), (0.5, 0.1), (0.8, 0.1))))
        self.free.set_root_linear_velocity(self.per_env(env_idx, (0.1, 0.1), (0.2, 0), (0.3, -0.1)))
        self.free.set_root_angular_velocity(self.per_env(env_idx, (1, 0.2), (2, 0.1), (-3, 0.1)))

    def evaluate(self) -> dict:
        self.see(linear=self.free.root_linear_velocity, angular=self.free.root_angular_velocity)
        return {}
