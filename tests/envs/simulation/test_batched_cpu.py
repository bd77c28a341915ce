"""The batched CPU core behaves like ManiSkill's own single CPU env."""

# ManiSkill annotates an env's members as the widest thing they may be in any task.
# pyright: reportAttributeAccessIssue=false, reportArgumentType=false, reportCallIssue=false
# pyright: reportOptionalMemberAccess=false, reportIndexIssue=false, reportOptionalSubscript=false

from __future__ import annotations

from collections.abc import Iterator

import mani_skill.envs  # noqa: F401  registers the ids
import numpy as np
import pytest
import sapien
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils.registration import REGISTERED_ENVS
from mani_skill.utils.structs.pose import Pose

from tests.envs.stock_env import batch_of
from tests.envs.written import ThrowsAFreeChain, Written
from workbench.envs.cpu_scene import batched_class
from workbench.envs.gpu_rules import Degree

STATE_ONLY = {"obs_mode": "state", "render_backend": "none"}


def batched(env_id: str, num_envs: int, rules: Degree | None = None) -> BaseEnv:
    return batched_class(REGISTERED_ENVS[env_id].cls, rules=rules)(num_envs=num_envs, **STATE_ONLY)


@pytest.fixture(scope="module")
def pick_cubes() -> Iterator[BaseEnv]:
    env = batched("PickCube-v1", 4)
    yield env
    env.close()


def test_link_velocities_equal_sapiens(pick_cubes: BaseEnv) -> None:
    pick_cubes.reset(seed=[0, 1, 2, 3])
    for _ in range(5):
        pick_cubes.step(pick_cubes.action_space.sample())
    for link in pick_cubes.agent.robot.links:
        expected = torch.tensor(np.array([body.linear_velocity for body in link._bodies]))
        assert torch.equal(link.linear_velocity, expected)


@pytest.mark.filterwarnings("ignore:The pose of link")
@pytest.mark.parametrize("rules", ["off", None])
def test_reading_a_link_velocity_before_apply_keeps_a_root_pose_that_was_set(
    rules: Degree | None,
) -> None:
    env = batched("PickCube-v1", 2, rules)
    env.reset(seed=[0, 1])
    env.step(env.action_space.sample())
    robot, wanted = env.agent.robot, env.agent.robot.pose.raw_pose.clone()
    wanted[:, 0] -= 0.1
    fast = torch.full((2, 3), 0.5)
    robot.set_pose(Pose.create(wanted))
    robot.set_root_linear_velocity(fast)
    assert robot.links[3].linear_velocity.shape == (2, 3)
    assert torch.equal(robot.root_linear_velocity, fast)
    env.scene._gpu_apply_all()
    assert np.allclose([a.root_pose.p for a in robot._objs], wanted[:, :3], atol=1e-6)
    env.scene.px.gpu_update_articulation_kinematics()
    env.scene._gpu_fetch_all()
    assert torch.allclose(robot.pose.raw_pose, wanted, atol=1e-6)
    env.close()


def test_a_pose_with_nan_is_refused_with_the_name_of_the_body(pick_cubes: BaseEnv) -> None:
    pick_cubes.reset(seed=[0, 1, 2, 3])
    state = pick_cubes.get_state_dict()
    state["actors"]["cube"][1, 0] = float("nan")
    with pytest.raises(ValueError, match="cube"):
        pick_cubes.set_state_dict(state)
    pick_cubes.scene._needs_fetch = False
    pick_cubes.scene._gpu_fetch_all()
    px, rows = pick_cubes.scene.px, pick_cubes.cube._body_data_index
    before = px.cuda_rigid_body_data.torch().clone()
    px.cuda_rigid_body_data.torch()[rows[[0, 2]], 0] = torch.tensor([0.3, float("inf")])
    with pytest.raises(ValueError, match="cube of env 2"):
        px.gpu_apply_rigid_dynamic_data()
    px.gpu_apply_rigid_dynamic_data()  # what was refused is gone, and does not raise again
    px.gpu_fetch_rigid_dynamic_data()
    assert torch.equal(px.cuda_rigid_body_data.torch()[rows[1:]], before[rows[1:]])


