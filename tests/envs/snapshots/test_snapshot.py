"""Snapshots: a restored episode continues identically in its own env, in other envs and in a rebuilt batch."""

# pyright: reportAttributeAccessIssue=false, reportArgumentType=false, reportOptionalMemberAccess=false
# pyright: reportCallIssue=false

from __future__ import annotations

import pickle
import random
from collections.abc import Iterator
from typing import Any

import mani_skill.envs  # noqa: F401  registers the ids
import numpy as np
import pytest
import sapien
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils.building import actors
from mani_skill.utils.structs.pose import Pose

from tests.drive.envs import PICK_CUBE, batched
from tests.envs.by_hand import box, by_hand
from tests.envs.stock_env import Bare, single
from workbench.envs.snapshots.cpu_state import CpuState
from workbench.envs.snapshots.snapshot import (
    begin_anew,
    in_this_state,
    read_gpu_state,
    restore_snapshot,
    step_only,
    take_snapshot,
    write_gpu_state,
)
from workbench.envs.task_env import TaskEnv

pytestmark = pytest.mark.thorough

N = 6


def random_actions(env: BaseEnv, steps: int, seed: int) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [rng.uniform(-1, 1, env.action_space.shape).astype(np.float32) for _ in range(steps)]


def packs(env: BaseEnv) -> list[bytes]:
    return [system.pack() for system in env.scene.px.systems]


def after(env: BaseEnv, actions: list[np.ndarray]) -> list[list[bytes]]:
    """Step through the actions; return the state of every env after each."""
    states = []
    for action in actions:
        env.step(action)
        states.append(packs(env))
    return states


@pytest.fixture(scope="module")
def pick() -> Iterator[BaseEnv]:
    env = batched(PICK_CUBE, N)
    yield env
    env.close()


@pytest.fixture(scope="module")
def stack() -> Iterator[BaseEnv]:
    env = batched("StackCube-v1", N, control_mode="pd_ee_target_delta_pose")
    yield env
    env.close()


PROPERTY = settings(max_examples=8, suppress_health_check=[HealthCheck.function_scoped_fixture])


@PROPERTY
@given(
    seed=st.integers(0, 10_000),
    before=st.integers(0, 8),
    steps=st.integers(1, 5),
    chosen=st.sets(st.integers(0, N - 1), min_size=1),
)
def test_a_restored_episode_is_repeatable(
    stack: BaseEnv, seed: int, before: int, steps: int, chosen: set[int]
) -> None:
    stack.reset(seed=list(range(seed, seed + N)))
    after(stack, random_actions(stack, before, seed))
    subset = sorted(chosen)
    snapshot = take_snapshot(stack, subset)
    actions = random_actions(stack, steps, seed + 1)
    after(stack, actions)

    def restore_and_run() -> list[list[bytes]]:
        report = restore_snapshot(stack, snapshot)
        assert not report.not_carried or len(subset) < N, report.not_carried
        assert [int(stack.elapsed_steps[i]) for i in subset] == [before] * len(subset)
        return after(stack, actions)

    first, second = restore_and_run(), restore_and_run()
    for env in subset:
        assert [s[env] for s in first] == [s[env] for s in second]


# With this seed the uninterrupted run differs in envs without `begin_anew`.
def test_after_begin_anew_a_restore_equals_the_uninterrupted_run(stack: BaseEnv) -> None:
    stack.reset(seed=list(range(218, 218 + N)))
    after(stack, random_actions(stack, 5, 218))
    begin_anew(stack, [1, 4, 5])
    snapshot = take_snapshot(stack)
    actions = random_actions(stack, 4, 219)
    live = after(stack, actions)
    restore_snapshot(stack, snapshot)
    restored = after(stack, actions)
    same = [all(a[env] == b[env] for a, b in zip(live, restored, strict=True)) for env in range(N)]
    assert same[1] and same[4] and same[5]
    assert not all(same), "no contacts, so the test would prove nothing"


