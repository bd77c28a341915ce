"""Tasks written for ManiSkill's single CPU env: each env of a batch equals that env bit for bit.

They set and read state while the scene is built, step and read links within a reset, move static actors, bypass the
tensors, change masses, and neither apply nor fetch. A GPU behaves differently or refuses: rules warn (`test_strict`).
"""

# ManiSkill annotates an env's members as the widest thing they may be in any task.
# pyright: reportAttributeAccessIssue=false, reportArgumentType=false, reportCallIssue=false

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import sapien
import torch
from mani_skill.utils.structs.pose import Pose

from tests.envs.by_hand import box
from tests.envs.stock_env import batch_of, single
from tests.envs.written import ThrowsAFreeChain, Written

pytestmark = [
    pytest.mark.thorough,
    pytest.mark.filterwarnings("ignore::workbench.envs.broken_rule.RuleWarning"),
]
STEPS = 4


class ReadsWhileBuilt(Written):
    def built(self) -> None:
        chain = self.chain
        self.see(pose=self.falls.pose.raw_pose, velocity=self.falls.linear_velocity, wall=self.wall.pose.p)
        self.see(
            qpos=chain.qpos, qvel=chain.qvel, qf=chain.qf, root=chain.pose.raw_pose, link=self.last.pose.p
        )
        self.see(joint=self.first_joint.qpos, targets=chain.drive_targets, state=chain.get_state())
        self.see(bounds=[mesh.bounds for mesh in chain.get_collision_meshes()])


class WritesWhileBuilt(Written):
    def built(self) -> None:
        self.chain.set_qpos(self.per_env(None, (0.1, 0.02), (0.2, 0.01)))
        self.see(link=self.last.pose.raw_pose)
        self.chain.set_qvel(self.per_env(None, (0.1, 0.02), (0.2, 0.01)))
        self.chain.set_qf(self.per_env(None, (0.01, 0.002), (0.02, 0.001)))
        self.falls.set_pose(sapien.Pose([0, 0, 1]))
        self.falls.set_linear_velocity(self.per_env(None, (1, 0.1), (0, 0.2), (0, 0)))
        self.falls.set_angular_velocity([1, 2, 3])
        self.lies.set_pose(self.place(None))
        self.wall.set_pose(sapien.Pose([0.6, 0.6, 0.05]))
        self.first_joint.set_drive_properties(10, 1)
        self.first_joint.set_drive_target(0.3)
        self.second_joint.set_drive_properties(10, 1)
        self.second_joint.set_drive_velocity_target(0.1)
        self.see(pose=self.falls.pose.raw_pose, velocity=self.falls.linear_velocity, qvel=self.chain.qvel)
        self.see(qf=self.chain.qf, wall=self.wall.pose.p)

    def _after_reconfigure(self, options: dict) -> None:
        self.see(pose_then=self.falls.pose.raw_pose, velocity_then=self.falls.linear_velocity)
        self.see(qpos_then=self.chain.qpos, qvel_then=self.chain.qvel, qf_then=self.chain.qf)


class TargetsWhileBuilt(Written):
    def built(self) -> None:
        for joint in self.chain.active_joints:
            joint.set_drive_properties(50, 5)
        targets = self.per_env(None, (0.3, 0.1), (0.2, 0.1))
        self.chain.set_joint_drive_targets(targets, joints=self.chain.active_joints)
        self.chain.set_joint_drive_velocity_targets(-0.5 * targets, joints=self.chain.active_joints)
        self.see(targets=self.chain.drive_targets, velocities=self.chain.drive_velocities)


class TargetsAfterTheBuild(TargetsWhileBuilt):
    def _after_reconfigure(self, options: dict) -> None:
        self.chain.set_joint_drive_targets(
            self.per_env(None, (0.4, 0.2), (0.1, 0.3)), self.chain.active_joints
        )
        self.second_joint.set_drive_velocity_target(0.2)


class TargetsInReset(TargetsWhileBuilt):
    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        targets = self.per_env(env_idx, (0.4, 0.2), (0.1, 0.3))
        self.chain.set_joint_drive_targets(targets, joints=self.chain.active_joints)


class StepsWhileBuilt(Written):
    def built(self) -> None:
        for _ in range(5):
            self.scene.step()
        self.see(pose=self.falls.pose.raw_pose, qpos=self.chain.qpos)


class SettlesInReset(Written):
    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        self.falls.set_pose(self.place(env_idx))
        self.chain.set_qpos(self.per_env(env_idx, (0.3, 0.1), (-0.2, 0.1)))
        for _ in range(10):
            self.scene.step()
        self.see(pose=self.falls.pose.raw_pose, velocity=self.falls.linear_velocity)
        self.see(qpos=self.chain.qpos, link=self.last.pose.raw_pose)
        self.lies.set_pose(Pose.create_from_pq(self.falls.pose.p[env_idx] + torch.tensor([0, 0, 0.2])))
        self.scene.px.step()