@pytest.mark.filterwarnings("ignore:PhysxRigidDynamicComponent")
def test_values_computed_from_a_state_that_is_nan_are_skipped_in_its_env_only(pick_cubes: BaseEnv) -> None:
    """A task that blew up in one env computes NaN from it; the other envs continue, and a reset repairs this one."""
    pick_cubes.reset(seed=[0, 1, 2, 3])
    robot, cube = pick_cubes.agent.robot, pick_cubes.cube
    cube._bodies[1].linear_velocity = [np.nan] * 3
    pick_cubes.scene._gpu_fetch_all()
    lost = cube.linear_velocity[:, :1]
    assert lost.isnan().ravel().tolist() == [False, True, False, False]
    row = torch.cat([robot.pose.raw_pose, robot.root.linear_velocity, robot.root.angular_velocity], 1) + lost
    for by_tensor in (False, True):
        row[:, 0] += 0.25
        robot.set_qvel(robot.get_qvel() + lost)
        cube.set_pose(Pose.create(cube.pose.raw_pose + lost))
        if not by_tensor:
            robot.set_pose(Pose.create(row[:, :7]))
            robot.set_root_linear_velocity(row[:, 7:10])
        else:
            pick_cubes.scene.px.cuda_rigid_body_data.torch()[robot.root._body_data_index] = row
        pick_cubes.scene._gpu_apply_all()
        roots = np.array([articulation.root_pose.p for articulation in robot._objs])
        assert np.isfinite(roots).all()
        np.testing.assert_allclose(roots[[0, 2, 3]], row[[0, 2, 3], :3], atol=1e-6)
        pick_cubes.scene._gpu_fetch_all()
    pick_cubes.reset(seed=[0, 1, 2, 3])
    assert pick_cubes.get_state().isfinite().all()


@pytest.mark.filterwarnings("ignore::workbench.envs.broken_rule.RuleWarning")
def test_a_reset_repairs_the_bodies_that_are_nan_in_its_envs_and_no_other() -> None:
    env = batch_of(Written, 4)
    env.reset(seed=[0, 1, 2, 3])
    lies = Pose.create_from_pq(torch.tensor([[0.5 + 0.1 * i, 0, 0.05] for i in range(4)]))
    env.lies.set_pose(lies)
    env.chain.set_qpos(torch.tensor([[0.1 * i, 0.2] for i in range(4)]))
    env.apply()
    for lost in (1, 2):
        env.falls._objs[lost].set_pose(sapien.Pose([np.nan] * 3))
    env.scene.px.note_change()
    env.scene._gpu_fetch_all()
    for chosen, broken in ([1], [2]), ([1, 2], []):
        env.reset(options={"env_idx": torch.tensor(chosen)})
        finite = torch.isfinite(env.falls.pose.p).all(dim=1)
        assert torch.nonzero(~finite)[:, 0].tolist() == broken
        torch.testing.assert_close(env.falls.pose.p[1], torch.tensor([0, 0, 0.3]))
        torch.testing.assert_close(env.lies.pose.p, lies.p)  # its neighbours in the same env stay
        torch.testing.assert_close(env.chain.qpos[:, 0], 0.1 * torch.arange(4))
    env.close()


