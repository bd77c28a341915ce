"""``workbench.make`` returns what ``gym.make`` returns, batched on the CPU."""

# pyright: reportAttributeAccessIssue=false, reportOptionalMemberAccess=false, reportArgumentType=false

from __future__ import annotations

import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import mani_skill.envs  # noqa: F401  registers the ids
import pytest
import torch
from gymnasium.envs.registration import registry as gymnasium_registry
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils.gym_utils import find_max_episode_steps_value
from mani_skill.utils.registration import REGISTERED_ENVS

import workbench
from tests.drive.envs import CPU
from workbench.envs.broken_rule import WrongReturn
from workbench.envs.cpu_scene import SIM_BACKEND
from workbench.task.problem import TaskError

pytestmark = pytest.mark.thorough

TASKS = Path(__file__).resolve().parents[2] / "tasks"


@pytest.fixture
def tables_as_before() -> Iterator[None]:
    """Restore the registries: task files register their ids in the process."""
    tables: list[dict[str, Any]] = [REGISTERED_ENVS, gymnasium_registry]
    kept = [dict(table) for table in tables]
    yield
    for table, before in zip(tables, kept, strict=True):
        table.clear()
        table.update(before)


def wrappers_of(env: gym.Env) -> list[str]:
    names = []
    while isinstance(env, gym.Wrapper):
        names.append(type(env).__name__)
        env = env.env
    return names


def plain(spec: Any) -> dict[str, Any]:
    made_by = {"entry_point", "vector_entry_point"}
    return {key: value for key, value in vars(spec).items() if key not in made_by}


def test_make_equals_gym_make() -> None:
    stock = gym.make("PickCube-v1", render_backend="none", obs_mode="state_dict")
    ours = workbench.make("PickCube-v1", **CPU, obs_mode="state_dict")
    assert wrappers_of(ours) == wrappers_of(stock)
    assert ours.metadata == stock.metadata
    kwargs = {**plain(stock.spec)["kwargs"], "num_envs": 1}
    assert plain(ours.spec) == {**plain(stock.spec), "kwargs": kwargs}
    assert find_max_episode_steps_value(ours) == find_max_episode_steps_value(stock) == 50
    for name in ("obs_mode", "reward_mode", "control_mode", "robot_uids", "reconfiguration_freq", "device"):
        assert getattr(ours.unwrapped, name) == getattr(stock.unwrapped, name), name
    assert ours.observation_space == stock.observation_space
    assert ours.action_space == stock.action_space
    assert type(ours.unwrapped).__name__ == type(stock.unwrapped).__name__ == "PickCubeEnv"
    assert isinstance(ours.unwrapped, REGISTERED_ENVS["PickCube-v1"].cls)
    ours.close()
    stock.close()


def test_a_batch_has_the_spaces_and_the_results_of_a_batch() -> None:
    env = workbench.make("PickCube-v1", 3, **CPU)
    assert env.unwrapped.num_envs == 3 and env.unwrapped.backend.sim_backend == SIM_BACKEND
    assert env.action_space.shape == (3, 8) and env.get_wrapper_attr("single_action_space").shape == (8,)
    obs, _ = env.reset(seed=0)
    assert env.observation_space.contains(obs.numpy())
    obs, reward, terminated, truncated, info = env.step(env.action_space.sample())
    assert obs.shape == env.observation_space.shape
    for value in (reward, terminated, truncated, info["success"]):
        assert value.shape == (3,)
    assert terminated.dtype == truncated.dtype == torch.bool
    env.close()


# --- the time limit --------------------------------------------------------------------------------


@pytest.mark.parametrize(("given", "steps"), [(None, 50), (3, 3), (-1, None)])
def test_the_time_limit_is_the_registered_or_the_given_one(given: int | None, steps: int | None) -> None:
    env = workbench.make("MS-CartpoleBalance-v1", 2, max_episode_steps=given, **CPU)
    steps = 1000 if given is None else steps
    assert find_max_episode_steps_value(env) == steps
    env.reset(seed=0)
    for step in range(1, 5):
        truncated = env.step(env.action_space.sample())[3]
        assert truncated.tolist() == [steps is not None and step >= steps] * 2
    env.reset(options={"env_idx": torch.tensor([1])})
    truncated = env.step(env.action_space.sample())[3]
    assert truncated.tolist() == [given == 3, False]
    env.close()


