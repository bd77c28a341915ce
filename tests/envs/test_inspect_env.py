"""The inspectors' values equal those of SAPIEN's objects and ManiSkill's tensors."""

# ManiSkill annotates an env's members as the widest thing they may be.
# pyright: reportAttributeAccessIssue=false, reportOptionalMemberAccess=false, reportArgumentType=false
# pyright: reportOptionalIterable=false, reportOptionalSubscript=false, reportGeneralTypeIssues=false, reportCallIssue=false

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import mani_skill.envs  # noqa: F401 (registers the tasks)
import numpy as np
import pytest
import sapien
import sapien.physx as physx
import torch

from tests.drive.envs import PICK_CUBE, batched
from tests.envs.by_hand import BOX, box, by_hand
from tests.envs.stock_env import Bare
from workbench.envs import action_vector as actions
from workbench.envs import maniskill_private
from workbench.envs.inspect_env import MAX_VALUES, inspect_env, list_contacts
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
        assert read.kinds == tuple(joint.type for joint in own.active_joints) and len(set(read.kinds)) > 1
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


class Various(Bare):
    """Envs that differ: masses, a box in env 1 only, and entries of the state and the observation. A third box hovers."""

    def _load_scene(self, options: dict) -> None:
        box(self, "floor", [3, 3, 0.1], sapien.Pose([0, 0, -0.1]), "static")
        self.light = box(self, "light", pose=sapien.Pose([1, 0, 0.0499]))
        builder = self.scene.create_actor_builder()
        for z in (0, 0.004):  # the second shape is only near the floor
            builder.add_box_collision(sapien.Pose([0.2 * (z > 0), 0, z]), half_size=BOX)
        builder.initial_pose = sapien.Pose([0, 0, 0.0499])
        self.heavy = builder.build("heavy")
        for number, body in enumerate(self.heavy._bodies):
            body.mass = 5.0 + number
        # Nearer than the contact offsets: PhysX lists the pair.
        self.hovers = box(self, "hovers", pose=sapien.Pose([0, 1, 0.055]))
        self.hovers.set_disable_gravity(True)
        builder = self.scene.create_actor_builder()
        for z, friction in ((0.0, 0.1), (0.2, 0.4)):
            material = physx.PhysxMaterial(friction, friction + 0.1, friction + 0.2)
            builder.add_box_collision(sapien.Pose([0, 0, z]), half_size=BOX, material=material)
        builder.initial_pose = sapien.Pose([2, 0, 30])
        builder.set_scene_idxs([1])
        self.rare = builder.build("rare")
        self.chain = by_hand(self, 2)
        self.chain.active_joints[1].set_drive_properties(50, 5)

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        self.chain.set_qpos(torch.stack([0.1 * env_idx, -0.1 * env_idx], dim=1))

    def get_state_dict(self) -> Any:
        memory = {"best": torch.arange(3.0) + 1, "limit": torch.tensor(7), "counts": torch.arange(5)}
        return {**super().get_state_dict(), "memory": memory}

    def _get_obs_extra(self, info: dict) -> dict:
        number = torch.arange(3.0)[:, None]
        return {"number": torch.cat([number, -number], dim=1), "many": torch.zeros(3, 10, 10)}


@pytest.fixture(scope="module")
def various() -> Iterator[TaskEnv]:
    task = TaskEnv(batched(Various, 3, obs_mode="state_dict"))
    task.reset(seed=0)
    for _ in range(20):
        task.step(None)
    task.reset(env_idx=[2])
    task.step(None)
    yield task
    task.close()


@pytest.mark.parametrize("env", range(3))
def test_each_section_is_that_of_the_env(various: TaskEnv, env: int) -> None:
    read = inspect_env(various, env, SECTIONS, "heavy")
    own: Any = various.env
    assert (read.env, read.elapsed_steps, read.refused) == (env, (21, 21, 1)[env], ())
    state = by_name(read.state)
    assert state["memory/best"] == env + 1 and state["memory/limit"] == 7
    assert np.isnan(state["memory/counts"]), "five numbers are no rows of three envs"
    assert {name for name in state if "rare" in name} == (
        {f"actors/rare/{part}" for part in "pqvw"} if env == 1 else set()
    )
    whole = own.heavy.get_state()[env], own.chain.get_state()[env]
    for struct, row in zip(("actors/heavy/", "articulations/chain/"), whole, strict=True):
        parts = [values for name, values in state.items() if name.startswith(struct)]
        assert np.concatenate(parts).tolist() == row.tolist()
    observed = {leaf.name: leaf for leaf in read.observation}
    number = observed["extra/number"]
    assert number.values.tolist() == [env, -env] and (number.low, number.high) == (-env, env)
    assert observed["extra/many"].shape == (10, 10) and len(observed["extra/many"].values) == MAX_VALUES
    [joints] = read.joints
    chain = own.chain._objs[env]
    np.testing.assert_array_equal(joints.position, chain.qpos)
    np.testing.assert_array_equal(joints.velocity, chain.qvel)
    np.testing.assert_allclose(np.stack([joints.low, joints.high]), [[-2, -2], [2, 2]])
    assert np.isnan(joints.target).tolist() == [True, False], "only one joint has a drive"
    assert joints.names == ("hinge0", "hinge1") and set(joints.kinds) == {"revolute"}
    body = own.heavy._bodies[env]
    assert read.body.mass == pytest.approx(5 + env) and read.body.has_gravity
    np.testing.assert_array_equal(read.body.velocity, body.linear_velocity)
    np.testing.assert_allclose(read.body.centre_of_mass, body.cmass_local_pose.p, atol=1e-6)
    rare = inspect_env(various, env, [], "rare").body
    assert (rare is None) == (env != 1)
    if rare is not None:
        assert [material[0] for material in rare.materials] == pytest.approx([0.1, 0.4])
        np.testing.assert_allclose(rare.centre_of_mass, [0, 0, 0.1], atol=1e-6)
    hovers = inspect_env(various, env, [], "hovers").body
    assert hovers is not None and not hovers.has_gravity


@pytest.mark.parametrize("env", range(2))
def test_bodies_that_touch_are_listed_by_force_without_those_that_are_only_near(
    various: TaskEnv, env: int
) -> None:
    touching = inspect_env(various, env, ["contacts"]).contacts
    assert [pair.bodies for pair in touching] == [("floor", "heavy"), ("floor", "light")]
    assert touching[0].force[2] == pytest.approx(-9.81 * (5 + env), rel=0.05), "on the first, by the second"
    listed = [contact.bodies for contact in list_contacts(various.env, env)]
    assert any("hovers" in bodies for bodies in listed), (
        "the hovering box must be near, or this proves nothing"
    )
    for pair in touching:
        own = [c for c in list_contacts(various.env, env) if set(c.bodies) == set(pair.bodies)]
        assert pair.separation == min(float(contact.separations.min()) for contact in own)
        assert sorted(map(tuple, pair.points)) == sorted(tuple(p) for contact in own for p in contact.points)
