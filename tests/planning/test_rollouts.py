"""Rollouts are what the env itself would do: each row of a plan, followed in the env, earns and moves as the plan says."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from mani_skill.envs.sapien_env import BaseEnv
from numpy.typing import NDArray

import workbench
from tests.planning.walking import MADE
from workbench.envs import action_vector
from workbench.envs.maniskill_private import open_env
from workbench.envs.scene.scene_index import read_poses, scene_index
from workbench.planning.options import PlanOptions
from workbench.planning.rollouts import (
    NothingToPlan,
    Plan,
    RolloutPlanner,
    control_mode_to_plan,
    make_rollout_env,
    require_plannable,
)

OPTIONS = PlanOptions("predictive", rollouts=8, horizon=0.2, rounds=2)
PLANNED = 2
HAND = "panda/panda_hand_tcp"

pytestmark = pytest.mark.thorough


@pytest.fixture(scope="module")
def env() -> Iterator[Any]:
    """Three envs in the middle of their episodes, all in other states."""
    env: Any = workbench.make("PushCube-v1", 3, reward_mode="dense", **MADE)
    env.reset(seed=[5, 6, 7])
    for turn in range(6):
        action = torch.zeros((3, 7))
        action[:, turn % 3] = torch.tensor([0.2, -0.4, 0.6])
        env.step(action)
    yield env
    env.close()


@pytest.fixture(scope="module")
def planner(env: Any) -> Iterator[RolloutPlanner]:
    # How the env is driven and what it earns is read from the env itself.
    rolled = make_rollout_env(open_env(env), {}, OPTIONS.rollouts)
    planner = RolloutPlanner(rolled, OPTIONS)
    yield planner
    planner.close()


@pytest.fixture(scope="module")
def plans(env: Any, planner: RolloutPlanner) -> tuple[Plan, Plan]:
    """Two plans in succession of the same state."""
    snapshot, traced = workbench.take_snapshot(env), scene_index(open_env(env)).names.index(HAND)
    planner.begin(PLANNED, seed=3)
    first, second = (planner.plan(snapshot, PLANNED, traced) for _ in range(2))
    return first, second


def followed(env: Any, actions: NDArray[np.float32]) -> tuple[list[float], NDArray[np.float32]]:
    """Rewards (H,) and path (H + 1, 3) of the hand in the planned env under these actions (H, A); the env then returns."""
    live = open_env(env)
    hand, parts = scene_index(live).names.index(HAND), action_vector.action_parts(live)
    snapshot, rewards, path = workbench.take_snapshot(env), [], [read_poses(live)[PLANNED, hand, :3]]
    for action in actions:
        flat = action_vector.hold_action(parts, 3)
        flat[PLANNED] = action
        _, reward, *_ = env.step(action_vector.to_env_action(live, parts, flat))
        rewards.append(float(reward[PLANNED]))
        path.append(read_poses(live)[PLANNED, hand, :3])
    workbench.restore_snapshot(env, snapshot)
    return rewards, np.stack(path)


def test_the_plan_and_holding_still_earn_in_the_env_what_their_rollouts_earned(
    env: Any, plans: tuple[Plan, Plan]
) -> None:
    plan = plans[0]
    assert plan.actions.shape == (4, 7) and plan.rewards.shape == (8, 4) and plan.paths is not None
    hold = action_vector.hold_action(action_vector.action_parts(open_env(env)), 3)[PLANNED]
    for row, actions in ((plan.best, plan.actions), (1, np.tile(hold, (4, 1)))):
        rewards, path = followed(env, actions)
        np.testing.assert_allclose(plan.rewards[row], rewards, atol=1e-4)
        np.testing.assert_allclose(plan.paths[row], path, atol=1e-4)
    assert plan.returns[plan.best] == plan.returns.max() > plan.returns[1]
    assert np.ptp(plan.paths[:, 0], axis=0).max() < 1e-6 and np.ptp(plan.paths[:, -1], axis=0).max() > 1e-3
    assert not plan.success_at.any()


def test_the_next_plan_begins_with_the_rest_of_the_last_one(env: Any, plans: tuple[Plan, Plan]) -> None:
    """Of four knots in four steps each is the action of one step. What the last plan earned is tried again."""
    before, now = plans
    rest = np.concatenate([before.actions[1:], before.actions[-1:]])
    rewards, _ = followed(env, rest)
    assert now.returns.max() >= sum(rewards) - 1e-4


def test_planning_for_one_env_is_not_planning_for_another(env: Any, planner: RolloutPlanner) -> None:
    snapshot = workbench.take_snapshot(env, [0, PLANNED])
    starts = []
    for number in (0, PLANNED):
        planner.begin(number, seed=3)
        starts.append(planner.plan(snapshot, number, 0).rewards[1])
    assert not np.allclose(*starts)
    with pytest.raises(KeyError):
        planner.plan(snapshot, 1)


def test_envs_for_rollouts_earn_and_are_driven_as_the_env_but_show_nothing(
    env: Any, planner: RolloutPlanner
) -> None:
    rolled = planner.env
    assert (rolled.num_envs, rolled.reward_mode, rolled.control_mode) == (8, "dense", "pd_ee_delta_pose")
    assert rolled.obs_mode == "state_dict" and not rolled.scene.can_render()
    with pytest.raises(ValueError, match="8"):
        RolloutPlanner(rolled, PlanOptions(rollouts=9))


def test_a_task_without_a_reward_is_not_planned() -> None:
    with pytest.raises(NothingToPlan):
        require_plannable(cast(BaseEnv, SimpleNamespace(reward_mode="none")))


@pytest.mark.parametrize(
    ("modes", "present", "given", "planned"),
    [
        (("pd_joint_pos", "pd_ee_delta_pose"), "pd_joint_pos", {}, "pd_ee_delta_pose"),
        (("pd_joint_pos", "pd_ee_delta_pose"), "pd_joint_pos", {"control_mode": None}, "pd_ee_delta_pose"),
        (("pd_joint_pos", "pd_ee_delta_pose"), "pd_joint_pos", {"control_mode": "pd_joint_pos"}, None),
        (("pd_joint_pos",), "pd_joint_pos", {}, None),
        (("pd_joint_pos", "pd_ee_delta_pose"), "pd_ee_delta_pose", {}, None),
    ],
)
def test_the_mode_of_the_hand_is_planned_in_unless_a_person_chose_one(
    modes: tuple[str, ...], present: str, given: dict[str, Any], planned: str | None
) -> None:
    env = SimpleNamespace(agent=SimpleNamespace(supported_control_modes=modes), control_mode=present)
    assert control_mode_to_plan(cast(BaseEnv, env), given).get("control_mode") == planned
