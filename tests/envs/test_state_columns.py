"""State columns against what ManiSkill's own RecordEpisode would keep of the same moment."""

from __future__ import annotations

from typing import Any, ClassVar

import mani_skill.envs  # noqa: F401  registers the ids
import numpy as np
import pytest
import torch
from mani_skill.utils import common

from tests.drive.envs import PICK_CUBE, batched
from workbench.envs.hot_swap import put_class
from workbench.envs.recorded_run import states_of
from workbench.envs.state_columns import StateReading, read_state_columns
from workbench.envs.task_env import TaskEnv


def made(env_id: str, num_envs: int = 3, **kwargs: Any) -> TaskEnv:
    task = TaskEnv(batched(env_id, num_envs, **kwargs))
    task.reset(seed=0)
    task.step(None)
    return task


@pytest.mark.parametrize("obs_mode", ["state", "state_dict"])
def test_columns_are_the_state_dict_and_the_observation(obs_mode: str) -> None:
    task = made("PickCube-v1", obs_mode=obs_mode)
    columns = read_state_columns(task)
    state: Any = task.env.get_state_dict()
    for group, structs in state.items():
        for name, rows in structs.items():
            np.testing.assert_array_equal(columns[f"state/{group}/{name}"], rows.numpy())
    seen = {name: column for name, column in columns.items() if name.startswith("obs/")}
    assert {"obs/agent/qpos", "obs/extra/is_grasped", "obs/extra/tcp_pose"} <= seen.keys()
    flat = torch.cat([torch.from_numpy(c).reshape(3, -1).float() for c in seen.values()], dim=1)
    observed: Any = task.obs
    if obs_mode == "state_dict":
        observed = common.flatten_state_dict(observed, use_torch=True)
    assert torch.equal(flat, observed)
    task.close()


def test_what_the_task_itself_moves_has_no_velocity_whatever_was_written() -> None:
    task = made("PickCube-v1", rules="off")
    env: Any = task.env
    for actor in (env.goal_site, env.cube):
        actor.set_linear_velocity(torch.ones(3, 3))
    columns = read_state_columns(task)
    for actor, speed in ((env.goal_site, 0.0), (env.cube, 1.0)):
        column = columns[f"state/actors/{actor.name}"]
        assert (column[:, 7:10] == speed).all()
        np.testing.assert_array_equal(column, actor.get_state().numpy())
    task.close()


class Observes(PICK_CUBE):
    evaluated: ClassVar[list[int]] = []
    """Of the class: what asks for the names leaves an env's own attributes as they were."""

    def evaluate(self) -> dict[str, Any]:
        self.evaluated.append(1)
        return super().evaluate()

    def _get_obs_extra(self, info: dict[str, Any]) -> dict[str, Any]:
        return {**super()._get_obs_extra(info), "nothing": torch.zeros((self.num_envs, 0))}


def test_the_names_of_a_flat_observation_are_asked_for_once_and_what_is_empty_has_none() -> None:
    task = TaskEnv(batched(Observes, 3, obs_mode="state"))
    task.reset(seed=0)
    before = len(Observes.evaluated)
    columns = read_state_columns(task)
    evaluated = len(Observes.evaluated)
    assert evaluated > before
    assert "obs/extra/tcp_pose" in columns and "obs/extra/nothing" not in columns
    assert [*read_state_columns(task)] == [*columns] and len(Observes.evaluated) == evaluated
    task.close()


class ObservesOtherwise(PICK_CUBE):
    def _get_obs_extra(self, info: dict[str, Any]) -> dict[str, Any]:
        return {f"{name}_now": value for name, value in super()._get_obs_extra(info).items()}


def test_the_names_are_those_of_the_class_that_the_env_has_now() -> None:
    """As after a reload: as wide an observation, under other names."""
    task = TaskEnv(batched(Observes, 3, obs_mode="state"))
    task.reset(seed=0)
    assert "obs/extra/tcp_pose" in read_state_columns(task)
    put_class(task.env, ObservesOtherwise)
    task.step(None)
    names = read_state_columns(task).keys()
    assert "obs/extra/tcp_pose_now" in names and "obs/extra/tcp_pose" not in names
    task.close()


class Remembers(PICK_CUBE):
    """With a state of its own."""

    def get_state_dict(self) -> dict[str, Any]:
        return {**super().get_state_dict(), "goals": {"best": torch.arange(3.0)}}


def test_a_task_with_a_state_of_its_own_is_asked_for_it() -> None:
    task = TaskEnv(batched(Remembers, 3))
    task.reset(seed=0)
    columns = read_state_columns(task)
    assert columns["state/goals/best"].tolist() == [0, 1, 2] and "state/actors/cube" in columns
    task.close()


def test_what_lies_on_a_device_comes_as_it_is_in_its_order() -> None:
    """Put together by type on the way; here nothing but the name of the device is a GPU's."""
    asked = {
        "b": torch.arange(12.0).reshape(2, 3, 2),
        "truths": torch.tensor([True, False]),
        "a": torch.tensor([7.0, 8.0]),
        "known": np.array([1, 2]),
        "none": torch.zeros((2, 0)),
    }
    columns = StateReading(None, asked, {}, 2, torch.device("cuda")).columns()
    assert list(columns) == list(asked)
    for name, value in asked.items():
        column = columns[name]
        assert column.shape == tuple(value.shape) and column.dtype == np.asarray(value).dtype
        np.testing.assert_array_equal(column, np.asarray(value))


def test_what_an_env_does_not_have_is_left_out_of_its_states() -> None:
    columns = {
        "state/actors/mug": np.array([[np.nan] * 13, [0.5] * 13], np.float32),
        "obs/agent/qpos": np.full((2, 2), np.nan),
    }
    assert states_of(columns, 0) == {}
    assert list(states_of(columns, 1)) == ["actors/mug"]
