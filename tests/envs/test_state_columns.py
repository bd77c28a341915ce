"""State columns equal the state dict and observation that ManiSkill's own RecordEpisode would store."""

from __future__ import annotations

from typing import Any, ClassVar

import mani_skill.envs  # noqa: F401  registers the ids
import numpy as np
import pytest
import torch
from mani_skill.utils import common

from tests.drive.envs import PICK_CUBE, batched
from workbench.envs.hot_swap import put_class
from workbench.envs.inspect_env import inspect_env
from workbench.envs.state_columns import StateReading, read_state_columns
from workbench.envs.task_env import TaskEnv


def made(env_id: Any, num_envs: int = 3, **kwargs: Any) -> TaskEnv:
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
    obs_columns = {name: column for name, column in columns.items() if name.startswith("obs/")}
    assert {"obs/agent/qpos", "obs/extra/is_grasped", "obs/extra/tcp_pose"} <= obs_columns.keys()
    flat = torch.cat([torch.from_numpy(c).reshape(3, -1).float() for c in obs_columns.values()], dim=1)
    observed: Any = task.obs
    if obs_mode == "state_dict":
        observed = common.flatten_state_dict(observed, use_torch=True)
    assert torch.equal(flat, observed)
    task.close()


def test_kinematic_actors_have_zero_velocity_even_after_a_write() -> None:
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


def test_of_an_observation_with_pictures_the_flat_part_is_split_and_pictures_are_left_out() -> None:
    task = made("PickCube-v1", obs_mode="state")
    flat = read_state_columns(task)
    picture = {"base_camera": {"rgb": torch.zeros(3, 4, 4, 3)}}
    kept = task.obs.clone()
    task.obs = {"state": task.obs, "sensor_data": picture, "sensor_param": picture, "mean": torch.tensor(1.0)}
    task.obs |= {
        "pointcloud": {"xyzw": torch.zeros(3, 9, 4)},
        "two": torch.zeros(2, 3),
        "each": torch.arange(3.0),
    }
    columns = read_state_columns(task)
    assert columns.keys() == flat.keys() | {"obs/each"}
    for name, column in flat.items():
        np.testing.assert_array_equal(columns[name], column)
    read = {leaf.name: leaf for leaf in inspect_env(task, 1, ["observation"]).observation or ()}
    np.testing.assert_array_equal(read["agent/qpos"].values, columns["obs/agent/qpos"][1])
    assert read["each"].values.tolist() == [1] and read["mean"].values.tolist() == [1]
    assert read["sensor_data/base_camera/rgb"].shape == (4, 4, 3)
    kept += 1
    task.env.step(None)
    assert not np.shares_memory(columns["obs/agent/qpos"], task.env.agent.robot.qpos.numpy())
    task.close()


class FlattensItself(PICK_CUBE):
    """An observation whose width is not that of its named parts."""

    def _flatten_raw_obs(self, obs: Any) -> Any:
        return torch.cat([super()._flatten_raw_obs(obs), torch.arange(3.0)[:, None]], dim=1)


def test_an_observation_that_a_task_flattens_in_its_own_way_has_no_names() -> None:
    task = made(FlattensItself, obs_mode="state")
    columns = {name: column for name, column in read_state_columns(task).items() if name.startswith("obs/")}
    assert [*columns] == ["obs/"] and columns["obs/"].shape == task.obs.shape
    [leaf] = list(inspect_env(task, 2, ["observation"]).observation or ())
    assert leaf.shape == task.obs.shape[1:] and leaf.high == float(task.obs[2].max())
    task.close()


class Observes(PICK_CUBE):
    evaluated: ClassVar[list[int]] = []
    """Kept on the class, since reading the names restores the env's own attributes."""

    def evaluate(self) -> dict[str, Any]:
        self.evaluated.append(1)
        return super().evaluate()

    def _get_obs_extra(self, info: dict[str, Any]) -> dict[str, Any]:
        return {**super()._get_obs_extra(info), "nothing": torch.zeros((self.num_envs, 0))}


def test_names_of_a_flat_observation_are_read_once_and_skip_empty_entries() -> None:
    task = TaskEnv(batched(Observes, 3, obs_mode="state"))
    task.reset(seed=0)
    before = len(Observes.evaluated)
    columns = read_state_columns(task)
    evaluated = len(Observes.evaluated)
    assert evaluated > before
    assert "obs/extra/tcp_pose" in columns and "obs/extra/nothing" not in columns
    assert [*read_state_columns(task)] == [*columns] and len(Observes.evaluated) == evaluated
    task.close()


class ObservesOtherNames(PICK_CUBE):
    def _get_obs_extra(self, info: dict[str, Any]) -> dict[str, Any]:
        return {f"{name}_now": value for name, value in super()._get_obs_extra(info).items()}


def test_names_follow_a_new_class_of_the_env() -> None:
    """After a reload the observation may have the same width and other names."""
    task = TaskEnv(batched(Observes, 3, obs_mode="state"))
    task.reset(seed=0)
    assert "obs/extra/tcp_pose" in read_state_columns(task)
    put_class(task.env, ObservesOtherNames)
    task.step(None)
    names = read_state_columns(task).keys()
    assert "obs/extra/tcp_pose_now" in names and "obs/extra/tcp_pose" not in names
    task.close()


class Remembers(PICK_CUBE):
    """Adds an entry to the state dict."""

    def get_state_dict(self) -> dict[str, Any]:
        return {**super().get_state_dict(), "goals": {"best": torch.arange(3.0)}}


def test_a_tasks_own_state_dict_entries_are_columns() -> None:
    task = TaskEnv(batched(Remembers, 3))
    task.reset(seed=0)
    columns = read_state_columns(task)
    assert columns["state/goals/best"].tolist() == [0, 1, 2] and "state/actors/cube" in columns
    task.close()


def test_tensors_of_a_device_keep_their_values_and_order() -> None:
    """Tensors are concatenated by type for the transfer; here only the device's name says GPU."""
    tensors = {
        "b": torch.arange(12.0).reshape(2, 3, 2),
        "truths": torch.tensor([True, False]),
        "a": torch.tensor([7.0, 8.0]),
        "known": np.array([1, 2]),
        "none": torch.zeros((2, 0)),
    }
    columns = StateReading(None, tensors, {}, 2, torch.device("cuda")).columns()
    assert list(columns) == list(tensors)
    for name, value in tensors.items():
        column = columns[name]
        assert column.shape == tuple(value.shape) and column.dtype == np.asarray(value).dtype
        np.testing.assert_array_equal(column, np.asarray(value))
