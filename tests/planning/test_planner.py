"""`workbench.Planner`: plans depend only on the state and the seed, and planning does not change the env."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch

import workbench
from tests.drive.render_device import RENDER_BACKEND
from tests.planning.walking import MADE, SMALL, walk
from workbench.envs.action_vector import action_parts, hold_action
from workbench.envs.maniskill_private import open_env
from workbench.envs.snapshots.cpu_state import CpuState
from workbench.planning.rollouts import NotAlike

Planned = Callable[..., tuple[Any, workbench.Planner]]
TASKS = Path(__file__).parents[2] / "tasks"
TASK_SOURCE = '''
"""Rewards a rising hand; `trouble` adds NaN rewards, an early failure or random rewards."""
import torch
from mani_skill.envs.tasks import PushCubeEnv
from mani_skill.utils.registration import register_env


@register_env("Planned-v1", max_episode_steps=20)
class PlannedEnv(PushCubeEnv):
    trouble = ""

    def __init__(self, *args, trouble="", **kwargs):
        self.trouble = trouble
        super().__init__(*args, **kwargs)

    def evaluate(self):
        height = self.agent.tcp.pose.p[:, 2]
        fail = height > 0.2 if self.trouble == "fail" else torch.zeros_like(height, dtype=torch.bool)
        success = height > (0.19 if self.trouble == "fail" else 5.0)
        return {"success": success, "fail": fail, "height": height}

    def compute_dense_reward(self, obs, action, info):
        height = info["height"]
        if self.trouble == "nan":
            return torch.where(height > 0.2, torch.nan, 1 - height)
        if self.trouble == "noise":
            return height + torch.rand_like(height)
        info["reward_terms"] = {"height": height, "still": torch.zeros_like(height)}
        return height

    def compute_normalized_dense_reward(self, obs, action, info):
        return self.compute_dense_reward(obs, action, info)
'''

pytestmark = pytest.mark.usefixtures("child_process")


@pytest.fixture(scope="module")
def task(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("planned") / "planned.py"
    file.write_text(TASK_SOURCE)
    return file


@pytest.fixture(scope="module")
def push() -> Iterator[tuple[Any, workbench.Planner]]:
    env = workbench.make("PushCube-v1", 4, **MADE)
    planner = workbench.Planner(env, **SMALL)
    yield env, planner
    planner.close()
    env.close()


@pytest.fixture
def planned() -> Iterator[Planned]:
    """Makes an env and its planner, which are closed after the test; keywords are those of `workbench.make`."""
    with ExitStack() as closed:

        def make(
            task: str | Path, num_envs: int = 1, options: dict[str, Any] = SMALL, **more: Any
        ) -> tuple[Any, workbench.Planner]:
            env = workbench.make(task, num_envs, **{**MADE, **more})
            closed.callback(env.close)
            planner = workbench.Planner(env, **options)
            closed.callback(planner.close)
            return env, planner

        yield make


def test_plans_do_not_depend_on_earlier_plans(
    push: tuple[Any, workbench.Planner],
) -> None:
    env, planner = push
    first = walk(env, planner, None)
    walk(env, planner, [1])
    assert first.shape == (3, 4, 7)
    np.testing.assert_array_equal(first, walk(env, planner, None))
    assert not np.array_equal(first[:, 0], first[:, 1])


def test_an_envs_plan_does_not_depend_on_the_batch(
    push: tuple[Any, workbench.Planner], planned: Planned
) -> None:
    env, planner = push
    together = walk(env, planner, None)
    np.testing.assert_array_equal(walk(*planned("PushCube-v1"), None)[:, 0], together[:, 0])


@pytest.mark.slow
def test_another_process_gives_the_same_plan(push: tuple[Any, workbench.Planner]) -> None:
    env, planner = push
    here = walk(env, planner, None)
    program = (
        "import workbench; from tests.planning.walking import MADE, SMALL, walk\n"
        "env = workbench.make('PushCube-v1', 4, **MADE); planner = workbench.Planner(env, threads=1, **SMALL)\n"
        "print(walk(env, planner, None).tobytes().hex())"
    )
    top = Path(__file__).parents[2]
    there = subprocess.run(
        [sys.executable, "-c", program], cwd=top, check=True, capture_output=True, text=True
    )
    assert there.stdout.split()[-1] == here.tobytes().hex()


def test_planning_changes_neither_the_env_nor_the_processs_generators(
    push: tuple[Any, workbench.Planner],
) -> None:
    env, planner = push
    walk(env, planner, [3], steps=1)
    before, drawn = workbench.take_snapshot(env), torch.get_rng_state()
    planner.actions([3])
    after = workbench.take_snapshot(env)
    assert torch.equal(torch.get_rng_state(), drawn)
    one, other = (cast(CpuState, each.simulation) for each in (before, after))
    assert [one.essence(k) for k in range(4)] == [other.essence(k) for k in range(4)]
    np.testing.assert_array_equal(after.memory.elapsed_steps, before.memory.elapsed_steps)
    assert after.memory.task.buffers.keys() == before.memory.task.buffers.keys()
    for name, buffer in after.memory.task.buffers.items():
        assert buffer.is_as(before.memory.task.buffers[name]), name


def test_envs_without_a_plan_hold_still(push: tuple[Any, workbench.Planner]) -> None:
    env, planner = push
    taken = walk(env, planner, [2])
    assert not taken[:, [0, 1, 3], :6].any()
    assert taken[:, 2, :6].any()


def test_actions_stay_within_the_space(push: tuple[Any, workbench.Planner]) -> None:
    env, planner = push
    taken = walk(env, planner, [0])
    space = env.unwrapped.single_action_space
    assert (taken >= space.low).all() and (taken <= space.high).all()


def test_every_sets_how_many_actions_of_each_envs_plan_are_taken(task: Path, planned: Planned) -> None:
    env, planner = planned(task, 2, {"every": 3, **SMALL})
    env.reset(seed=0)
    plans, taken = [], [(0, 0), (1, 1), (2, 0), (0, 1)]
    for turn, numbers in enumerate(taken):
        if turn == 2:
            planner.reset(1)  # its episode begins anew
        action = planner.actions()
        plans.append(dict(planner.plans))
        for number, at in enumerate(numbers):
            np.testing.assert_array_equal(action[number].numpy(), planner.plans[number].actions[at])
        env.step(action)
    for number, first in enumerate(([True, True, True, False], [True, True, False, False])):
        assert [each[number] is plans[0][number] for each in plans] == first
    assert plans[2][1] is plans[3][1]


@pytest.mark.parametrize("trouble", [pytest.param("nan", marks=pytest.mark.slow), "fail"])
def test_a_rollout_earns_nothing_after_a_fail_and_ranks_worst_with_nan(
    task: Path, planned: Planned, trouble: str
) -> None:
    env, planner = planned(task, 1, {"rollouts": 32, "horizon": 0.5}, trouble=trouble)
    env.reset(seed=0)
    troubled = 0
    for _ in range(8):
        _, _, _, _, info = env.step(planner.actions())
        plan = planner.plans[0]
        troubled += int(
            np.isnan(plan.rewards).any() if trouble == "nan" else (plan.rewards[:, -1] == 0).any()
        )
        assert np.isfinite(plan.returns[plan.best])
        assert np.isfinite(plan.actions).all()
        if trouble == "fail":
            ended = (plan.rewards == 0).argmax(1)
            for rewards, at in zip(plan.rewards, ended):
                assert not rewards[at:].any() or at == 0
            high = plan.rewards > 0.19
            assert plan.success_at.tolist() == np.where(high.any(1), high.argmax(1) + 1, 0).tolist()
            assert plan.terms.keys() == {"height", "still"} and not plan.terms["still"].any()
            np.testing.assert_allclose(plan.terms["height"], plan.returns, rtol=1e-5)
    assert float(info["height"]) < 0.2
    assert troubled


def test_random_draws_of_a_tasks_step_are_repeatable(task: Path, planned: Planned) -> None:
    env, planner = planned(task, trouble="noise")
    first = walk(env, planner, None, steps=2)
    torch.manual_seed(99)
    assert np.array_equal(first[0], walk(env, planner, None, steps=2)[0])


def test_rollouts_of_an_env_with_picture_observations_render_nothing(planned: Planned) -> None:
    pictured = {"obs_mode": "rgb", "control_mode": "pd_joint_pos", "render_backend": RENDER_BACKEND}
    env, planner = planned("PushCube-v1", **pictured)
    rolled = planner.rollout_env
    assert rolled.obs_mode == "state_dict" and not rolled.scene.can_render()
    assert rolled.control_mode == "pd_joint_pos" and planner.horizon == 4
    env.reset(seed=0)
    hold = hold_action(action_parts(open_env(env)), 1)[0]
    # No plan crosses the whole range of a joint.
    away = (
        np.abs(planner.flat_actions(0)[0] - hold)[:7]
        / np.ptp([env.action_space.low, env.action_space.high], axis=0)[:7]
    )
    assert 0.003 < away.max() < 0.05
    env.step(planner.actions())


def test_a_task_whose_bodies_differ_by_env_is_refused_with_their_name(planned: Planned) -> None:
    env, planner = planned(TASKS / "different_objects.py", 4, control_mode=None)
    env.reset(seed=0)
    with pytest.raises(NotAlike, match="object"):
        planner.actions()


def test_bodies_that_a_rebuild_changes_are_compared_again(task: Path, planned: Planned) -> None:
    env, planner = planned(task, control_mode=None)
    env.reset(seed=0)
    planner.actions()
    cast(Any, env.unwrapped).cube_half_size = 0.05
    env.reset(seed=0, options={"reconfigure": True})
    with pytest.raises(NotAlike, match="cube"):
        planner.actions()


def test_several_robots_get_a_dict_of_actions(planned: Planned) -> None:
    env, planner = planned(TASKS / "two_robots.py", control_mode=None)
    env.reset(seed=0)
    action = planner.actions()
    assert isinstance(action, dict) and len(action) == 2
    env.step(action)
