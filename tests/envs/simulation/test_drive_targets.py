"""Drive targets that an author sets in different hooks, for some joints and envs."""

from __future__ import annotations

from typing import Any

import pytest
import sapien
import torch
from mani_skill.envs.tasks.tabletop.push_cube import PushCubeEnv

from tests.drive.envs import batched
from workbench.envs.broken_rule import RuleWarning
from workbench.envs.task_env import TaskEnv

pytestmark = pytest.mark.thorough

N = 4


class Door(PushCubeEnv):
    """PushCube with a door on a driven hinge."""

    where = ""
    one_joint = False
    velocity = False

    def _load_scene(self, options: dict) -> None:
        super()._load_scene(options)
        builder = self.scene.create_articulation_builder()
        root = builder.create_link_builder()
        root.set_name("frame")
        root.add_box_collision(half_size=(0.02, 0.02, 0.02))
        leaf = builder.create_link_builder(root)
        leaf.set_name("leaf")
        leaf.add_box_collision(pose=sapien.Pose([0.1, 0, 0]), half_size=(0.02, 0.02, 0.02))
        leaf.set_joint_name("hinge")
        leaf.set_joint_properties("revolute", [[-2, 2]], sapien.Pose(), sapien.Pose())
        builder.initial_pose = sapien.Pose([0, 1, 1])
        self.door = builder.build("door", fix_root_link=True)
        self.hinge = self.door.active_joints[0]
        self.hinge.set_drive_properties(100, 10)
        self.drive("_load_scene", self.num_envs)

    def _after_reconfigure(self, options: dict) -> None:
        super()._after_reconfigure(options)
        self.drive("_after_reconfigure", self.num_envs)

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        super()._initialize_episode(env_idx, options)
        self.drive("_initialize_episode", len(env_idx))

    def drive(self, where: str, rows: int) -> None:
        if where != self.where:
            return
        door: Any = self.door
        if self.one_joint and self.velocity:
            self.hinge.set_drive_velocity_target(torch.full((rows,), 0.5))
        elif self.one_joint:
            self.hinge.set_drive_target(torch.full((rows,), 0.5))
        elif self.velocity:
            door.set_joint_drive_velocity_targets(torch.full((rows, 1), 0.5), joints=[self.hinge])
        else:
            door.set_joint_drive_targets(torch.full((rows, 1), 0.5), joints=[self.hinge])


def door_task(**attributes: Any) -> TaskEnv:
    task = type("Door", (Door,), attributes)
    return TaskEnv(batched(task, N))


@pytest.mark.parametrize(("one_joint", "velocity"), [(True, True), (False, False)])
def test_a_target_set_while_the_scene_is_built_warns_and_names_the_right_hooks(
    one_joint: bool, velocity: bool
) -> None:
    with pytest.warns(RuleWarning, match="'door' is set while the scene is built: .* in _after_reconfigure"):
        door_task(where="_load_scene", one_joint=one_joint, velocity=velocity).close()


@pytest.mark.filterwarnings("ignore::workbench.envs.broken_rule.RuleWarning")
@pytest.mark.parametrize("one_joint", [True, False])
@pytest.mark.parametrize("where", ["_load_scene", "_after_reconfigure", "_initialize_episode"])
def test_a_target_set_in_any_hook_drives_the_joint(where: str, one_joint: bool) -> None:
    task = door_task(where=where, one_joint=one_joint)
    env: Any = task.env
    task.reset(seed=0)
    task.reset(env_idx=[1, 2])
    for _ in range(30):
        task.step(None)
    assert torch.allclose(env.door.qpos, torch.full((N, 1), 0.5), atol=0.05)
    task.close()