@pytest.mark.filterwarnings("ignore::workbench.envs.broken_rule.RuleWarning")
def test_forces_and_torques_of_the_tensors_push_once_and_only_their_rows() -> None:
    env = batch_of(Written, 3)
    env.reset(seed=[0, 1, 2])
    px, rows = env.scene.px, env.falls._body_data_index
    reference = batch_of(Written, 3)
    reference.reset(seed=[0, 1, 2])
    for each in (env, reference):
        each.scene.step()
        each.scene._gpu_fetch_all()
    still = reference.falls.linear_velocity, reference.falls.angular_velocity
    mass = float(env.falls.mass[0])
    px.cuda_rigid_body_force.torch()[rows[1], 0] = 100 * mass
    px.cuda_rigid_body_torque.torch()[rows[2], 1] = 0.1
    for name in ("force", "torque"):
        getattr(px, f"gpu_apply_rigid_dynamic_{name}")()
        assert not getattr(px, f"cuda_rigid_body_{name}").torch().any()
    for each in (env, reference):
        each.scene.step()
        each.scene._gpu_fetch_all()
    still = reference.falls.linear_velocity, reference.falls.angular_velocity
    pushed = env.falls.linear_velocity - still[0], env.falls.angular_velocity - still[1]
    torch.testing.assert_close(
        pushed[0], torch.tensor([[0, 0, 0], [100 * px.timestep, 0, 0], [0, 0, 0]]), atol=1e-3, rtol=0.01
    )
    assert pushed[1].abs().max(dim=1).values.gt(1e-3).tolist() == [False, False, True]
    assert pushed[1][2, 1] > 10 * pushed[1][2, [0, 2]].abs().max()
    px.gpu_apply_rigid_dynamic_force()
    for each in (env, reference):
        each.scene.step()
        each.scene._gpu_fetch_all()
    torch.testing.assert_close(
        env.falls.linear_velocity - reference.falls.linear_velocity, pushed[0], atol=1e-4, rtol=0
    )
    env.close()
    reference.close()


def test_a_velocity_of_a_kinematic_actor_is_not_passed_to_physx(pick_cubes: BaseEnv) -> None:
    pick_cubes.reset(seed=[0, 1, 2, 3])
    for actor in (pick_cubes.goal_site, pick_cubes.cube):
        actor.set_linear_velocity(torch.full((4, 3), 0.5))
    pick_cubes.scene._gpu_apply_all()
    assert not any(body.linear_velocity.any() for body in pick_cubes.goal_site._bodies)
    assert all((body.linear_velocity == 0.5).all() for body in pick_cubes.cube._bodies)


@pytest.mark.filterwarnings("ignore::workbench.envs.broken_rule.RuleWarning")
def test_values_written_to_tensors_and_applied_reach_physx() -> None:
    env = batch_of(ThrowsAFreeChain, 3)
    env.reset(seed=[0, 1, 2])
    px, rng = env.scene.px, np.random.default_rng(0)

    def drawn(width: int) -> torch.Tensor:
        return torch.from_numpy(rng.uniform(-0.5, 0.5, (3, width)).astype(np.float32))

    turned = torch.nn.functional.normalize(drawn(4))
    written = {name: torch.cat([drawn(3), turned, drawn(6)], dim=1) for name in ("falls", "free")}
    data = px.cuda_rigid_body_data.torch()
    data[env.falls._body_data_index] = written["falls"]
    data[env.free.root._body_data_index] = written["free"]
    joints = {name: drawn(2) for name in ("qpos", "qvel", "qf", "target_qpos", "target_qvel")}
    for name, values in joints.items():
        getattr(px, f"cuda_articulation_{name}").torch()[env.chain._data_index.long(), :2] = values
    env.scene._gpu_apply_all()
    px.gpu_apply_articulation_qf()
    px.gpu_apply_articulation_target_velocity()
    px.packs()  # targets are written before the next step or pack
    for i in range(3):
        body, root, chain = env.falls._bodies[i], env.free._objs[i], env.chain._objs[i]
        for moved, row in ((body, written["falls"][i]), (root, written["free"][i])):
            pose = moved.entity.pose if moved is body else moved.root_pose
            linear, angular = (
                (moved.linear_velocity, moved.angular_velocity)
                if moved is body
                else (moved.root_linear_velocity, moved.root_angular_velocity)
            )
            np.testing.assert_allclose([*pose.p, *linear, *angular], [*row[:3], *row[7:]], atol=1e-5)
            assert abs(float(pose.q @ row[3:7].numpy())) == pytest.approx(1, abs=1e-5)
        for name, got in {"qpos": chain.qpos, "qvel": chain.qvel, "qf": chain.qf}.items():
            np.testing.assert_allclose(got, joints[name][i], atol=1e-6, err_msg=name)
        for joint, target, velocity in zip(
            chain.active_joints, joints["target_qpos"][i], joints["target_qvel"][i], strict=True
        ):
            assert (joint.drive_target[0], joint.drive_velocity_target[0]) == (target, velocity)
    env.close()