class StepsTheEnvInReset(Written):
    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        self.falls.set_pose(self.place(env_idx))
        self.step(None)
        self.see(pose=self.falls.pose.raw_pose, elapsed=self.elapsed_steps)


class StepsAfterReset(Written):
    def reset(self, *args: Any, **kwargs: Any) -> Any:
        result = super().reset(*args, **kwargs)
        for _ in range(4):
            self.scene.step()
        self.see(pose=self.falls.pose.raw_pose)
        return result


class ReadsLinksInReset(Written):
    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        self.chain.set_qpos(self.per_env(env_idx, (0.3, 0.1), (-0.2, 0.1)))
        self.falls.set_pose(Pose.create_from_pq(self.last.pose.p[env_idx]))
        self.chain.set_pose(Pose.create_from_pq(self.per_env(env_idx, (-0.5, 0.1), (0, 0.1), (0.5, 0.1))))
        self.see(link=self.last.pose.raw_pose, root=self.chain.pose.raw_pose)


class WritesInEvaluate(Written):
    def evaluate(self) -> dict:
        self.marker.set_pose(Pose.create_from_pq(self.falls.pose.p + torch.tensor([0, 0, 0.1])))
        self.lies.set_linear_velocity(torch.tensor([0.1, 0, 0]).repeat(self.num_envs, 1))
        self.see(marker=self.marker.pose.raw_pose)
        return {}


class WritesAndReadsBetweenSubsteps(Written):
    def built(self) -> None:
        self.first_joint.set_drive_properties(20, 2)

    def _before_control_step(self) -> None:
        self.falls.set_linear_velocity([0.1, 0, 0])
        self.first_joint.set_drive_target(0.2)

    def _before_simulation_step(self) -> None:
        self.chain.set_qf(self.chain.qpos * 0.1)

    def _after_simulation_step(self) -> None:
        self.marker.set_pose(self.last.pose)
        self.see(marker=self.marker.pose.raw_pose, qpos=self.chain.qpos)

    def _after_control_step(self) -> None:
        self.see(pose=self.lies.pose.raw_pose, link=self.last.pose.raw_pose)


class MovesAStaticActor(Written):
    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        self.wall.set_pose(self.place(env_idx, 0.05))
        self.falls.set_pose(self.place(env_idx, 0.2))
        self.see(wall=self.wall.pose.raw_pose)


class WritesPastTheTensors(Written):
    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        for env, entity in enumerate(self.falls._objs):  # all envs, including those that are not being reset
            entity.set_pose(sapien.Pose([0.1 * self.env_numbers()[env], 0, 0.1]))
            self.chain._objs[env].set_qpos(np.array([0.1 * self.env_numbers()[env], 0.2], np.float32))
            self.lies._bodies[env].linear_velocity = [0.1, 0, 0]
            self.wall._objs[env].set_pose(sapien.Pose([0.5 + 0.1 * self.env_numbers()[env], 0.5, 0.05]))
        self.see(pose=self.falls.pose.raw_pose, link=self.last.pose.p, velocity=self.lies.linear_velocity)
        self.see(wall=self.wall.pose.raw_pose)


class ReadsPastTheTensors(Written):
    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        self.falls.set_pose(self.place(env_idx))
        self.chain.set_qpos(self.per_env(env_idx, (0.3, 0.1), (-0.2, 0.1)))
        self.see(pose=[entity.pose.p for entity in self.falls._objs])
        self.see(
            qpos=[chain.qpos for chain in self.chain._objs], link=[x.entity_pose.p for x in self.last._objs]
        )


class GivesRowsOfAllEnvs(Written):
    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        self.falls.set_pose(self.place(None))
        self.falls.set_linear_velocity(self.per_env(None, (0, 0.1), (0, 0), (0, 0)))
        self.chain.set_qpos(self.per_env(None, (0.3, 0.1), (-0.2, 0.1)))


class SetsJointsOneByOne(Written):
    def built(self) -> None:
        for joint in self.chain.active_joints:
            joint.set_drive_properties(50, 5)

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        numbers = self.per_env(env_idx, (0.2, 0.1))[:, 0]
        self.chain.set_qpos(torch.zeros((len(env_idx), 2)))
        self.second_joint.qpos = numbers if self.num_envs > 1 else numbers[0]
        self.first_joint.set_drive_target(numbers)
        self.second_joint.set_drive_velocity_target(numbers)
        self.see(qpos=self.chain.qpos)


