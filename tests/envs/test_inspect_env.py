"""The inspectors' values equal those of SAPIEN's objects and ManiSkill's tensors."""

# ManiSkill annotates an env's members as the widest thing they may be.
# pyright: reportAttributeAccessIssue=false, reportOptionalMemberAccess=false, reportArgumentType=false
# pyright: reportOptionalIterable=false, reportOptionalSubscript=false, reportGeneralTypeIssues=false

from __future__ import annotations

from typing import Any

import mani_skill.envs  # noqa: F401 (registers the tasks)
import numpy as np
import pytest
import sapien.physx as physx
import torch

from tests.drive.envs import PICK_CUBE, batched
from workbench.envs import action_vector as actions
from workbench.envs import maniskill_private
from workbench.envs.inspect_env import inspect_env
from workbench.envs.inspection import SECTIONS
from workbench.envs.scene.scene_index import scene_index
from workbench.envs.simulation.cpu_system import batched_system
from workbench.envs.task_env import TaskEnv


def opened(task: str | type, num_envs: int = 3, steps: int = 4, **kwargs: Any) -> TaskEnv:
    env = TaskEnv(batched(task, num_envs, **kwargs))
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(steps):
        env.step(actions.random_action(env.parts, num_envs, rng))
    return env


def by_name(leaves: Any) -> dict[str, np.ndarray]:
    return {leaf.name: leaf.values.reshape(leaf.shape) for leaf in leaves}


@pytest.fixture(scope="module")
def pick() -> TaskEnv:
    return opened("PickCube-v1")


def test_joints_equal_sapiens(pick: TaskEnv) -> None:
    robots = pick.env.agent.robot
    for env in range(3):
        own = maniskill_private.objects_of(robots)[env]
        [read] = inspect_env(pick, env, ["joints"]).joints
        assert read.articulation == "panda" and read.names[0] == "panda_joint1" and len(read.names) == 9
        np.testing.assert_array_equal(read.position, own.qpos)
        np.testing.assert_array_equal(read.velocity, own.qvel)
        np.testing.assert_allclose(np.stack([read.low, read.high], 1), own.qlimits, rtol=1e-6)
        np.testing.assert_array_equal(read.target, [joint.drive_target[0] for joint in own.active_joints])
    assert not np.array_equal(
        inspect_env(pick, 0, ["joints"]).joints[0].position,
        inspect_env(pick, 1, ["joints"]).joints[0].position,
    )


def test_a_bodys_properties_equal_sapiens(pick: TaskEnv) -> None:
    for env in range(3):
        cube = maniskill_private.objects_of(pick.env.cube)[env].find_component_by_type(
            physx.PhysxRigidDynamicComponent
        )
        read = inspect_env(pick, env, [], "cube").body
        assert (read.mass, read.shapes, read.has_gravity) == (cube.mass, ("box",), True)
        np.testing.assert_array_equal(read.inertia, cube.inertia)
        np.testing.assert_array_equal(read.velocity, cube.linear_velocity)
        np.testing.assert_array_equal(read.angular_velocity, cube.angular_velocity)
        material = cube.collision_shapes[0].physical_material
        wanted = material.static_friction, material.dynamic_friction, material.restitution
        assert read.materials == (wanted,)
    table = inspect_env(pick, 0, [], "table-workspace").body
    assert table.shapes == ("box",)
    ground = inspect_env(pick, 0, [], "ground").body
    assert ground.mass is None and ground.velocity is None and ground.shapes == ("plane",)
    hand = inspect_env(pick, 0, [], "panda/panda_hand").body
    assert hand.mass is not None and hand.mass > 0.1 and set(hand.shapes) == {"convex mesh"}
    assert hand.joint is None and table.joint is None, "no joint, or a fixed one"
    [link] = [
        one
        for one in maniskill_private.objects_of(pick.env.agent.robot)[0].links
        if one.name.endswith("panda_link4")
    ]
    joint = inspect_env(pick, 0, [], "panda/panda_link4").body.joint
    assert (joint.name, joint.kind) == ("panda_joint4", link.joint.type)
    np.testing.assert_allclose([joint.low, joint.high], link.joint.limits[0], rtol=1e-6)
    in_view = link.entity_pose.to_transformation_matrix()
    np.testing.assert_allclose(
        in_view[:3, :3] @ joint.axis, link.joint.global_pose.to_transformation_matrix()[:3, 0], atol=1e-5
    )
    np.testing.assert_allclose(
        in_view[:3, :3] @ joint.origin + in_view[:3, 3], link.joint.global_pose.p, atol=1e-5
    )
    assert inspect_env(pick, 0, [], "nothing").body is None and inspect_env(pick, 0, []).body is None


