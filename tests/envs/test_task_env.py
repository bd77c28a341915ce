"""The plain-array interface over a running task, and how tasks are made."""

# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportOptionalMemberAccess=false

from __future__ import annotations

import random
from collections.abc import Iterator
from typing import Any, get_args

import mani_skill.envs  # noqa: F401  registers the ids
import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils.registration import REGISTERED_ENVS

from tests.drive.envs import PUSH_CUBE, batched, stock
from tests.drive.render_device import RENDER_DEVICE
from tests.envs.stock_env import Bare
from workbench.envs import action_vector as actions
from workbench.envs import backends
from workbench.envs.backends import BackendUnavailable, choose_backend
from workbench.envs.error_notes import WrongAction
from workbench.envs.maniskill_private import last_observation
from workbench.envs.scene.scene_index import scene_index
from workbench.envs.task_drawings import Drawing, drawings
from workbench.envs.task_env import EnvOptions, TaskEnv, default_reward_mode, make_env, to_numpy

pytestmark = pytest.mark.thorough

N = 4


def opened(env_id: str, num_envs: int = N, **kwargs: object) -> TaskEnv:
    return TaskEnv(batched(env_id, num_envs, **kwargs), REGISTERED_ENVS[env_id].max_episode_steps)


@pytest.fixture(scope="module")
def push() -> Iterator[TaskEnv]:
    env = opened("PushCube-v1")
    yield env
    env.close()


def test_a_reward_with_a_gradient_is_detached(push: TaskEnv) -> None:
    """A task may compute its reward with a torch network."""
    reward = torch.ones(N, requires_grad=True) * 2
    assert (
        push.result({"success": torch.zeros(N, dtype=torch.bool)}, reward, None).reward.tolist() == [2.0] * N
    )


def test_the_time_limit_truncates(push: TaskEnv) -> None:
    push.reset(seed=0)
    results = [push.step(np.zeros((N, 8), np.float32)) for _ in range(push.max_episode_steps)]
    assert not results[-2].truncated.any() and results[-1].truncated.all()


@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    subset=st.sets(st.integers(0, N - 1), min_size=1, max_size=N),
    seed=st.integers(0, 2**31 - N - 1),
    steps=st.integers(0, 3),
)
def test_a_partial_reset_leaves_the_other_envs(
    push: TaskEnv, subset: set[int], seed: int, steps: int
) -> None:
    push.reset(seed=7)
    before = push.reset(seed=7)
    for _ in range(steps):
        before = push.step(np.full((N, 8), 0.3, np.float32))
    after = push.reset(seed=seed, env_idx=sorted(subset))
    others = [i for i in range(N) if i not in subset]
    assert np.array_equal(after.poses[others], before.poses[others], equal_nan=True)
    assert [int(after.elapsed_steps[i]) for i in subset] == [0] * len(subset)
    assert [int(after.elapsed_steps[i]) for i in others] == [steps] * len(others)


def test_each_env_gets_its_own_seed_in_any_order_of_envs(push: TaskEnv) -> None:
    push.reset(seed=0)
    ascending = push.reset(seed=[41, 40], env_idx=[0, 2])
    push.reset(seed=0)
    named = push.reset(seed=[40, 41], env_idx=[2, 0])
    assert push.episode_seeds.tolist() == [41, 1, 40, 3]
    assert np.array_equal(named.poses, ascending.poses, equal_nan=True)
    single = stock("PushCube-v1")
    single.reset(seed=41)
    assert torch.equal(push.env.obj.pose.p[0], single.obj.pose.p[0])
    # Joint noise comes from numpy's generator, which ManiSkill shares across the batch.
    assert torch.equal(push.env.agent.robot.qpos[0], single.agent.robot.qpos[0])
    single.close()


def test_a_state_that_is_put_back_is_observed(push: TaskEnv) -> None:
    push.reset(seed=0)
    kept, first = push.snapshot(), push.obs.clone()
    push.step(np.ones((N, 8), np.float32))
    moved = push.obs.clone()
    push.restore(kept, [1, 3])
    same = torch.isclose(push.obs, first, atol=1e-4).all(dim=1)
    assert same.tolist() == [False, True, False, True]
    assert torch.equal(push.obs[[0, 2]], moved[[0, 2]])
    assert torch.equal(last_observation(push.env), push.obs)


