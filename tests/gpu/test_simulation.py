"""Open, reset, partial reset, step, snapshot and restore: GPU simulation against the batched CPU."""

# ManiSkill annotates an env's members as the widest thing they may be in any task.
# pyright: reportAttributeAccessIssue=false, reportArgumentType=false, reportOptionalMemberAccess=false
# pyright: reportCallIssue=false

from __future__ import annotations

import pickle
from collections.abc import Iterator
from typing import Any

import mani_skill.envs  # noqa: F401  registers the ids
import numpy as np
import pytest
import torch
from mani_skill.utils.registration import REGISTERED_ENVS
from mani_skill.utils.structs.pose import Pose

from tests.gpu.conftest import Simulation
from workbench.envs import action_vector as actions
from workbench.envs.arms import find_arms
from workbench.envs.assets import MissingAssets
from workbench.envs.inspect_env import list_contacts
from workbench.envs.read_robots import read_robots
from workbench.envs.scene.scene_index import scene_index
from workbench.envs.snapshots.snapshot import restore_snapshot, take_snapshot
from workbench.envs.task_env import EnvOptions, TaskEnv, make_env
from workbench.hands.link_poses import link_poses
from workbench.hands.reach_worker import LedArms, set_arm
from workbench.hands.worker import Hand, move_body, move_joints
from workbench.live.messages import MoveBody, MoveJoints, PullBody, Reached, ReachPose

N = 4
SEEDS = [40, 41, 42, 43]
TASKS = ("PushCube-v1", "PegInsertionSide-v1", "RollBall-v1", "TwoRobotPickCube-v1", "MS-CartpoleBalance-v1")


def opened(task: str, simulation: Simulation, **kwargs: Any) -> TaskEnv:
    spec = REGISTERED_ENVS[task]
    options = EnvOptions(N, simulation, render=False, kwargs={"obs_mode": "state", **kwargs})
    return TaskEnv(make_env(spec.cls, options), spec.max_episode_steps)


@pytest.fixture(scope="module")
def picks(simulation: Simulation) -> Iterator[tuple[TaskEnv, TaskEnv]]:
    """Yield PickCube on the backend under test and on the batched CPU."""
    under_test, reference = opened("PickCube-v1", simulation), opened("PickCube-v1", "cpu")
    yield under_test, reference
    under_test.close()
    reference.close()


def played(env: TaskEnv, steps: int, seed: int = 0) -> Any:
    rng = np.random.default_rng(seed)
    for _ in range(steps):
        step = env.step(actions.random_action(env.parts, N, rng))
    return step  # pyright: ignore[reportPossiblyUnboundVariable]


def test_bodies_actions_and_observations_equal_the_cpus(
    picks: tuple[TaskEnv, TaskEnv], simulation: Simulation
) -> None:
    env, reference = picks
    assert env.env.device.type == ("cuda" if simulation == "gpu" else "cpu")
    assert scene_index(env.env).names == scene_index(reference.env).names
    assert [part.names for part in env.parts] == [part.names for part in reference.parts]
    assert env.env.action_space == reference.env.action_space
    assert env.env.observation_space.shape == reference.env.observation_space.shape
    assert env.control_dt == reference.control_dt


def test_a_seeded_reset_is_repeatable(picks: tuple[TaskEnv, TaskEnv]) -> None:
    env, _ = picks
    first = env.reset(seed=SEEDS)
    played(env, 3)
    again = env.reset(seed=SEEDS)
    np.testing.assert_allclose(again.poses, first.poses, atol=1e-5)
    assert env.episode_seeds.tolist() == SEEDS and not again.elapsed_steps.any()
    assert np.isfinite(again.poses).all() and (np.ptp(again.poses, axis=0) > 1e-3).any(), "envs must differ"


def test_a_partial_reset_leaves_the_other_envs(picks: tuple[TaskEnv, TaskEnv]) -> None:
    env, _ = picks
    env.reset(seed=SEEDS)
    before = played(env, 5)
    after = env.reset(seed=7, env_idx=[1])
    assert after.elapsed_steps.tolist() == [5, 0, 5, 5]
    np.testing.assert_allclose(after.poses[[0, 2, 3]], before.poses[[0, 2, 3]], atol=1e-5)
    assert np.abs(after.poses[1] - before.poses[1]).max() > 1e-3
    assert env.episode_seeds.tolist() == [40, 7, 42, 43]


def test_a_partial_reset_starts_the_episode_of_its_seed(picks: tuple[TaskEnv, TaskEnv]) -> None:
    env, _ = picks
    env.reset(seed=SEEDS)
    played(env, 2)
    first = env.reset(seed=7, env_idx=[3]).poses[3]
    played(env, 2, seed=1)
    np.testing.assert_allclose(env.reset(seed=7, env_idx=[3]).poses[3], first, atol=1e-5)