def test_a_snapshot_after_begin_anew_survives_physx_rounding_of_root_poses() -> None:
    env = batched("MS-HumanoidWalk-v1", 16)
    env.reset(seed=list(range(16)))
    rng = np.random.default_rng(0)
    for _ in range(8):
        env.step(rng.uniform(-1, 1, env.action_space.shape).astype(np.float32))
        begin_anew(env, list(range(16)))
        was = take_snapshot(env)
        restore_snapshot(env, was)
        now = take_snapshot(env)
        assert isinstance(was.simulation, CpuState) and isinstance(now.simulation, CpuState)
        assert now.simulation.packed == was.simulation.packed
    env.close()


def test_in_this_state_compares_to_the_last_bit(pick: BaseEnv) -> None:
    pick.reset(seed=list(range(N)))
    after(pick, random_actions(pick, 3, 0))
    begin_anew(pick, list(range(N)))
    snapshot = take_snapshot(pick, [5, 2])
    assert [in_this_state(pick, i, snapshot, 2) for i in range(N)] == [i == 2 for i in range(N)]
    assert [in_this_state(pick, i, snapshot, 5) for i in range(N)] == [i == 5 for i in range(N)]
    after(pick, random_actions(pick, 1, 1))
    assert not in_this_state(pick, 2, snapshot, 2)
    restore_snapshot(pick, snapshot, [2, 0], source=2)
    assert in_this_state(pick, 2, snapshot, 2) and in_this_state(pick, 0, snapshot, 2)
    cube = pick.cube.pose.raw_pose
    cube[2, 0] = torch.nextafter(cube[2, 0], torch.tensor(2.0))
    pick.cube.set_pose(Pose.create(cube))
    pick.scene._gpu_apply_all()
    pick.scene._gpu_fetch_all()
    assert not in_this_state(pick, 2, snapshot, 2) and in_this_state(pick, 0, snapshot, 2)


def test_a_restored_env_gets_the_seed_of_its_episode(pick: BaseEnv) -> None:
    env = TaskEnv(pick, 50)
    env.reset(seed=[20, 21, 22, 23, 24, 25])
    snapshot = take_snapshot(pick, [4, 1])
    env.reset(seed=[30, 31, 32, 33, 34, 35])
    restore_snapshot(pick, snapshot, [0, 4], source=[1, 4])
    assert env.episode_seeds.tolist() == [21, 31, 32, 33, 24, 35]


@PROPERTY
@given(seed=st.integers(0, 10_000), pairs=st.permutations(range(N)), count=st.integers(1, N))
def test_a_state_continues_identically_in_any_env(
    stack: BaseEnv, seed: int, pairs: list[int], count: int
) -> None:
    stack.reset(seed=list(range(seed, seed + N)))
    after(stack, random_actions(stack, 4, seed))
    snapshot = take_snapshot(stack)
    restore_snapshot(stack, snapshot)
    actions = random_actions(stack, 6, seed + 1)
    reference = after(stack, actions)
    targets, sources = sorted(pairs[:count]), pairs[:count]
    permuted = [action.copy() for action in actions]
    for action, was in zip(permuted, actions, strict=True):
        action[targets] = was[sources]
    restore_snapshot(stack, snapshot, targets, sources)
    result = after(stack, permuted)
    for target, source in zip(targets, sources, strict=True):
        assert [s[target] for s in result] == [s[source] for s in reference]


def test_a_restore_leaves_the_other_envs(pick: BaseEnv) -> None:
    pick.reset(seed=list(range(N)))
    after(pick, random_actions(pick, 5, 0))
    snapshot = take_snapshot(pick, [1, 4])
    actions = random_actions(pick, 3, 1)
    after(pick, actions)
    untouched = packs(pick)
    elapsed = pick.elapsed_steps.clone()
    restore_snapshot(pick, snapshot)
    now = packs(pick)
    for env in (0, 2, 3, 5):
        assert now[env] == untouched[env] and pick.elapsed_steps[env] == elapsed[env]
    assert pick.elapsed_steps.tolist() == [8, 5, 8, 8, 5, 8]


