"""On manipulation examples a scripted policy succeeds from every seed, with the maximum reward on success."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch

import workbench
from tests.tasks import solvers
from tests.tasks.conftest import FOLDER

pytestmark = pytest.mark.thorough

SEEDS = 6
Policy = Callable[[torch.Tensor], torch.Tensor]


@pytest.fixture
def make_batch() -> Iterator[Callable[[str], Any]]:
    envs: list[Any] = []

    def make(name: str) -> Any:
        env = workbench.make(
            FOLDER / f"{name}.py",
            num_envs=SEEDS,
            backend="cpu",
            rules="stop",
            render_backend="none",
            obs_mode="state",
            control_mode="pd_ee_delta_pos",
        )
        envs.append(env)
        return env

    yield make
    for env in envs:
        env.close()


def one_robot(actions: torch.Tensor) -> Any:
    return actions


def two_robots(actions: torch.Tensor) -> Any:
    left, right = actions.chunk(2, dim=1)
    return {"panda-0": left, "panda-1": right}


@pytest.mark.filterwarnings("ignore:.*which exists already")  # the class that the fixture imported
@pytest.mark.parametrize(
    ("name", "policy", "as_action"),
    [
        ("articulated", solvers.open_drawer, one_robot),
        ("reward_terms", solvers.lift_cube, one_robot),
        pytest.param("two_robots", solvers.lift_bar, two_robots, marks=pytest.mark.slow),
    ],
)
def test_a_scripted_policy_succeeds_from_every_seed_with_maximum_reward(
    make_batch: Callable[[str], Any], name: str, policy: Policy, as_action: Callable[[torch.Tensor], Any]
) -> None:
    env = make_batch(name)
    obs, info = env.reset(seed=0)
    assert not info["success"].any()
    best, done = torch.zeros(SEEDS), torch.zeros(SEEDS, dtype=torch.bool)
    for _ in range(40):
        obs, reward, *_, info = env.step(as_action(policy(obs)))
        assert (reward[info["success"]] == 1).all() and (reward[~info["success"]] < 0.9).all()
        best, done = torch.maximum(best, reward), done | info["success"]
        if done.all():
            break
    assert done.all() and (best == 1).all()