# --- what is made ----------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore:.*which exists already")
def test_a_file_and_a_class_of_it(tables_as_before: None) -> None:
    file = TASKS / "push_cube.py"
    for reference in (file, str(file), f"{file}:PushCubeEnv"):
        env = workbench.make(reference, 2, **CPU)
        assert type(env.unwrapped).__name__ == "PushCubeEnv"
        assert find_max_episode_steps_value(env) == REGISTERED_ENVS[env.spec.id].max_episode_steps
        env.reset(seed=0)
        env.close()


def test_a_class_with_and_without_a_registered_id() -> None:
    registered = REGISTERED_ENVS["PushCube-v1"].cls

    class Mine(registered):
        pass

    for cls, env_id, limit in ((registered, "PushCube-v1", 50), (Mine, "Mine", None)):
        env = workbench.make(cls, 2, **CPU)
        assert env.spec.id == env_id and isinstance(env.unwrapped, cls)
        assert find_max_episode_steps_value(env) == limit
        env.reset(seed=0)
        assert env.step(env.action_space.sample())[3].tolist() == [False, False]
        env.close()


def test_the_kwargs_of_a_registration_are_used_and_overridden(tmp_path: Path, tables_as_before: None) -> None:
    file = tmp_path / "registered.py"
    file.write_text(
        "from mani_skill.envs.tasks.tabletop.push_cube import PushCubeEnv\n"
        "from mani_skill.utils.registration import register_env\n"
        "@register_env('Registered-v3', max_episode_steps=7, control_mode='pd_joint_pos', reward_mode='sparse')\n"
        "class Registered(PushCubeEnv):\n    pass\n"
    )
    env = workbench.make(file, 2, **CPU)
    assert (env.unwrapped.control_mode, env.unwrapped.reward_mode) == ("pd_joint_pos", "sparse")
    assert find_max_episode_steps_value(env) == 7
    env.close()
    env = workbench.make(file, 2, control_mode="pd_joint_vel", **CPU)
    assert (env.unwrapped.control_mode, env.unwrapped.reward_mode) == ("pd_joint_vel", "sparse")
    assert env.unwrapped.spec.kwargs["control_mode"] == "pd_joint_vel"
    env.close()
    assert gym.spec("Registered-v3").max_episode_steps == 7  # gym.make knows the id of the file


def test_the_spec_makes_an_equal_env() -> None:
    env = workbench.make("PushCube-v1", 2, max_episode_steps=4, **CPU)
    again = gym.make(env.unwrapped.spec)
    assert again.unwrapped.num_envs == 2 and again.unwrapped.backend.sim_backend == SIM_BACKEND
    more = gym.make(env.unwrapped.spec, num_envs=3)
    assert more.unwrapped.num_envs == 3
    for each in (env, again, more):
        each.close()


def test_threads_and_strictness_reach_the_core() -> None:
    class Unbatched(REGISTERED_ENVS["PushCube-v1"].cls):
        def evaluate(self) -> dict[str, Any]:
            return {"success": torch.tensor([True])}

    workbench.make(Unbatched, 3, rules="off", **CPU).close()
    for rules in ({}, {"rules": "stop"}):
        with pytest.raises(WrongReturn, match="success"):
            workbench.make(Unbatched, 3, **rules, **CPU)
    env = workbench.make("PushCube-v1", 3, threads=1, rules="stop", **CPU)
    env.reset(seed=0)
    env.step(env.action_space.sample())
    env.reset(options={"env_idx": torch.tensor([1])})
    env.close()
    with pytest.raises(ValueError, match="threads"):
        workbench.make("PushCube-v1", 3, threads=0, **CPU)


# --- options ---------------------------------------------------------------------------------------


def test_every_option_of_an_env_reaches_it() -> None:
    env = workbench.make(
        "PushCube-v1",
        2,
        **CPU,
        obs_mode="state_dict",
        reward_mode="sparse",
        control_mode="pd_ee_delta_pose",
        robot_uids="panda_wristcam",
        reconfiguration_freq=3,
        sim_config={"control_freq": 10, "scene_config": {"gravity": [0.0, 0.0, -1.62]}},
        enhanced_determinism=True,
    ).unwrapped
    assert (env.obs_mode, env.reward_mode, env.control_mode) == ("state_dict", "sparse", "pd_ee_delta_pose")
    assert env.agent.uid == "panda_wristcam" and env.reconfiguration_freq == 3 and env.control_freq == 10
    assert env.scene.sub_scenes[1].physx_system.config.gravity[2] == pytest.approx(-1.62)
    assert env._enhanced_determinism
    env.close()