def test_contacts_add_up_to_sapiens(pick: TaskEnv) -> None:
    for env in range(3):
        own: dict[frozenset[str], np.ndarray] = {}
        for contact in batched_system(pick.env.scene).systems[env].get_contacts():
            first, second = (str(scene_index(pick.env).name_of(body)) for body in contact.bodies)
            impulse = sum((np.array(point.impulse) for point in contact.points), np.zeros(3))
            sign = 1 if first <= second else -1
            pair = frozenset((first, second))
            own[pair] = own.get(pair, np.zeros(3)) + sign * impulse
        touching = {pair: impulse for pair, impulse in own.items() if np.any(impulse)}
        read = inspect_env(pick, env, ["contacts"]).contacts
        assert touching.keys() <= {frozenset(pair.bodies) for pair in read}
        for pair in read:
            np.testing.assert_allclose(pair.impulse, own[frozenset(pair.bodies)], atol=1e-6)
            np.testing.assert_allclose(pair.forces.sum(axis=0), pair.force, rtol=1e-4, atol=1e-5)
            assert pair.points.shape == pair.forces.shape
    cube = next(pair for pair in inspect_env(pick, 0, ["contacts"]).contacts if "cube" in pair.bodies)
    # The table holds the cube up.
    weight = 9.81 * float(pick.env.cube.mass[0])
    sign = 1 if cube.bodies[0] == "cube" else -1
    assert sign * cube.force[2] == pytest.approx(weight, rel=0.05)


def test_a_flat_observation_is_split_under_its_original_names(pick: TaskEnv) -> None:
    for env in (0, 2):
        read = by_name(inspect_env(pick, env, ["observation"]).observation)
        assert (
            np.concatenate([values.reshape(-1) for values in read.values()]).tolist()
            == pick.obs[env].tolist()
        )
        np.testing.assert_array_equal(read["agent/qpos"], pick.env.agent.robot.get_qpos()[env])
        np.testing.assert_array_equal(read["extra/obj_pose"], pick.env.cube.pose.raw_pose[env])
        assert read["extra/is_grasped"].shape == (1,)


def test_the_state_dict_is_split_into_named_quantities(pick: TaskEnv) -> None:
    state = pick.env.get_state_dict()
    read = by_name(inspect_env(pick, 1, ["state"]).state)
    np.testing.assert_array_equal(read["actors/cube/p"], state["actors"]["cube"][1, :3])
    np.testing.assert_array_equal(read["actors/cube/w"], state["actors"]["cube"][1, 10:13])
    np.testing.assert_array_equal(read["articulations/panda/qvel"], state["articulations"]["panda"][1, -9:])


def test_inspecting_does_not_change_the_episode() -> None:
    class Counting(PICK_CUBE):
        """Hooks draw random numbers and count their calls, as some tasks' do."""

        calls = 0

        def evaluate(self) -> dict:
            self.calls += 1
            return super().evaluate()

        def _get_obs_extra(self, info: dict) -> dict:
            noise = torch.rand(self.num_envs, 1)
            count = torch.full((self.num_envs, 1), float(self.calls))
            return {**super()._get_obs_extra(info), "noise": noise, "count": count}

    ends = []
    for looks in (False, True):
        env = opened(Counting, steps=0)
        torch.manual_seed(0)
        rng = np.random.default_rng(1)
        for _ in range(5):
            step = env.step(actions.random_action(env.parts, 3, rng))
            if looks:
                read = by_name(inspect_env(env, 1, SECTIONS).observation)
                assert read["extra/noise"] == env.obs[1, -2]
        ends.append((step.poses, env.obs))
    for plain, looked in zip(*ends, strict=True):
        np.testing.assert_array_equal(plain, looked)


def test_a_section_whose_hook_raises_leaves_the_others() -> None:
    class Broken(PICK_CUBE):
        def get_state_dict(self) -> Any:
            if getattr(self, "broken", False):
                raise KeyError("goal")
            return super().get_state_dict()

    task = opened(Broken, num_envs=1)
    task.env.broken = True
    read = inspect_env(task, 0, SECTIONS)
    assert read.state is None and dict(read.refused) == {"state": "reading it raised KeyError: 'goal'"}
    assert read.joints and read.observation
