"""A reset of some envs leaves the controllers of the others alone, and says whose fault it is when it fails."""

# pyright: reportAttributeAccessIssue=false, reportArgumentType=false, reportOptionalMemberAccess=false

from __future__ import annotations

from typing import Any

import mani_skill.envs  # noqa: F401  registers the ids
import numpy as np
import pytest
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils.registration import REGISTERED_ENVS
from mani_skill.utils.structs import Pose

from tests.core.single_env_judge import Bare, batch_of
from workbench.core.partial_reset import active_controllers
from workbench.core.task_env import EnvOptions, make_env

PICK_CUBE: Any = REGISTERED_ENVS["PickCube-v1"].cls


def made(task: type[BaseEnv] = PICK_CUBE, num_envs: int = 4, **kwargs: Any) -> Any:
    return make_env(task, EnvOptions(num_envs, "cpu", render=False, rules="off", kwargs=kwargs))


@pytest.mark.parametrize(
    "control_mode", ["pd_joint_target_delta_pos", "pd_ee_target_delta_pose", "pd_ee_target_delta_pos"]
)
def test_an_env_that_is_not_reset_goes_on_to_the_target_that_it_had(control_mode: str) -> None:
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


def test_the_first_observation_after_it_shows_that_target_too() -> None:
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


def test_a_reset_of_all_resets_all_controllers() -> None:
    env = made(control_mode="pd_joint_target_delta_pos")
    env.reset(seed=[1, 2, 3, 4])
    env.step(np.full(env.action_space.shape, 0.7, np.float32))
    env.reset(seed=[1, 2, 3, 4])
    assert torch.equal(env.agent.get_controller_state()["arm"]["target_qpos"], env.agent.robot.qpos[:, :7])
    env.close()


def test_several_robots_and_none_have_their_controllers_found() -> None:
    two = made(REGISTERED_ENVS["TwoRobotPickCube-v1"].cls, 2)
    assert len(active_controllers(two)) == 4, "an arm and a gripper each"
    two.close()

    bare = batch_of(Bare, 2)
    assert active_controllers(bare) == []
    bare.reset(options={"env_idx": torch.tensor([1])})
    bare.close()


class WrongBatch(PICK_CUBE):
    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        super()._initialize_episode(env_idx, options)
        self.cube.set_pose(Pose.create(torch.zeros(self.num_envs, 7)))


class ForgetsRows(PICK_CUBE):
    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        super()._initialize_episode(env_idx, options)
        self.start = torch.zeros(len(env_idx), 3)

    def evaluate(self) -> dict:
        return super().evaluate() | {"moved": self.cube.pose.p - self.start}


@pytest.mark.parametrize(
    ("task", "words"),
    [
        (
            WrongBatch,
            ["test_partial_reset.py:", "in _initialize_episode", "Envs [1, 2] of 4", "len(env_idx)"],
        ),
        (
            ForgetsRows,
            ["in evaluate", "It replaced self.start: 4 rows before, 2 now (test_partial_reset.py:"],
        ),
    ],
)
def test_an_error_of_the_task_is_called_its_own(task: type[BaseEnv], words: list[str]) -> None:
    env = made(task)
    with pytest.raises(Exception) as caught:
        env.reset(options={"env_idx": torch.tensor([1, 2])})
    (note,) = caught.value.__notes__
    for word in [f"{task.__name__}'s own", *words]:
        assert word in note
    assert caught.traceback[-1].path != __file__, "the traceback stays whole"
    env.close()


def test_an_error_from_within_the_core_is_not_called_the_tasks() -> None:
    class FindsAMistake(PICK_CUBE):
        def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
            # A KeyError out of a file of the core: what a mistake there would look like.
            self.scene.px.row_of(None)

    with pytest.raises(KeyError) as caught:
        made(FindsAMistake)
    assert not getattr(caught.value, "__notes__", [])