def test_the_default_reward_is_stocks_or_else_the_richest() -> None:
    class OnlySparse(REGISTERED_ENVS["PushCube-v1"].cls):
        compute_dense_reward = BaseEnv.compute_dense_reward
        compute_normalized_dense_reward = BaseEnv.compute_normalized_dense_reward

    env = workbench.make(OnlySparse, 2, **CPU)
    assert env.unwrapped.reward_mode == "sparse" == env.unwrapped.spec.kwargs["reward_mode"]
    env.reset(seed=0)
    env.step(env.action_space.sample())
    env.close()
    # The richest mode would be "sparse", but stock takes the first.
    env = workbench.make("PlugCharger-v1", 2, **CPU)
    assert (
        env.unwrapped.reward_mode == REGISTERED_ENVS["PlugCharger-v1"].cls.SUPPORTED_REWARD_MODES[0] == "none"
    )
    assert "reward_mode" not in env.unwrapped.spec.kwargs
    env.close()


@pytest.mark.parametrize(
    ("task", "num_envs", "kwargs", "error", "says"),
    [
        ("PickCube-v1", 2, {"sim_backend": "physx_cpu"}, ValueError, 'backend="cpu"'),
        ("PickCube-v1", 0, {}, ValueError, "num_envs"),
        ("PickCube-v1", 2.5, {}, ValueError, "num_envs"),
        ("PickCube-v1", True, {}, ValueError, "num_envs"),
        ("PickCube-v1", 2, {"render_backend": "none", "obs_mode": "rgb"}, ValueError, "obs_mode='rgb'"),
        ("PickCube-v1", 2, {"render_backend": None, "render_mode": "all"}, ValueError, "render_mode='all'"),
        ("PickCube-v1", 2, {"backend": "cppu"}, ValueError, "auto, cpu, gpu"),
        ("PickCube-v1", 2, {**CPU, "rules": "yes"}, ValueError, "'stop', 'warn' or 'off'"),
        pytest.param(
            *("PickCube-v1", 2, {"backend": "cpu", "render_mode": "human"}, ValueError, "workbench open"),
            marks=pytest.mark.render,
        ),
        ("PickCube-v1", 2, {**CPU, "parallel_in_single_scene": True}, ValueError, "parallel_in_single_scene"),
        ("PickCub-v1", 2, CPU, TaskError, "PickCube-v1"),
        ("CartPole-v1", 2, CPU, TaskError, "BaseEnv"),
        ("no_such_file.py", 2, CPU, TaskError, "does not exist"),
        (BaseEnv, 2, CPU, TypeError, "BaseEnv"),
        (dict, 2, CPU, TypeError, "dict"),
        (7, 2, CPU, TypeError, "int"),
    ],
)
def test_invalid_options_are_refused_with_advice(
    task: Any, num_envs: Any, kwargs: dict[str, Any], error: type[Exception], says: str
) -> None:
    with pytest.raises(error, match=says):
        workbench.make(task, num_envs, **kwargs)


IN_THE_CONSTRUCTOR = """
import torch
from mani_skill.envs.tasks.tabletop.push_cube import PushCubeEnv

class Mine(PushCubeEnv):
    def __init__(self, *args, size=1, **kwargs):
        super().__init__(*args, **kwargs)

    def _load_scene(self, options):
        self.size = torch.zeros(1, 2) + "3"
"""


def test_a_type_error_in_a_constructor_has_its_authors_frame_and_line(
    tmp_path: Path, tables_as_before: None
) -> None:
    """gymnasium raises another exception in its place, whose traceback starts in gymnasium."""
    file = tmp_path / "mine.py"
    file.write_text(IN_THE_CONSTRUCTOR)
    with pytest.raises(TypeError) as caught:
        workbench.make(f"{file}:Mine", 2, **CPU)
    line = 'self.size = torch.zeros(1, 2) + "3"'
    number = IN_THE_CONSTRUCTOR[: IN_THE_CONSTRUCTOR.index(line)].count("\n") + 1
    assert f"{file}:{number}: {line}" in caught.value.__notes__
    frames = [(frame.filename, frame.lineno) for frame in traceback.extract_tb(caught.value.__traceback__)]
    assert (str(file), number) in frames