def test_what_the_task_returned_is_checked_after_each_reset_step_and_rescore(push: TaskEnv) -> None:
    checked: list[Any] = []
    task = TaskEnv(push.env, 50, lambda info, reward: checked.append((set(info), reward)))
    action = np.zeros((N, 8), np.float32)
    task.reset(seed=0)
    task.reset(env_idx=[2])
    task.step(action)
    task.rescore()
    task.rescore(action)
    assert [reward is None for _, reward in checked] == [True, True, False, True, False]
    assert all("success" in info and "reconfigure" not in info for info, _ in checked)

    def refuse(info: Any, reward: Any) -> None:
        raise ZeroDivisionError

    refusing = TaskEnv(push.env, 50, refuse)
    for call in (lambda: refusing.reset(seed=0), lambda: refusing.step(action), refusing.rescore):
        with pytest.raises(ZeroDivisionError):
            call()


def test_a_result_is_a_copy_of_what_the_caller_and_the_task_keep(push: TaskEnv) -> None:
    push.reset(seed=0)
    action, entry, reward = np.zeros((N, 8), np.float32), torch.zeros(N), torch.zeros(N)
    result = push.result({"entry": entry, "success": entry > 0}, reward, action)
    poses = result.poses.copy()
    for kept in (action, entry, reward, push.env.elapsed_steps):
        kept += 1
    push.step(np.ones((N, 8), np.float32))
    assert np.array_equal(result.poses, poses, equal_nan=True)
    assert not (result.action.any() or result.evaluate["entry"].any() or result.reward.any())
    assert result.elapsed_steps.tolist() == [0] * N
    assert to_numpy(entry) is not entry and not np.shares_memory(to_numpy(entry), entry.numpy())


