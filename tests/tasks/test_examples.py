"""Every example task works in stock ManiSkill and with the workbench."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch

import workbench
from tests.tasks.conftest import FOLDER, IDS, LOGGED

pytestmark = pytest.mark.thorough

Make = Callable[..., Any]
EXAMPLES = ("push_cube", "minimal")
"""The examples that a reader starts with; the other files of `IDS` show one idea each."""
REWARD_MODES = {"push_cube": ("normalized_dense", "dense", "sparse", "none"), "minimal": ("sparse", "none")}
WITH_REWARD = [(name, mode) for name, modes in REWARD_MODES.items() for mode in modes]


@pytest.mark.parametrize(("name", "mode"), WITH_REWARD)
def test_random_steps_return_finite_batched_numbers_in_every_reward_mode(
    name: str, mode: str, make: Make
) -> None:
    env = make(name, reward_mode=mode, obs_mode="state")
    env.action_space.seed(0)
    obs, _ = env.reset(seed=0)
    for step in range(1, 21):
        obs, reward, terminated, truncated, info = env.step(env.action_space.sample())
        assert obs.shape == env.observation_space.shape and obs.ndim == 2
        assert reward.shape == terminated.shape == truncated.shape == (1,)
        assert torch.isfinite(obs).all() and torch.isfinite(reward).all()
        assert terminated.dtype == info["success"].dtype == torch.bool
        terms = info.pop("reward_terms", {})
        assert all(value.shape[0] == 1 for value in (*info.values(), *terms.values()))
        if terms and mode == "dense":
            torch.testing.assert_close(sum(terms.values()), reward)
        assert int(info["elapsed_steps"]) == step


@pytest.mark.parametrize("name", EXAMPLES)
def test_no_episode_starts_with_success_or_failure(name: str, make: Make) -> None:
    env = make(name)
    for seed in range(10):
        _, info = env.reset(seed=seed)
        assert not info["success"].any() and not info.get("fail", torch.zeros(1)).any()


# --- all examples --------------------------------------------------------------------------------


def numbers(found: Any) -> list[torch.Tensor]:
    """Return the leaves of an observation or an action as tensors."""
    if isinstance(found, dict):
        return [leaf for each in found.values() for leaf in numbers(each)]
    return [torch.as_tensor(found)]


def test_every_example_is_listed() -> None:
    assert {file.stem for file in FOLDER.glob("*.py")} == IDS.keys()


@pytest.mark.parametrize("name", IDS)
def test_stock_maniskill_makes_and_steps_each_example_without_a_warning(
    name: str, make: Make, mani_skill_log: list[str]
) -> None:
    env = make(name, obs_mode="state_dict")
    env.action_space.seed(0)
    env.reset(seed=0)
    for _ in range(5):
        obs, reward, terminated, _, _ = env.step(env.action_space.sample())
        assert all(leaf.shape[0] == 1 and torch.isfinite(leaf).all() for leaf in numbers(obs))
        assert reward.shape == terminated.shape == (1,) and torch.isfinite(reward).all()
    assert set(mani_skill_log) <= LOGGED.get(name, set())


@pytest.mark.filterwarnings("ignore:.*which exists already")  # the class that the fixture imported
@pytest.mark.parametrize("name", IDS)
def test_the_workbench_steps_several_envs_of_each_example_and_resets_one(name: str) -> None:
    env: Any = workbench.make(
        FOLDER / f"{name}.py",
        num_envs=2,
        backend="cpu",
        render_backend="none",
        obs_mode="state_dict",
        rules="stop",
    )
    try:
        env.action_space.seed(0)
        env.reset(seed=0)
        env.step(env.action_space.sample())
        obs, reward, *_ = env.step(env.action_space.sample())
        before = [leaf[0].clone() for leaf in numbers(obs)]
        obs, _ = env.reset(seed=1, options={"env_idx": torch.tensor([1])})
        assert reward.shape == (2,) and torch.isfinite(reward).all()
        for left, leaf in zip(before, numbers(obs), strict=True):
            torch.testing.assert_close(leaf[0], left)
    finally:
        env.close()
