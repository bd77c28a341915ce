"""A partial reset leaves the other envs' controllers alone, and its errors name the envs and buffers at fault."""

# pyright: reportAttributeAccessIssue=false, reportArgumentType=false, reportOptionalMemberAccess=false

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mani_skill.envs  # noqa: F401  registers the ids
import numpy as np
import pytest
import sapien
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils.structs import Pose

from tests.drive.envs import PICK_CUBE, batched
from tests.envs.stock_env import Bare, batch_of, single


def made(task: str | type[BaseEnv] = PICK_CUBE, num_envs: int = 4, **kwargs: Any) -> Any:
    return batched(task, num_envs, rules="off", **kwargs)


@pytest.mark.thorough
@pytest.mark.parametrize("control_mode", ["pd_joint_target_delta_pos", "pd_ee_target_delta_pose"])
def test_an_env_that_is_not_reset_keeps_its_target(control_mode: str) -> None:
    env = made(control_mode=control_mode)
    rng = np.random.default_rng(0)
    chosen = [rng.uniform(-1, 1, env.action_space.shape).astype(np.float32) for _ in range(12)]

    def run(reset_others: bool) -> list[bytes]:
        env.reset(seed=[1, 2, 3, 4])
        for step, action in enumerate(chosen):
            if reset_others and step == 6:
                env.reset(options={"env_idx": torch.tensor([0, 1, 3])})
            env.step(action)
        return env.scene.px.systems[2].pack()

    assert run(reset_others=False) == run(reset_others=True)
    env.close()


def test_the_first_observation_after_a_partial_reset_shows_kept_targets() -> None:
    env = made(control_mode="pd_joint_target_delta_pos", obs_mode="state_dict")
    env.reset(seed=[1, 2, 3, 4])
    for _ in range(5):
        env.step(np.full(env.action_space.shape, 0.7, np.float32))
    before = env.agent.get_controller_state()["arm"]["target_qpos"].clone()
    obs, _ = env.reset(options={"env_idx": torch.tensor([0, 3])})
    after = obs["agent"]["controller"]["arm"]["target_qpos"]
    assert torch.equal(after[[1, 2]], before[[1, 2]])
    assert torch.equal(after[[0, 3]], env.agent.robot.qpos[[0, 3], :7])
    env.close()


def test_of_several_robots_each_keeps_its_targets_in_the_other_envs() -> None:
    env = made("TwoRobotPickCube-v1", 3, control_mode="pd_joint_target_delta_pos")
    env.reset(seed=[1, 2, 3])
    rng = np.random.default_rng(0)
    for _ in range(3):
        env.step({name: rng.uniform(-1, 1, (3, 8)).astype(np.float32) for name in env.agent.agents_dict})
    targets = [agent.controller.controllers["arm"]._target_qpos.clone() for agent in env.agent.agents]
    env.reset(options={"env_idx": torch.tensor([0])})
    for agent, before in zip(env.agent.agents, targets, strict=True):
        now = agent.controller.controllers["arm"]._target_qpos
        assert (now != before).any(dim=1).tolist() == [True, False, False]
        assert torch.equal(now[0], agent.robot.qpos[0, :7])
    env.close()


class Starts(Bare):
    """Each env's generator draws the box's start position, which the scene and `start` hold."""

    def _load_scene(self, options: dict) -> None:
        builder = self.scene.create_actor_builder()
        builder.add_box_collision(half_size=[0.1] * 3)
        builder.initial_pose = sapien.Pose([0, 0, 1])
        self.box = builder.build_kinematic("box")
        self.start = torch.zeros(self.num_envs, 3)

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        drawn = torch.tensor(self._batched_episode_rng[env_idx].uniform(size=3), dtype=torch.float32)
        drawn[:, 2] = torch.rand(len(env_idx)) if options.get("torch") else drawn[:, 2]
        self.box.set_pose(Pose.create_from_pq(p=drawn))
        self.start[env_idx] = drawn

    def _get_obs_extra(self, info: dict) -> dict:
        return {"start": self.start}


@pytest.fixture
def starts() -> Iterator[Any]:
    env = batch_of(Starts, 4)
    yield env
    env.close()


@pytest.fixture
def stock() -> Iterator[Any]:
    env = single(Starts)
    yield env
    env.close()


def drawn_by_stock(stock: Any, seed: int, resets: int = 1) -> torch.Tensor:
    stock.reset(seed=seed)
    for _ in range(1, resets):
        stock.reset()
    return stock.box.pose.p[0]


@pytest.mark.parametrize(
    ("chosen", "reset_envs"),
    [
        ([2, 0], {0, 2}),
        ([-2, 0], {0, 2}),
        ([-1, -4], {0, 3}),
        (torch.tensor([2, 0]), {0, 2}),
        (np.array([2, 0]), {0, 2}),
    ],
)
def test_reset_envs_draw_like_single_envs_in_any_order(
    starts: Any, stock: Any, chosen: Any, reset_envs: set[int]
) -> None:
    seeds = [5, 6, 7, 8]
    starts.reset(seed=seeds)
    starts.reset(options={"env_idx": chosen})
    for env, seed in enumerate(seeds):
        expected = drawn_by_stock(stock, seed, resets=2 if env in reset_envs else 1)
        assert torch.equal(starts.box.pose.p[env], expected), env
        assert torch.equal(starts.start[env], expected), env