def test_a_result_has_what_was_drawn_while_a_workbench_shows_it(
    push: TaskEnv, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawings.put("it", Drawing("points", np.ones((2, 1, 3), np.float32)))
    try:
        for on in (True, False):
            monkeypatch.setattr(drawings, "on", on)
            drawn = push.rescore().drawn
            assert [*drawn] == (["it"] if on else [])
            assert all(drawing.data.shape == (N, 1, 3) for drawing in drawn.values())
    finally:
        drawings.remove("it")


@pytest.mark.parametrize("seeds", [[1], [1, 2, 3, 4, 5], []])
def test_a_wrong_number_of_seeds_is_refused(push: TaskEnv, seeds: list[int]) -> None:
    push.reset(seed=[7, 8, 9, 10])
    for chosen in (None, [0, 2]):
        with pytest.raises(ValueError):
            push.reset(seed=seeds, env_idx=chosen)
    assert push.episode_seeds.tolist() == [7, 8, 9, 10]
    push.reset(seed=20)
    push.reset(seed=30, env_idx=[3, 1])
    assert push.episode_seeds.tolist() == [20, 31, 22, 30], "the i-th env gets seed + i"


@pytest.mark.parametrize(
    "wrong",
    [
        {"num_envs": 0},
        {"num_envs": -1},
        {"backend": "cuda"},
        {"pictures": "quick"},
        {"rules": "loud"},
        {"threads": 0},
        {"threads": -2},
    ],
    ids=str,
)
def test_wrong_options_are_refused_before_an_env_is_made(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        EnvOptions(**wrong)
    EnvOptions(1, threads=1)


class DrawsInEvaluate(PUSH_CUBE):
    """``evaluate`` draws from all generators and counts its calls."""

    evaluations = 0

    def evaluate(self) -> dict:
        self.evaluations += 1
        drawn = torch.rand(self.num_envs) + float(np.random.rand() + random.random())
        drawn = drawn + torch.tensor(self._batched_episode_rng.normal(), dtype=torch.float32)
        return {
            **super().evaluate(),
            "drawn": drawn,
            "evaluations": torch.full((self.num_envs,), self.evaluations),
        }


def test_rescoring_leaves_no_trace() -> None:
    env = TaskEnv(batched(DrawsInEvaluate, 3), 50)
    env.reset(seed=0)
    env.step(np.zeros((3, 8), np.float32))
    first, again = env.rescore(), env.rescore(np.zeros((3, 8), np.float32))
    assert not first.reward.any() and first.action is None and again.reward.all()
    for name in ("drawn", "evaluations"):
        assert np.array_equal(first.evaluate[name], again.evaluate[name]), name
    assert len({*first.evaluate["drawn"].tolist()}) == 3
    assert np.array_equal(env.step(np.zeros((3, 8), np.float32)).evaluate["drawn"], first.evaluate["drawn"])
    env.close()


class DiffersByEnv(PUSH_CUBE):
    """Env 1 succeeds and env 2 fails from the start; env 0's observation contains a NaN."""

    def evaluate(self) -> dict:
        numbers = torch.arange(self.num_envs)
        return {"success": numbers == 1, "fail": numbers == 2}

    def _get_obs_extra(self, info: dict) -> dict:
        lost = torch.zeros(self.num_envs, 2)
        lost[0, 1] = torch.nan
        return {"lost": lost, "sound": torch.zeros(self.num_envs), "number": torch.zeros(self.num_envs, 1)}


@pytest.mark.parametrize("obs_mode", ["state", "state_dict"])
def test_success_failure_and_nan_are_assigned_to_their_env(obs_mode: str) -> None:
    env = TaskEnv(batched(DiffersByEnv, 4, obs_mode=obs_mode), 50)
    for step in (env.reset(seed=0), env.step(np.zeros((4, 8), np.float32)), env.rescore()):
        assert step.terminated.tolist() == [False, True, True, False]
        assert step.sound_obs is not None and step.sound_obs.tolist() == [False, True, True, True]
        assert not step.truncated.any()
    env.close()


def test_after_a_rebuild_the_new_scene_is_read_and_controlled() -> None:
    env = opened("PushCube-v1", 2, control_mode="pd_joint_pos")
    env.reset(seed=0)
    old, scene = env.parts, env.env.scene
    step = env.reset(seed=1, options={"reconfigure": True})
    assert env.env.scene is not scene
    assert env.parts is not old and env.parts[0].controller is env.env.agent.controller.controllers["arm"]
    cube = scene_index(env.env).names.index("cube")
    assert np.array_equal(step.poses[:, cube, :3], env.env.obj.pose.p.numpy())
    start = env.env.agent.robot.qpos.clone()
    env.step(actions.hold_action(env.parts, 2))
    assert (env.env.agent.robot.qpos - start).abs().max() < 0.02
    env.close()


def test_given_seeds_hold_where_resets_without_one_draw_seeds() -> None:
    env = opened("PushCube-v1", 3, enhanced_determinism=True)
    env.reset(seed=0)
    env.reset(seed=[40, 41], env_idx=[2, 1])
    assert env.episode_seeds.tolist() == [0, 41, 40]
    single = stock("PushCube-v1", enhanced_determinism=True)
    single.reset(seed=41)
    assert torch.equal(env.env.obj.pose.p[1], single.obj.pose.p[0])
    before = env.episode_seeds.tolist()
    env.reset(env_idx=[2])
    assert env.episode_seeds[:2].tolist() == before[:2] and env.episode_seeds[2] != before[2]
    single.close()
    env.close()


# --- actions ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "control_mode",
    ["pd_joint_delta_pos", "pd_joint_pos", "pd_ee_delta_pose", "pd_ee_delta_pos", "pd_joint_vel"],
)
def test_holding_still_holds_still(control_mode: str) -> None:
    env = opened("PickCube-v1", 2, control_mode=control_mode)
    env.reset(seed=0)
    robot = env.env.agent.robot
    start = robot.get_qpos().clone()
    start[:, 7:] = torch.tensor([[0.02], [0.035]])  # a half-open hand, differently in each env
    robot.set_qpos(start)
    env.env.scene._gpu_apply_all()
    env.env.scene.px.gpu_update_articulation_kinematics()
    env.env.scene._gpu_fetch_all()
    for _ in range(10):
        env.step(actions.hold_action(env.parts, 2))
    moved = (robot.get_qpos() - start).abs()
    assert moved[:, :7].max() < 0.02 and ("delta" in control_mode or moved[:, 7:].max() < 0.005), moved
    env.close()


@pytest.mark.parametrize("convert", [np.asarray, torch.from_numpy, np.ndarray.tolist])
def test_a_policys_action_may_be_one_for_all_or_one_each(push: TaskEnv, convert: Any) -> None:
    each = np.arange(8 * N, dtype=np.float32).reshape(N, 8) / 100
    taken = actions.to_flat_action(push.env, push.parts, convert(each.copy()))
    np.testing.assert_array_equal(taken, each)
    np.testing.assert_array_equal(
        actions.to_flat_action(push.env, push.parts, convert(each[1].copy())), np.tile(each[1], (N, 1))
    )
    assert not np.shares_memory(actions.to_flat_action(push.env, push.parts, each), each)
    huge = np.full((N, 8), 3e38, np.float32)
    assert (actions.to_flat_action(push.env, push.parts, huge) == huge).all(), "finite, though the sum is not"


def test_the_first_number_of_an_action_that_is_not_finite_is_named(push: TaskEnv) -> None:
    wrong = np.zeros((N, 8), np.float32)
    wrong[2, 5], wrong[3, :] = np.inf, np.nan
    with pytest.raises(WrongAction) as caught:
        actions.to_flat_action(push.env, push.parts, wrong)
    name = [name for part in push.parts for name in part.names][5]
    assert f"2 of {N} envs" in str(caught.value) and f"inf for {name} of env 2" in str(caught.value)


@pytest.mark.parametrize("wrong", [np.zeros((N, 7)), np.zeros((2, 8)), np.full((N, 8), np.nan), 3.0])
def test_a_policys_action_that_does_not_fit_is_refused(push: TaskEnv, wrong: object) -> None:
    with pytest.raises(ValueError):
        actions.to_flat_action(push.env, push.parts, wrong)


def test_an_action_for_each_robot_needs_exactly_the_robots_of_the_task(push: TaskEnv) -> None:
    env = opened("TwoRobotPickCube-v1", 2)
    given = {
        name: np.full(8, value) for name, value in zip(("panda_wristcam-0", "panda_wristcam-1"), (0.1, 0.2))
    }
    assert set(given) == set(env.env.single_action_space.spaces)
    flat = actions.to_flat_action(env.env, env.parts, dict(reversed(given.items())))
    np.testing.assert_allclose(flat, np.tile(np.repeat([0.1, 0.2], 8), (2, 1)), rtol=1e-6)
    first, second = given
    assert [name.partition("/")[0] for part in env.parts for name in part.names] == [first] * 8 + [second] * 8
    drawn = actions.random_action(env.parts, 2, np.random.default_rng(0))
    robots = actions.to_env_action(env.env, env.parts, drawn)
    assert np.array_equal(actions.to_flat_action(env.env, env.parts, robots), drawn)
    env.reset(seed=0)
    assert np.array_equal(env.step(drawn).action, drawn)
    wrong: list[tuple[Any, str]] = [
        ({first: np.zeros(8)}, second),
        ({**given, "third": np.zeros(8)}, "third"),
        ({**given, second: np.zeros(7)}, second),
        (np.zeros(8), "16"),
    ]
    for action, named in wrong:
        with pytest.raises(WrongAction) as caught:
            actions.to_flat_action(env.env, env.parts, action)
        assert named in str(caught.value)
    for action in (given, None, "hold", (np.zeros(8), {"state": 1})):
        with pytest.raises(WrongAction):
            actions.to_flat_action(push.env, push.parts, action)
    env.close()


@pytest.mark.parametrize(
    ("control_mode", "names", "low", "target"),
    [
        (
            "pd_joint_delta_pos",
            ["arm/panda_joint1", "arm/panda_joint7", "gripper/panda_finger_joint1"],
            -1,
            False,
        ),
        (
            "pd_joint_pos",
            ["arm/panda_joint1", "arm/panda_joint7", "gripper/panda_finger_joint1"],
            -2.8973,
            True,
        ),
        ("pd_ee_delta_pos", ["arm/x", "arm/z", "gripper/panda_finger_joint1"], -1, False),
        ("pd_ee_pose", ["arm/x", "arm/rz", "gripper/panda_finger_joint1"], -2, True),
    ],
)
def test_each_number_of_an_action_has_a_name_bounds_and_a_kind(
    control_mode: str, names: list[str], low: float, target: bool
) -> None:
    env = opened("PickCube-v1", 2, control_mode=control_mode)
    arm, gripper = env.parts
    assert [arm.names[0], arm.names[-1], *gripper.names] == names
    lowest, highest = actions.bounds(env.parts)
    space = env.env.single_action_space
    assert np.array_equal(lowest, space.low) and np.array_equal(highest, space.high)
    assert lowest[0] == pytest.approx(low) and actions.width(env.parts) == len(lowest)
    assert actions.is_target(env.parts).tolist() == [target] * len(arm.names) + [True]
    assert (actions.zero_holds(arm), actions.zero_holds(gripper)) == (not target, False)
    drawn = actions.random_action(env.parts, 400, np.random.default_rng(0))
    bounded = np.isfinite(lowest)
    below, above = np.where(bounded, lowest, -1), np.where(bounded, highest, 1)
    np.testing.assert_allclose(drawn.min(axis=0), below, atol=0.05 * (above - below).max())
    np.testing.assert_allclose(drawn.max(axis=0), above, atol=0.05 * (above - below).max())
    some = actions.action_of(env.parts, 3, {2: np.arange(len(lowest))})
    assert not some[:2].any() and some[2].tolist() == [*range(len(lowest))]
    env.close()


# --- making ----------------------------------------------------------------------------------------


def test_the_reward_is_the_richest_that_the_class_implements() -> None:
    class NoReward(BaseEnv):
        pass

    class DenseOnly(BaseEnv):
        def compute_dense_reward(self, obs: object, action: object, info: dict) -> torch.Tensor:
            return torch.zeros(self.num_envs)

    assert default_reward_mode(NoReward) == "sparse"
    assert default_reward_mode(DenseOnly) == "dense"
    assert default_reward_mode(PUSH_CUBE) == "normalized_dense"


def test_gpu_simulation_is_used_only_on_request(monkeypatch: pytest.MonkeyPatch) -> None:
    """GPU simulation is untested, so it needs an explicit choice and the message says so."""
    monkeypatch.setattr(backends, "why_no_gpu_simulation", lambda: None)
    chosen = {
        wanted: choose_backend(wanted, render=False).simulation for wanted in get_args(backends.Backend)
    }
    assert chosen == {"auto": "cpu", "cpu": "cpu", "gpu": "gpu"}
    text = backends.unused_gpu_text("auto")
    assert text is not None and "--backend gpu" in text
    assert backends.unused_gpu_text("cpu") is backends.unused_gpu_text("gpu") is None
    monkeypatch.setattr(backends, "why_no_gpu_simulation", lambda: "there is none")
    assert backends.unused_gpu_text("auto") is None
    with pytest.raises(BackendUnavailable, match="there is none"):
        choose_backend("gpu", render=False)


@pytest.mark.parametrize(
    "options",
    [
        EnvOptions(2, "cpu", render=False),
        EnvOptions(2, "cpu", render=False, kwargs={"render_backend": "cpu"}),
        EnvOptions(2, "cpu", kwargs={"render_backend": "none"}),
        EnvOptions(2, "cpu", kwargs={"render_backend": None}),
    ],
)
def test_without_pictures_there_is_no_render_system(options: EnvOptions) -> None:
    env = make_env(Bare, options)
    assert env.backend.render_backend == "none"
    for scene in env.scene.sub_scenes:
        with pytest.raises(RuntimeError, match="no system with name .render."):
            _ = scene.render_system
    env.close()


class OnlyDense(Bare):
    SUPPORTED_REWARD_MODES = ("normalized_dense", "dense", "none")

    def __init__(self, *args: Any, calm: int = 0, **kwargs: Any) -> None:
        self.calm = calm
        super().__init__(*args, **kwargs)

    def compute_dense_reward(self, obs: Any, action: Any, info: dict) -> torch.Tensor:
        return torch.ones(self.num_envs)


def test_a_task_without_a_robot_takes_no_action() -> None:
    task = TaskEnv(make_env(OnlyDense, EnvOptions(2, "cpu", render=False)))
    task.reset(seed=0)
    assert task.parts == () and actions.hold_action(task.parts, 2).shape == (2, 0)
    for action in (None, np.zeros((2, 0), np.float32), np.ones((2, 3), np.float32)):
        step = task.step(action)
        assert step.action is None and step.reward.tolist() == [1.0, 1.0]
    assert task.rescore(np.zeros((2, 0), np.float32)).reward.tolist() == [1.0, 1.0]
    task.close()


def test_given_arguments_override_registered_ones_and_those_the_default_reward() -> None:
    def made(registered: dict | None, **named: object) -> Any:
        env = make_env(OnlyDense, EnvOptions(2, "cpu", render=False, kwargs=named), default_kwargs=registered)
        env.close()
        return env

    assert (made(None).reward_mode, made(None).calm) == ("dense", 0)
    assert (made({"calm": 1}).reward_mode, made({"calm": 1}).calm) == ("dense", 1)
    both = made({"calm": 1, "reward_mode": "none", "num_envs": 5}, calm=2)
    assert (both.reward_mode, both.calm, both.num_envs) == ("none", 2, 2)


def test_a_second_render_device_is_refused_with_the_first_named(renderer: None) -> None:
    with pytest.raises(RuntimeError, match=f"renders on '{RENDER_DEVICE}'"):
        backends.keep_render_device("cpu" if RENDER_DEVICE == "cuda" else "pci:0")
