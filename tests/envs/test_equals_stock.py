"""Each env of a batch equals ManiSkill's own single CPU env bit for bit, whatever the batch size.

These tasks cover the different kinds. The slow sweep (`test_every_task`) compares all ids that ship in mani_skill's
wheel; the docs page ``task_ids.md`` lists the results.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch
from mani_skill.envs.sapien_env import BaseEnv

from tests.sweeps import follow_stock
from tests.sweeps.follow_stock import MOVED_BY_THE_TASK, batch_of, compare, packed, take_over, touching
from workbench.envs import action_vector as actions

pytestmark = [
    pytest.mark.thorough,
    # Some of ManiSkill's own tasks break rules: `tests/envs/test_strict.py` lists them.
    pytest.mark.filterwarnings("ignore::workbench.envs.broken_rule.RuleWarning"),
]

CASES = (
    ("PickCube-v1", 8, 7),
    ("PushCube-v1", 4, 3),
    ("StackCube-v1", 6, 5),
    ("PegInsertionSide-v1", 4, 2),  # a different peg for every seed
    ("TwoRobotPickCube-v1", 4, 3),  # an action for each robot
    ("TriFingerRotateCubeLevel4-v1", 4, 3),  # three fingers touch the cube all the time
    # a hand, and a different object in each env
    pytest.param("RotateSingleObjectInHandLevel1-v1", 4, 3, marks=pytest.mark.slow),
    ("RotateValveLevel1-v1", 4, 3),  # a different articulation in each env
    ("SO100GraspCube-v1", 4, 3),  # controllers that remember their target
    ("MS-CartpoleBalance-v1", 4, 3),  # from MJCF, no contacts
    ("MS-HumanoidRun-v1", 4, 3),  # falls over itself
    pytest.param("UnitreeG1Stand-v1", 4, 3, marks=pytest.mark.slow),
)


@pytest.mark.parametrize(("env_id", "num_envs", "place"), CASES)
def test_an_env_follows_the_stock_single_env(env_id: str, num_envs: int, place: int) -> None:
    comparison = compare(env_id, num_envs, place)
    assert comparison.first_difference is None, comparison
    assert comparison.value_difference == 0, comparison


def test_the_comparison_detects_a_difference(monkeypatch: pytest.MonkeyPatch) -> None:
    def take_over_nearly(stock: Any, *others: Any) -> None:
        take_over(stock, *others)
        stock.agent.robot.set_qpos(stock.agent.robot.get_qpos() + 1e-6)

    monkeypatch.setattr(follow_stock, "take_over", take_over_nearly)
    comparison = compare("MS-CartpoleBalance-v1")
    assert comparison.first_difference == 1 and comparison.value_difference > 0


# --- independent of the batch ---------------------------------------------------------------------------

CROWDED = (
    "PickCube-v1",
    "TriFingerRotateCubeLevel4-v1",
    "MS-HumanoidRun-v1",
    # Builds scenes for nine seconds and adds nothing to the three above.
    pytest.param("RotateSingleObjectInHandLevel0-v1", marks=pytest.mark.slow),
    pytest.param("SO100GraspCube-v1", marks=pytest.mark.slow),
)
SEED = 5


@pytest.mark.parametrize("env_id", CROWDED)
def test_an_env_is_independent_of_batch_size_index_and_neighbours(
    env_id: str,
) -> None:
    model = batch_of(env_id, 1)
    model.reset(seed=[SEED], options={"reconfigure": True})
    state = model.scene.px.systems[0].pack()  # pyright: ignore[reportAttributeAccessIssue]
    touched: set[bool] = set()
    trajectories = [
        _trajectory(env_id, model, state, *where, touched) for where in ((1, 0), (2, 0), (5, 3), (5, 4))
    ]
    model.close()
    assert touched == {True}, "no contacts, so the test proved little"
    for trajectory in trajectories[1:]:
        assert trajectory == trajectories[0]


def _trajectory(
    env_id: str, model: BaseEnv, state: bytes, num_envs: int, place: int, touched: set[bool]
) -> list[bytes]:
    """Return the states of an env that starts in `model`'s state, with random actions and a reset of its neighbours."""
    env = batch_of(env_id, num_envs)
    # Where every seed builds a different object, this env gets the model's.
    seeds = [SEED if i == place else 20 + i for i in range(num_envs)]
    env.reset(seed=seeds, options={"reconfigure": True})
    take_over(env, place, model, 0, state)
    parts = actions.action_parts(env)
    mine, theirs = np.random.default_rng(1), np.random.default_rng([num_envs, place])
    without, _ = MOVED_BY_THE_TASK.get(env_id, (None, None))
    states = []
    for step in range(20):
        if step == 10 and num_envs > 1:
            neighbours = [i for i in range(num_envs) if i != place]
            env.reset(options={"env_idx": torch.tensor(neighbours)})
        flat = actions.random_action(parts, num_envs, theirs)
        flat[place] = actions.random_action(parts, 1, mine)[0]
        env.step(actions.to_env_action(env, parts, flat))
        states.append(packed(env, place, without))
        touched |= {True} if touching(env, place) else set()
    env.close()
    return states


# --- repeatability --------------------------------------------------------------------------------------


@pytest.fixture(params=["PickCube-v1", "TriFingerRotateCubeLevel4-v1", "PegInsertionSide-v1"])
def two_batches(request: pytest.FixtureRequest) -> Iterator[tuple[BaseEnv, BaseEnv]]:
    batches = batch_of(request.param, 3), batch_of(request.param, 3)
    yield batches
    for batch in batches:
        batch.close()


def test_the_same_seeds_and_actions_give_the_same_bits(two_batches: tuple[BaseEnv, BaseEnv]) -> None:
    first, second = (_episode(batch) for batch in two_batches)
    assert first == second, "in a second batch"
    assert _episode(two_batches[0]) == first, "in the same batch, a second time"


def _episode(batch: BaseEnv) -> list[bytes]:
    rng = np.random.default_rng(3)
    parts = actions.action_parts(batch)
    batch.reset(seed=[5, 6, 7])
    trajectory_states = []
    for _ in range(20):
        _, reward, _, _, _ = batch.step(
            actions.to_env_action(batch, parts, actions.random_action(parts, 3, rng))
        )
        trajectory_states += [packed(batch, i) for i in range(3)] + [
            torch.as_tensor(reward).numpy().tobytes()
        ]
    return trajectory_states