class ChangesWhatIsFixedOnTheGpu(Written):
    """Sets the same numbers in all envs, since ManiSkill's setters take one value."""

    resets = 0

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        self.resets += 1
        self.falls.set_mass(2.0)
        self.falls.set_linear_damping(0.3)
        self.lies.set_disable_gravity(True)
        self.lies.set_locked_motion_axes([False] * 5 + [True])
        self.first_joint.set_friction(0.2)
        self.first_joint.set_drive_properties(10, 1)
        self.first_joint.set_drive_target(0.3)
        self.second_joint.set_limits([[-1, 1]])
        self.see(mass=self.falls.mass, sleeps=np.ravel(self.lies.is_sleeping))


class ComputesPassiveForces(Written):
    def evaluate(self) -> dict:
        forces = self.chain.compute_passive_force()
        self.chain.set_qf(forces)
        self.chain.create_pinocchio_model().compute_forward_kinematics(np.zeros(2))
        self.see(forces=np.atleast_2d(forces))
        return {}


class BuildsInItsFirstReset(Written):
    late: Any = None

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        self.late = self.late or box(self, "late", pose=sapien.Pose([0.3, 0.3, 0.05]))
        self.late.set_pose(self.place(env_idx))
        self.see(late=self.late.pose.raw_pose)


class RemovesABody(Written):
    removed = False

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        if not self.removed:
            self.lies.remove_from_scene()
            self.removed = True
        self.falls.set_pose(self.place(env_idx))
        self.see(falls=self.falls.pose.raw_pose)


TASKS = [
    *(ReadsWhileBuilt, WritesWhileBuilt, TargetsWhileBuilt, TargetsAfterTheBuild, TargetsInReset),
    *(StepsWhileBuilt, SettlesInReset),
    *(StepsTheEnvInReset, StepsAfterReset, ReadsLinksInReset, WritesInEvaluate),
    *(WritesAndReadsBetweenSubsteps, MovesAStaticActor, WritesPastTheTensors, ReadsPastTheTensors),
    *(GivesRowsOfAllEnvs, SetsJointsOneByOne, ChangesWhatIsFixedOnTheGpu, ComputesPassiveForces),
    *(BuildsInItsFirstReset, RemovesABody, ThrowsAFreeChain),
]


@pytest.mark.parametrize("num_envs", [pytest.param(1, marks=pytest.mark.slow), 3])
@pytest.mark.parametrize("task", TASKS, ids=lambda task: task.__name__)
def test_an_env_of_the_batch_equals_the_stock_env(task: type[Written], num_envs: int) -> None:
    pair = _BatchAndStock(task, num_envs)
    pair.compare("built")
    for episode in range(2):
        pair.reset()
        pair.compare(f"reset {episode}")
        for step in range(STEPS):
            pair.step()
            pair.compare(f"episode {episode}, step {step}")
    for chosen in [[1], [0, 2]] if num_envs > 1 else []:
        pair.reset(chosen)  # the other envs are mid-episode
        pair.compare(f"reset of {chosen}", chosen)
        for step in range(STEPS):
            pair.step()
            pair.compare(f"after the reset of {chosen}, step {step}", ())
    pair.close()


class _BatchAndStock:
    """A batch, and a stock env for each of its envs."""

    def __init__(self, task: type[Written], num_envs: int) -> None:
        self.batch = batch_of(task, num_envs)
        self.stocks = [single(task, first_env=env) for env in range(num_envs)]

    def reset(self, envs: list[int] | None = None) -> None:
        if envs is None:
            self.batch.reset(seed=[*range(len(self.stocks))])
        else:
            self.batch.reset(options={"env_idx": torch.tensor(envs)})
        for env in range(len(self.stocks)) if envs is None else envs:
            self.stocks[env].reset(seed=env)

    def step(self) -> None:
        for env in (self.batch, *self.stocks):
            env.step(None)

    def compare(self, when: str, seen_of: Any = None) -> None:
        """Compare the states of all envs, and the values that `see` stored for the envs `seen_of` (None: all)."""
        for env, stock in enumerate(self.stocks):
            assert self.batch.scene.px.systems[env].pack() == stock.scene.px.pack(), (
                f"{when}: state of env {env}"
            )
            assert self.batch.elapsed_steps[env] == stock.elapsed_steps[0], f"{when}: steps of env {env}"
            for name, theirs in stock.seen.items() if seen_of is None or env in seen_of else ():
                ours = self.batch.seen[name][env]
                assert np.array_equal(ours, theirs[0]), (
                    f"{when}: {name} of env {env}: {ours}, stock {theirs[0]}"
                )

    def close(self) -> None:
        for env in (self.batch, *self.stocks):
            env.close()