@pytest.mark.parametrize("seeds", [[40, 41], torch.tensor([40, 41])])
def test_seeds_for_some_envs_leave_the_other_envs_seeds(starts: Any, stock: Any, seeds: Any) -> None:
    starts.reset(seed=[5, 6, 7, 8])
    starts.reset(seed=seeds, options={"env_idx": torch.tensor([3, 1])})
    assert starts._episode_seed.tolist() == [5, 41, 7, 40]
    for env, seed in ((1, 41), (3, 40)):
        assert torch.equal(starts.box.pose.p[env], drawn_by_stock(stock, seed)), env
    starts.reset()
    for env, seed in ((0, 5), (1, 41), (2, 7), (3, 40)):
        assert torch.equal(starts.box.pose.p[env], drawn_by_stock(stock, seed, resets=2)), env


def test_seeds_for_some_envs_leave_the_process_generator_unchanged(starts: Any) -> None:
    starts.reset(seed=[5, 6, 7, 8])
    torch.manual_seed(3)
    expected = torch.rand(2)
    torch.manual_seed(3)
    starts.reset(seed=[40, 41], options={"env_idx": torch.tensor([0, 3]), "torch": True})
    assert torch.equal(torch.rand(2), expected)
    drawn = starts.box.pose.p[0, 2].clone()
    torch.manual_seed(40)
    assert drawn == torch.rand(2)[0], "in the reset, torch must draw from the lowest env's seed"
    assert starts._episode_rng is starts._batched_episode_rng[0]


@pytest.mark.parametrize("named", [[1, 3], [3, 1]])
def test_given_states_are_assigned_as_by_set_state_and_observations_in_env_idx_order(
    named: list[int],
) -> None:
    env = batch_of(Starts, 4, obs_mode="state")
    env.reset(seed=[5, 6, 7, 8])
    moved = env.get_state_dict()["actors"]["box"][[1, 3]].clone()
    moved[:, :3] = torch.tensor([[1.0, 0, 0], [3.0, 0, 0]])
    seen = torch.stack([torch.full((3,), float(i)) for i in named])
    given = {"env_states": {"actors": {"box": moved}}, "obs": seen.clone()}
    obs, _ = env.reset(options={"env_idx": torch.tensor(named), "reset_to_env_states": given})
    from_reset = env.box.pose.p.clone()
    assert from_reset[[1, 3]].tolist() == moved[:, :3].tolist()
    env.set_state_dict({"actors": {"box": moved}}, torch.tensor(named))
    assert torch.equal(env.box.pose.p, from_reset)
    assert (obs[1] == 1).all() and (obs[3] == 3).all() and not (obs[2] == 1).all()
    env.close()


def test_given_observations_may_be_nested() -> None:
    env = batch_of(Starts, 4, obs_mode="state_dict")
    env.reset(seed=[5, 6, 7, 8])
    moved = env.get_state_dict()["actors"]["box"][[1, 3]].clone()
    seen = {"agent": {}, "extra": {"start": torch.tensor([[3.0] * 3, [1.0] * 3])}}
    given = {"env_states": {"actors": {"box": moved}}, "obs": seen}
    obs, _ = env.reset(options={"env_idx": torch.tensor([3, 1]), "reset_to_env_states": given})
    assert obs["extra"]["start"][[1, 3], 0].tolist() == [1, 3]
    assert seen["extra"]["start"][0, 0] == 3, "the caller's observation stays"
    env.close()


@pytest.mark.parametrize(
    ("wrong", "error", "words"),
    [
        ([1, 1], ValueError, "names an env twice"),
        ([0, -4], ValueError, "names an env twice"),
        ([4], IndexError, "out of range for 4 envs"),
        ([-5], IndexError, "out of range for 4 envs"),
        (torch.tensor([True, False]), TypeError, "convert a mask"),
        ([], ValueError, "env_idx is empty"),
        ([0.5], TypeError, "must be integers"),
    ],
)
def test_an_invalid_env_idx_is_refused_and_changes_nothing(
    starts: Any, wrong: Any, error: type[Exception], words: str
) -> None:
    starts.reset(seed=[5, 6, 7, 8])
    before, states = starts.box.pose.raw_pose.clone(), starts._batched_episode_rng[0].get_state()[1].copy()
    with pytest.raises(error, match=words):
        starts.reset(options={"env_idx": wrong})
    assert torch.equal(starts.box.pose.raw_pose, before)
    assert np.array_equal(starts._batched_episode_rng[0].get_state()[1], states)


def test_a_mask_of_all_envs_selects_the_true_ones(starts: Any) -> None:
    starts.reset(seed=[5, 6, 7, 8])
    before = starts.box.pose.raw_pose.clone()
    starts.reset(seed=[1, 2], options={"env_idx": torch.tensor([True, False, True, False])})
    moved = (starts.box.pose.raw_pose != before).any(dim=1)
    assert moved.tolist() == [True, False, True, False]


class ForgetsRows(PICK_CUBE):
    """`start` loses rows in a partial reset; `goals` keeps them, and `corners` never had a row per env."""

    def _load_scene(self, options: dict) -> None:
        super()._load_scene(options)
        self.goals, self.corners = torch.zeros(self.num_envs, 3), torch.zeros(2, 3)

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        super()._initialize_episode(env_idx, options)
        self.start = torch.zeros(len(env_idx), 3)

    def evaluate(self) -> dict:
        return super().evaluate() | {"moved": self.cube.pose.p - self.start}


def test_a_failed_partial_reset_names_its_envs_and_the_buffers_that_lost_rows() -> None:
    env = made(ForgetsRows)
    with pytest.raises(Exception) as caught:
        env.reset(options={"env_idx": torch.tensor([1, 2])})
    text = Path(__file__).read_text()
    line = text[: text.index("self.start = torch.zeros(len(env_idx), 3)")].count("\n") + 1
    envs, lost = caught.value.__notes__
    assert "[1, 2] of 4" in envs
    # Only the buffer that lost rows is named, not the others with a row per env.
    assert "self.start: 4 rows" in lost and "2 now" in lost and f"{Path(__file__).name}:{line}" in lost
    env.close()