def test_tensors_and_drawn_poses_equal_the_snapshots(pick: BaseEnv) -> None:
    pick.reset(seed=list(range(N)))
    after(pick, random_actions(pick, 5, 0))
    restore_snapshot(pick, take_snapshot(pick))
    state, poses = pick.get_state(), [s.pack_poses() for s in pick.scene.sub_scenes]
    velocities = torch.stack([link.linear_velocity for link in pick.agent.robot.links])
    snapshot = take_snapshot(pick)
    after(pick, random_actions(pick, 5, 1))
    restore_snapshot(pick, snapshot)
    assert torch.equal(pick.get_state(), state)
    assert [s.pack_poses() for s in pick.scene.sub_scenes] == poses
    now = torch.stack([link.linear_velocity for link in pick.agent.robot.links])
    torch.testing.assert_close(now, velocities, atol=1e-5, rtol=0)


def test_evaluate_returns_the_same_after_a_restore(pick: BaseEnv) -> None:
    env = TaskEnv(pick, 50)
    env.reset(seed=0)
    state = pick.get_state_dict()
    state["actors"]["cube"][:, :3] = pick.agent.tcp.pose.p
    pick.set_state_dict(state)
    close = np.zeros((N, 8), np.float32)
    close[:, -1] = -1
    for _ in range(4):
        grasped = env.step(close)
    assert grasped.evaluate["is_grasped"].any(), "nothing is grasped, so the test would prove nothing"

    def finger_impulses() -> torch.Tensor:
        return pick.scene.get_pairwise_contact_impulses(pick.agent.finger1_link, pick.cube).clone()

    impulses = finger_impulses()
    assert len(impulses.unique(dim=0)) == N, "impulses must differ by env"
    snapshot = env.snapshot()
    opened = -close
    for _ in range(6):
        released = env.step(opened)
    assert not released.evaluate["is_grasped"].all()
    restored, report = env.restore(snapshot)
    assert not report.not_carried
    for name, value in grasped.evaluate.items():
        assert np.array_equal(restored.evaluate[name], value), name
    assert torch.equal(finger_impulses(), impulses)
    restore_snapshot(pick, snapshot, [1, 2], source=[4, 0])
    assert torch.equal(finger_impulses(), impulses[[0, 4, 0, 3, 4, 5]])
    env.restore(snapshot)
    np.testing.assert_allclose(restored.poses, grasped.poses, atol=1e-6)
    assert restored.elapsed_steps.tolist() == grasped.elapsed_steps.tolist()
    assert not restored.reward.any() and restored.action is None
    later = env.step(close)
    assert later.elapsed_steps.tolist() == [5] * N


def test_a_controllers_target_is_restored() -> None:
    env = batched("PickCube-v1", 3, control_mode="pd_joint_target_delta_pos")
    env.reset(seed=[0, 1, 2])
    actions = random_actions(env, 5, 0)
    after(env, actions)
    arm = env.agent.controller.controllers["arm"]
    target, snapshot = arm._target_qpos.clone(), take_snapshot(env)
    after(env, actions)
    assert not torch.equal(arm._target_qpos, target)
    restore_snapshot(env, snapshot, [1])
    assert torch.equal(arm._target_qpos[1], target[1]) and not torch.equal(arm._target_qpos[0], target[0])
    restore_snapshot(env, snapshot)
    assert torch.equal(arm._target_qpos, target)
    env.close()


def test_after_a_restore_an_unseeded_reset_draws_the_same(pick: BaseEnv) -> None:
    pick.reset(seed=list(range(N)))
    after(pick, random_actions(pick, 2, 0))
    snapshot = take_snapshot(pick)

    def draws() -> tuple[Any, ...]:
        pick.reset()
        return pick.get_state(), pick._batched_episode_rng.uniform(), pick._batched_episode_rng.normal()

    first = draws()
    pick._batched_episode_rng.normal()
    restore_snapshot(pick, snapshot)
    second = draws()
    assert torch.equal(first[0], second[0])
    assert np.array_equal(first[1], second[1]) and np.array_equal(first[2], second[2])


