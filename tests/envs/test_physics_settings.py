"""Each physics setting that a task may change has an effect, and the same effect as in a stock env."""

# ManiSkill annotates an env's members as the widest thing they may be, and vectors as tuples.
# pyright: reportAttributeAccessIssue=false, reportOptionalMemberAccess=false, reportArgumentType=false
# pyright: reportOptionalIterable=false

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import sapien
import sapien.physx as physx
import torch
from mani_skill.utils.structs.types import SceneConfig, SimConfig

from tests.envs.collision import Collision
from tests.envs.stock_env import batch_of, follow
from workbench.envs.broken_rule import RuleWarning

pytestmark = pytest.mark.thorough

STEPS = 15


def drive_between_actors(env: Any) -> None:
    drive = env.scene.create_drive(env.a, sapien.Pose([0.1, 0, 0]), env.b, sapien.Pose([-0.1, 0, 0]))
    drive.set_drive_property_x(stiffness=50, damping=5)
    drive.set_drive_property_y(stiffness=50, damping=5)
    drive.set_limit_z(0, 0)


def drive_between_a_link_and_an_actor(env: Any) -> None:
    drive = env.scene.create_drive(env.chain.links[-1], sapien.Pose(), env.b, sapien.Pose())
    drive.set_drive_property_x(stiffness=20, damping=2)
    drive.set_drive_property_z(stiffness=20, damping=2)


def no_collision_between_the_boxes(env: Any) -> None:
    for actor in (env.a, env.b):
        actor.set_collision_group_bit(group=2, bit_idx=28, bit=1)


def joint_drives(env: Any) -> None:
    for joint in env.chain.active_joints:
        joint.set_drive_properties(stiffness=30, damping=3, force_limit=4)


def joint_properties(env: Any) -> None:
    for joint in env.chain.active_joints:
        joint.set_friction(0.5)
        joint.set_limits(np.array([[-0.1, 0.4]]))


def mass_of_every_body(env: Any) -> None:
    # One body at a time, as a task sets a different mass in each env.
    for number, body in zip(env.env_numbers(), env.a._bodies):
        body.mass = 2.0 + number


def friction_of_every_shape(env: Any) -> None:
    for body in [*env.a._bodies, *env.b._bodies]:
        for shape in body.collision_shapes:
            shape.physical_material = physx.PhysxMaterial(1.5, 1.5, 0.5)


def push(env: Any) -> None:
    env.a.apply_force(
        np.array([0.0, 3.0, 0.0], np.float32) if env.num_envs == 1 else torch.tensor([0.0, 3.0, 0.0])
    )


def joint_forces(env: Any) -> None:
    env.chain.set_qf(torch.tensor([0.5, -0.2]))
    env.apply()


def drive_targets(env: Any) -> None:
    joints = env.chain.active_joints
    env.chain.set_joint_drive_targets(torch.full((env.num_envs, 2), -0.5), joints)
    env.chain.set_joint_drive_velocity_targets(torch.full((env.num_envs, 2), 0.1), joints)
    env.apply()


def new_velocity(env: Any) -> None:
    env.b.set_linear_velocity(torch.tensor([0.0, -0.5, 0.0]))
    env.b.set_angular_velocity(torch.tensor([0.0, 0.0, 2.0]))
    env.chain.set_qvel(torch.tensor([0.1, 0.2]))
    env.apply()


SIM_CONFIGS = {
    "frequencies": SimConfig(sim_freq=240, control_freq=40),
    "gravity": SimConfig(scene_config=SceneConfig(gravity=np.array([0.0, 1.0, -3.0]))),
    "solver": SimConfig(scene_config=SceneConfig(solver_position_iterations=1, solver_velocity_iterations=4)),
    "contact offset": SimConfig(scene_config=SceneConfig(contact_offset=0.001, bounce_threshold=0.1)),
    "solver kind": SimConfig(scene_config=SceneConfig(enable_tgs=False, enable_pcm=False)),
}
CHANGES: dict[str, dict[str, Any]] = {
    "mass": {"on_load": lambda env: env.a.set_mass(20.0)},
    "mass of every body": {"on_load": mass_of_every_body},
    "no gravity": {"on_load": lambda env: env.a.set_disable_gravity(True)},
    "no gravity for links": {
        "on_load": lambda env: [link.set_disable_gravity(True) for link in env.chain.links]
    },
    "linear damping": {"on_load": lambda env: env.a.set_linear_damping(5.0)},
    "angular damping": {"on_load": lambda env: env.a.set_angular_damping(50.0)},
    "locked axes": {
        "on_load": lambda env: env.a.set_locked_motion_axes([False, True, False, True, True, True])
    },
    "friction": {"on_load": friction_of_every_shape},
    "no collision": {"on_load": no_collision_between_the_boxes},
    "drive between actors": {"on_load": drive_between_actors},
    "drive between a link and an actor": {"on_load": drive_between_a_link_and_an_actor},
    "joint drives": {"on_load": joint_drives},
    "joint friction and limits": {"on_load": joint_properties},
    "force": {"on_step": push},
    "joint forces": {"on_step": joint_forces},
    "velocities": {"on_step": new_velocity},
    "drive targets": {"on_load": joint_drives, "on_step": drive_targets},
    **{
        name: {"_default_sim_config": property(lambda self, config=config: config)}
        for name, config in SIM_CONFIGS.items()
    },
}


@pytest.fixture(scope="module")
def unchanged() -> torch.Tensor:
    env = follow(Collision, steps=STEPS)
    state = env.get_state()
    env.close()
    return state


@pytest.mark.parametrize("change", CHANGES)
def test_a_setting_changes_the_motion_of_every_env_as_in_a_stock_env(
    change: str, unchanged: torch.Tensor
) -> None:
    members = {name: f if isinstance(f, property) else staticmethod(f) for name, f in CHANGES[change].items()}
    env = follow(type("Changed", (Collision,), members), steps=STEPS)
    least = 1e-6 if change in SIM_CONFIGS else 1e-4
    assert bool(((env.get_state() - unchanged).abs() > least).any(dim=1).all()), "the change changed nothing"
    if change == "drive targets":
        assert torch.equal(env.chain.drive_targets, torch.full((3, 2), -0.5))
        assert torch.equal(env.chain.drive_velocities, torch.full((3, 2), 0.1))
    env.close()


def test_settings_that_a_running_gpu_refuses_warn_at_their_line() -> None:
    env = batch_of(Collision, 3)
    for change in (
        lambda: env.a.set_mass(2.0),
        lambda: env.a.set_disable_gravity(True),
        lambda: env.a.set_linear_damping(1.0),
        lambda: env.a.set_locked_motion_axes([True] * 6),
        lambda: env.chain.active_joints[0].set_limits([[0, 1]]),
        lambda: env.chain.compute_passive_force(),
        lambda: env.chain.create_pinocchio_model(),
        lambda: env.b.remove_from_scene(),
        lambda: env.scene.remove_articulation(env.chain),
    ):
        with pytest.warns(RuleWarning, match="on the GPU this fails") as warned:
            change()
        assert __file__ in {warning.filename for warning in warned}
    assert env.a.mass.tolist() == [2.0] * 3
    env.close()
