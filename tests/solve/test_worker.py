"""Plans in the worker: requested once per state, followed until something else moves the envs, and made by rollouts."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from tests.drive.session import TASKS
from workbench.live.messages import FollowPlan, PlanDropped, PlanWanted, Settings
from workbench.planning.options import PlanOptions
from workbench.planning.rollouts import bodies_of
from workbench.solve.questions import PlanActions, PlannedEnv
from workbench.solve.worker import MAX_PATHS, FollowedPlan, WorkerPlans, envs_to_plan
from workbench.task.description import TaskOptions
from workbench.task.load import load_task
from workbench.task.open import OpenedTask, Opening, build_task

MADE: dict[str, object] = {"render_backend": "none", "control_mode": "pd_ee_delta_pose"}
SMALL = PlanOptions(rollouts=6, horizon=0.2)

pytestmark = pytest.mark.usefixtures("child_process")


@pytest.fixture(scope="module")
def push() -> Iterator[OpenedTask]:
    options, opening = TaskOptions(2, "cpu", 0, MADE), Opening(on_finding=lambda finding: None)
    opened = build_task(load_task(str(TASKS / "push_cube.py")), options, opening)
    yield opened
    opened.env.close()


def bodies_in(opened: OpenedTask, envs: list[int]) -> tuple[dict[str, bytes], ...]:
    return tuple(bodies_of(opened.env.env)[env] for env in envs)


@pytest.fixture
def plan(push: OpenedTask) -> Iterator[Callable[..., tuple[PlannedEnv, ...]]]:
    plans = WorkerPlans(lambda: False)

    def ask(envs: list[int], options: PlanOptions = SMALL, traced: str = "") -> tuple[PlannedEnv, ...]:
        question = PlanActions(pickle.dumps(push.env.snapshot(envs)), bodies_in(push, envs), options, traced)
        return plans.answer(push, MADE, question, lambda done, total: None).envs

    yield ask
    plans.close()


def test_each_env_gets_its_own_plan_with_its_rollouts_returns(
    push: OpenedTask, plan: Callable[..., tuple[PlannedEnv, ...]]
) -> None:
    poses = push.env.reset(3).poses
    one, other = plan([0, 1])
    assert (one.env, other.env) == (0, 1) and one.horizon == 4
    assert one.actions.shape == (1, 7) and not np.array_equal(one.returns, other.returns)
    assert (np.diff(one.returns) <= 0).all() and {one.plan, one.hold} <= set(range(6))
    assert one.paths.shape == (6, 5, 3) and one.drawn == tuple(range(6)) and len(one.drawn) <= MAX_PATHS
    # Paths start at the hand.
    hand = push.description.geometry.body_names.index("panda/panda_hand_tcp")
    assert np.abs(one.paths[:, 0] - poses[0, hand, :3]).max() < 1e-5
    for rollouts in (4, 8):
        (again,) = plan([0], PlanOptions(rollouts=rollouts, horizon=0.2))
        assert len(again.returns) == len(again.paths) == rollouts


def test_a_plan_is_requested_once_and_dropped_if_something_else_moved_the_envs(push: OpenedTask) -> None:
    requested: list[PlanWanted] = []
    dropped: list[PlanDropped] = []

    def send(event: PlanWanted | PlanDropped) -> None:
        if isinstance(event, PlanWanted):
            requested.append(event)
        else:
            dropped.append(event)

    followed = FollowedPlan(send)
    assert not followed.ready(push, 5, [1]) and not followed.ready(push, 5, [1])
    assert [(one.number, one.env_idx) for one in requested] == [(5, (1,))] and followed.awaited
    assert pickle.loads(requested[0].snapshot).env_idx == (1,)
    assert requested[0].bodies == bodies_in(push, [1]) and "cube" in requested[0].bodies[0]
    actions = np.full((2, 1, 7), 0.25, np.float32)
    followed.take(FollowPlan(4, (1,), actions))
    assert followed.awaited, "a plan for another state must be ignored"
    followed.take(FollowPlan(5, (1,), actions))
    assert followed.ready(push, 5, [1]) and not followed.awaited
    action = followed.next_action(push.env, 5)
    assert (action[1] == 0.25).all() and not (action[0] == 0.25).any()
    assert followed.ready(push, 6, [1]) and len(requested) == 1
    # A reset in between invalidates the plan.
    assert not followed.ready(push, 7, [1]) and len(requested) == 2 and not dropped
    followed.forget()
    assert len(dropped) == 1
    followed.forget()
    assert len(dropped) == 1, "nothing was requested since"
    followed.take(FollowPlan(7, (1,), actions))
    assert not followed.ready(push, 7, [1])


def test_solved_envs_get_no_plan_until_all_are_solved(push: OpenedTask) -> None:
    last = push.env.reset(3)
    assert envs_to_plan(Settings(selected_env=1), push.env, last) == [1]
    assert envs_to_plan(Settings(selected_env=5), push.env, last) == [1], "a rebuild left fewer envs"
    every = Settings(solve_all=True)
    assert envs_to_plan(every, push.env, last) == [0, 1]
    last.evaluate["success"] = np.array([True, False])
    assert envs_to_plan(every, push.env, last) == [1]
    last.evaluate["success"] = np.array([True, True])
    assert envs_to_plan(every, push.env, last) == [0, 1]