@pytest.mark.parametrize(
    ("taken", "into", "source", "whole"),
    [
        (range(N), None, None, True),
        ([5, 3, 4, 1, 0, 2], None, None, True),
        (range(N), [5, 3, 4, 1, 0, 2], None, True),
        (range(N), [5, 3, 4, 1, 0, 2], range(N), False),
        (range(N), range(N), 0, False),
        (range(N - 1), None, None, False),
        ([0], range(N), None, False),
    ],
)
def test_the_processs_generators_are_restored_only_with_every_env(
    pick: BaseEnv, taken: Any, into: Any, source: Any, whole: bool
) -> None:
    pick.reset(seed=list(range(N)))
    snapshot = take_snapshot(pick, taken)
    at_snapshot = drawn_next()
    advanced = drawn_next(advance=True)
    restore_snapshot(pick, snapshot, into, source)
    assert drawn_next() == (at_snapshot if whole else advanced)


def drawn_next(advance: bool = False) -> tuple[float, ...]:
    """Return the numbers that torch, numpy and Python would draw next; `advance` draws three first."""
    if advance:
        for draw in (torch.rand, np.random.rand, lambda count: random.random()):
            draw(3)
    kept = torch.get_rng_state(), np.random.get_state(), random.getstate()
    drawn = float(torch.rand(1)), float(np.random.rand()), random.random()
    torch.set_rng_state(kept[0])
    np.random.set_state(kept[1])
    random.setstate(kept[2])
    return drawn


def test_step_only_moves_the_chosen_envs_and_keeps_generator_progress(
    pick: BaseEnv,
) -> None:
    pick.reset(seed=list(range(N)))
    after(pick, random_actions(pick, 3, 0))
    before, cubes = packs(pick), pick.cube.pose.raw_pose.clone()
    with step_only(pick, [1, 4], take_snapshot(pick, [0, 2, 3, 5])):
        pick.cube.set_pose(
            Pose.create(cubes + torch.tensor([0, 0, 0.1, 0, 0, 0, 0]) * (torch.arange(N) == 2)[:, None])
        )
        pick.scene._gpu_apply_all()
        pick.scene._gpu_fetch_all()
        after(pick, random_actions(pick, 2, 1))
        assert packs(pick)[2] != before[2], "the write to env 2 must change it"
        drawn = drawn_next(advance=True)
    assert drawn_next() == drawn
    assert pick.elapsed_steps.tolist() == [3, 5, 3, 3, 5, 3]
    assert [now == was for now, was in zip(packs(pick), before, strict=True)] == [
        i not in (1, 4) for i in range(N)
    ]
    now = packs(pick)
    with step_only(pick, [0], None):
        after(pick, random_actions(pick, 1, 2))
    assert [pack == was for pack, was in zip(packs(pick), now, strict=True)] == [i > 0 for i in range(N)]
    now = packs(pick)
    after(pick, random_actions(pick, 1, 3))
    assert not any(pack == was for pack, was in zip(packs(pick), now, strict=True)), (
        "all envs must move again"
    )


def test_joint_forces_are_restored() -> None:
    env = batched("MS-CartpoleBalance-v1", 2, control_mode="pd_joint_delta_pos")
    env.reset(seed=[0, 1])
    robot = env.agent.robot
    robot.set_qf(torch.full((2, robot.max_dof), 2.0))
    env.scene.px.gpu_apply_articulation_qf()
    snapshot = take_snapshot(env)
    robot.set_qf(torch.zeros((2, robot.max_dof)))
    env.scene.px.gpu_apply_articulation_qf()
    restore_snapshot(env, snapshot, [1])
    forces = [articulation.qf.tolist() for articulation in robot._objs]
    assert forces == [[0.0] * robot.max_dof, [2.0] * robot.max_dof]
    for _ in range(2):  # the second restore: forces have not changed, but a new PhysX scene has none
        restore_snapshot(env, snapshot)
        assert [articulation.qf.tolist() for articulation in robot._objs] == [[2.0] * robot.max_dof] * 2
    env.close()


def test_sleeping_bodies_sleep_after_a_restore(pick: BaseEnv) -> None:
    pick.reset(seed=list(range(N)))
    cubes = [entity.find_component_by_type(type(pick.cube._bodies[0])) for entity in pick.cube._objs]
    cubes[2].put_to_sleep()
    snapshot = take_snapshot(pick)
    cubes[2].wake_up()
    restore_snapshot(pick, snapshot)
    assert [cube.is_sleeping for cube in cubes] == [i == 2 for i in range(N)]