def test_steps_from_one_state_agree_with_the_cpu(picks: tuple[TaskEnv, TaskEnv]) -> None:
    """The two solvers differ in the last digits; a mixed-up or unapplied pose would differ in the first."""
    env, reference = picks
    reference.reset(seed=SEEDS)
    env.reset(seed=SEEDS)
    state = reference.env.get_state_dict()
    env.env.set_state_dict({k: {n: t.to(env.env.device) for n, t in v.items()} for k, v in state.items()})
    rng = np.random.default_rng(0)
    for _ in range(5):
        action = actions.random_action(reference.parts, N, rng)
        here, there = env.step(action), reference.step(action)
    np.testing.assert_allclose(here.poses[..., :3], there.poses[..., :3], atol=0.01)  # pyright: ignore
    turned = np.abs((here.poses[..., 3:] * there.poses[..., 3:]).sum(-1))  # pyright: ignore
    assert turned.min() > 0.995, "orientations must agree (q and -q are the same)"
    np.testing.assert_allclose(here.reward, there.reward, atol=0.05)  # pyright: ignore
    assert here.elapsed_steps.tolist() == there.elapsed_steps.tolist()  # pyright: ignore


def test_a_hand_moves_and_pulls_a_body_of_one_env(picks: tuple[TaskEnv, TaskEnv]) -> None:
    env, _ = picks
    before = env.reset(seed=SEEDS).poses
    cube = scene_index(env.env).names.index("cube")
    moved = move_body(env, MoveBody("cube", (1,), (0.1, 0.25, 0.3, 1.0, 0.0, 0.0, 0.0), 0))
    assert moved is not None
    np.testing.assert_allclose(moved[0].poses[1, cube, :3], [0.1, 0.25, 0.3], atol=1e-5)
    np.testing.assert_allclose(moved[0].poses[[0, 2, 3]], before[[0, 2, 3]], atol=1e-5)
    x, y = (float(value) for value in before[2, cube, :2])
    hand = Hand()
    hand.take(PullBody("cube", 2, (0.0, 0.0, 0.0), (x, y, 0.2)))
    for _ in range(25):
        with hand.pulling(env.env):
            step = env.step(None)
    assert 0.15 < step.poses[2, cube, 2] < 0.2 and step.poses[0, cube, 2] < 0.05  # pyright: ignore
    hand.take(PullBody())
    with hand.pulling(env.env):
        env.step(None)
    assert hand.pulled is None


def test_joints_are_set_in_one_env_and_stay_there(picks: tuple[TaskEnv, TaskEnv]) -> None:
    env, _ = picks
    before = env.reset(seed=SEEDS)
    request = MoveJoints("panda", (1,), (0, 3), (0.5, -1.5), None, "", 0)
    moved = move_joints(env, request)
    assert moved is not None and before.qpos is not None and moved[0].qpos is not None
    np.testing.assert_allclose(moved[0].qpos[1, [0, 3]], [0.5, -1.5], atol=1e-5)
    np.testing.assert_allclose(moved[0].qpos[[0, 2, 3]], before.qpos[[0, 2, 3]], atol=1e-5)
    (robot,) = read_robots(env.env)
    placed = link_poses(robot, before.poses[1:2], moved[0].qpos[1:2])[0]
    links = [link.body for link in robot.links]
    np.testing.assert_allclose(moved[0].poses[1, links, :3], placed[links, :3], atol=1e-4)
    for _ in range(5):
        step = env.step(actions.hold_action(env.parts, N))
    assert step.qpos is not None  # pyright: ignore
    np.testing.assert_allclose(step.qpos[1, [0, 3]], [0.5, -1.5], atol=0.01)  # pyright: ignore


def test_an_arm_follows_a_target_and_is_put_there_in_one_env_only(simulation: Simulation) -> None:
    env = opened("PickCube-v1", simulation, control_mode="pd_ee_delta_pose")
    start = env.reset(seed=SEEDS).poses.astype(float)
    (arm,) = find_arms(env.env)
    tool = scene_index(env.env).names.index(arm.name)
    way = np.array([0.05, 0.06, -0.04, 0, 0, 0, 0])
    told: list[Reached] = []
    arms = LedArms(told.append)
    arms.take(ReachPose(arm.name, 1, tuple(start[1, tool] + way)))
    for _ in range(40):
        step = env.step(arms.lead(env, actions.hold_action(env.parts, N)))
    others = [0, 2, 3]
    assert np.linalg.norm(step.poses[1, tool, :3] - start[1, tool, :3] - way[:3]) < 0.01  # pyright: ignore
    assert np.abs(step.poses[others, tool, :3] - start[others, tool, :3]).max() < 2e-3  # pyright: ignore
    assert not told[0].why
    arms.forget()
    before = env.rescore().poses
    found = set_arm(env, ReachPose(arm.name, 2, tuple(start[2, tool] + way), "set"))
    assert found is not None
    now = found[0].poses
    assert np.linalg.norm(now[2, tool, :3] - start[2, tool, :3] - way[:3]) < 0.01
    np.testing.assert_allclose(now[[0, 1, 3]], before[[0, 1, 3]], atol=1e-5)
    still = env.step(actions.hold_action(env.parts, N)).poses
    assert np.abs(still[2, tool, :3] - now[2, tool, :3]).max() < 2e-3
    env.close()