def test_a_hidden_object_keeps_its_true_pose(pick: BaseEnv) -> None:
    pick.reset(seed=list(range(N)))
    pick.goal_site.show_visual()
    goals = pick.goal_site.pose.raw_pose.clone()
    pick.goal_site.hide_visual()
    hidden = take_snapshot(pick)
    pick.reset(seed=list(range(50, 50 + N)))
    restore_snapshot(pick, hidden)
    assert torch.equal(pick.goal_site.pose.raw_pose, goals)
    pick.goal_site.show_visual()
    torch.testing.assert_close(pick.goal_site.pose.raw_pose, goals)
    pick.reset(seed=list(range(50, 50 + N)))
    restore_snapshot(pick, hidden, [4], source=0)
    torch.testing.assert_close(pick.goal_site.pose.raw_pose[4], goals[0])


class EditedPickCube(PICK_CUBE):
    """PickCube with an additional ball."""

    def _load_scene(self, options: dict) -> None:
        super()._load_scene(options)
        self.ball = actors.build_sphere(
            self.scene, 0.02, [1, 0, 0, 1], "ball", initial_pose=Pose.create_from_pq([0.3, 0.3, 0.02])
        )


def test_an_episode_continues_identically_in_a_rebuilt_env(pick: BaseEnv) -> None:
    pick.reset(seed=list(range(N)))
    after(pick, random_actions(pick, 5, 0))
    snapshot = pickle.loads(pickle.dumps(take_snapshot(pick)))
    restore_snapshot(pick, snapshot)
    actions = random_actions(pick, 8, 1)
    reference = after(pick, actions)
    rebuilt = batched(PICK_CUBE, N)
    rebuilt.reset(seed=list(range(100, 100 + N)))
    report = restore_snapshot(rebuilt, snapshot)
    assert {"actor cube", "actor goal_site", "articulation panda"} <= set(report.carried)
    assert not report.not_carried
    assert rebuilt.elapsed_steps.tolist() == [5] * N
    assert after(rebuilt, actions) == reference
    rebuilt.close()


def test_an_edited_task_gets_states_by_name_and_reports_the_rest(pick: BaseEnv) -> None:
    pick.reset(seed=list(range(N)))
    after(pick, random_actions(pick, 5, 0))
    snapshot = take_snapshot(pick)
    edited = batched(EditedPickCube, 4)
    edited.reset(seed=[0, 1, 2, 3])
    ball = edited.ball.pose.raw_pose.clone()
    report = restore_snapshot(edited, snapshot, [0, 2], source=[5, 1])
    assert report.not_carried["actor ball"].startswith("it is not in the snapshot")
    assert torch.equal(edited.ball.pose.raw_pose, ball)
    cube, qpos = pick.cube.pose.raw_pose, pick.agent.robot.get_qpos()
    torch.testing.assert_close(edited.cube.pose.raw_pose[[0, 2]], cube[[5, 1]])
    torch.testing.assert_close(edited.agent.robot.get_qpos()[[0, 2]], qpos[[5, 1]])
    assert edited.elapsed_steps.tolist() == [5, 0, 5, 0]
    back = restore_snapshot(pick, take_snapshot(edited, [2]), [3])
    assert "this env has no" in back.not_carried["actor ball"]
    edited.close()


@pytest.mark.parametrize(
    ("env_idx", "source", "error", "words"),
    [
        (
            torch.tensor([True, False, True, False, False, False]),
            0,
            TypeError,
            "convert a mask with mask.nonzero",
        ),
        ([1.5], 0, TypeError, "must be integers"),
        ([0], [0.5], TypeError, "must be integers"),
        ([7], 0, IndexError, "out of range for 6 envs"),
        ([1, 1], 0, ValueError, "twice"),
        ([], 0, ValueError, "empty"),
        (None, 0, ValueError, "env_idx"),
        ([0, 1], [0, 1, 2], ValueError, "3 sources for 2 envs"),
        ([0, 1], [5, 9], IndexError, r"no state of \[9\]"),
    ],
)
def test_an_invalid_list_of_envs_is_refused(
    pick: BaseEnv, env_idx: Any, source: Any, error: type[Exception], words: str
) -> None:
    pick.reset(seed=0)
    snapshot, before = take_snapshot(pick), packs(pick)
    with pytest.raises(error, match=words):
        restore_snapshot(pick, snapshot, env_idx, source)
    assert packs(pick) == before