def test_a_snapshot_restores_the_chosen_envs_and_leaves_the_others(picks: tuple[TaskEnv, TaskEnv]) -> None:
    env, _ = picks
    env.reset(seed=SEEDS)
    played(env, 2)
    there = env.env.get_state().clone()
    snapshot = pickle.loads(pickle.dumps(take_snapshot(env.env)))
    played(env, 5)
    elsewhere = env.env.get_state().clone()
    report = restore_snapshot(env.env, snapshot, [0, 2])
    assert not report.not_carried
    now = env.env.get_state()
    torch.testing.assert_close(now[[0, 2]], there[[0, 2]], atol=1e-5, rtol=0)
    torch.testing.assert_close(now[[1, 3]], elsewhere[[1, 3]], atol=1e-5, rtol=0)
    assert env.env.elapsed_steps.tolist() == [2, 7, 2, 7]


def test_steps_after_a_restore_repeat_the_earlier_ones(picks: tuple[TaskEnv, TaskEnv]) -> None:
    env, _ = picks
    env.reset(seed=SEEDS)
    played(env, 2)
    snapshot = take_snapshot(env.env)
    first = played(env, 5, seed=2)
    restore_snapshot(env.env, snapshot)
    again = played(env, 5, seed=2)
    # PhysX's contact cache may be lost, which costs millimetres; state that is not carried would cost centimetres.
    np.testing.assert_allclose(again.poses[..., :3], first.poses[..., :3], atol=0.005)


@pytest.mark.filterwarnings("ignore::workbench.envs.broken_rule.RuleWarning")
def test_an_unapplied_pose_behaves_as_on_the_cpu(picks: tuple[TaskEnv, TaskEnv]) -> None:
    seen = []
    for env in picks:
        env.reset(seed=SEEDS)
        was = env.env.cube.pose.p[:, 2].cpu().numpy().copy()
        raised = env.env.cube.pose.raw_pose.clone()
        raised[:, 2] += 0.5
        env.env.cube.set_pose(Pose.create(raised))
        read = env.env.cube.pose.p[:, 2].cpu().numpy().copy()
        env.step(actions.hold_action(env.parts, N))
        stepped = env.env.cube.pose.p[:, 2].cpu().numpy().copy()
        seen.append((read - was, stepped - was))
    for here, there in zip(*seen, strict=True):
        np.testing.assert_allclose(here, there, atol=0.01)


def test_an_applied_pose_is_simulated(picks: tuple[TaskEnv, TaskEnv]) -> None:
    for env in picks:
        env.reset(seed=SEEDS)
        raised = env.env.cube.pose.raw_pose.clone()
        raised[:, 2] += 0.5
        env.env.cube.set_pose(Pose.create(raised))
        env.env.scene._gpu_apply_all()
        env.env.scene._gpu_fetch_all()
        env.step(actions.hold_action(env.parts, N))
        fallen = raised[:, 2] - env.env.cube.pose.p[:, 2]
        assert bool(((fallen > 0) & (fallen < 0.05)).all()), "the cube must fall from where it was put"


@pytest.mark.thorough
@pytest.mark.parametrize("task", TASKS)
def test_a_task_runs_for_ten_steps(task: str, simulation: Simulation) -> None:
    try:
        env = opened(task, simulation)
    except MissingAssets as exc:
        pytest.skip(str(exc))
    env.reset(seed=0)
    step = played(env, 10)
    assert np.isfinite(step.poses).all() and np.isfinite(step.reward).all()
    assert step.elapsed_steps.tolist() == [10] * N
    env.close()


def test_contacts_on_a_gpu_are_refused_with_a_reason(
    picks: tuple[TaskEnv, TaskEnv], simulation: Simulation
) -> None:
    env, _ = picks
    env.reset(seed=SEEDS)
    played(env, 1)
    if simulation == "gpu":
        with pytest.raises(NotImplementedError, match="PhysX on the GPU keeps no list of contacts"):
            list_contacts(env.env, 0)
    else:
        assert list_contacts(env.env, 0)