def test_a_snapshot_that_does_not_fit_is_refused(pick: BaseEnv) -> None:
    snapshot = take_snapshot(pick)
    small, stock = batched(PICK_CUBE, 2), single(PICK_CUBE)
    before = packs(small)
    with pytest.raises(IndexError, match="source"):
        restore_snapshot(small, snapshot)
    with pytest.raises(TypeError, match="Snapshot"):
        restore_snapshot(small, "a snapshot")
    gpu = snapshot._replace(simulation=read_gpu_state(pick, list(range(N))))
    with pytest.raises(TypeError, match="GPU"):
        restore_snapshot(pick, gpu)
    stock.reset(seed=0)
    with pytest.raises(NotImplementedError):
        take_snapshot(stock)
    assert packs(small) == before
    small.close()
    stock.close()


class Hinged(Bare):
    """A chain of `hinges` hinges, and a box of the same name as that of the other version."""

    hinges = 1

    def _load_scene(self, options: dict) -> None:
        self.chain = by_hand(self, self.hinges)
        self.box = box(self, "box", pose=sapien.Pose([1, 0, 1]))


class TwiceHinged(Hinged):
    hinges = 2


@pytest.mark.filterwarnings("ignore::workbench.envs.broken_rule.RuleWarning")
@pytest.mark.parametrize(("taken", "into"), [(Hinged, TwiceHinged), (TwiceHinged, Hinged)])
def test_an_articulation_with_other_joints_is_left_and_reported(taken: Any, into: Any) -> None:
    old, new = batched(taken, 2), batched(into, 2)
    for env, angle in ((old, 0.1), (new, 0.7)):
        env.reset(seed=0)
        env.chain.set_qpos(torch.full((2, env.hinges), angle))
        env.box.set_pose(Pose.create_from_pq(torch.tensor([[angle, 0, 1], [2 * angle, 0, 1]])))
    assert read_gpu_state(old, [0]).states.keys() == read_gpu_state(new, [0]).states.keys()
    for report in (
        restore_snapshot(new, take_snapshot(old), [1, 0], source=[0, 1]),
        write_gpu_state(new, [1, 0], read_gpu_state(old, [0, 1]), [0, 1]),
    ):
        carried, missed = report if isinstance(report, tuple) else (report.carried, report.not_carried)
        assert "actor box" in carried and "articulation chain" not in carried
        assert [*missed] == ["articulation chain"]
        torch.testing.assert_close(new.chain.get_qpos(), torch.full((2, new.hinges), 0.7))
        torch.testing.assert_close(new.box.pose.p[:, 0], torch.tensor([0.2, 0.1]))
    old.close()
    new.close()


def test_gpu_states_are_read_and_written_through_tensors(pick: BaseEnv) -> None:
    """Runs on the CPU core, whose tensors have the same interface; hidden PhysX state is not included."""
    pick.reset(seed=list(range(N)))
    for _ in range(3):
        pick.step(pick.action_space.sample())
    state, before = read_gpu_state(pick, [1, 3]), read_gpu_state(pick, list(range(N)))
    targets = pick.scene.px.cuda_articulation_target_qpos.torch().clone()
    for _ in range(3):
        pick.step(pick.action_space.sample())
    now = read_gpu_state(pick, list(range(N)))
    carried, missed = write_gpu_state(pick, [3, 0], state, [0, 1])
    names = {"actor cube", "actor goal_site", "actor table-workspace", "articulation panda"}
    assert (set(carried), missed) == (names, {})
    found = read_gpu_state(pick, list(range(N)))
    for name, rows in found.states.items():
        for env, source, was in [(3, 1, before), (0, 3, before), (1, 1, now), (2, 2, now)]:
            np.testing.assert_allclose(rows[env], was.states[name][source], rtol=0, atol=1e-6)
    assert torch.equal(pick.scene.px.cuda_articulation_target_qpos.torch()[[3, 0]], targets[[1, 3]])
