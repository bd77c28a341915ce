"""The example tasks, imported as a user would, and made with stock ManiSkill."""

from __future__ import annotations

import importlib.util
import logging
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
from mani_skill.agents.registration import REGISTERED_AGENTS
from mani_skill.utils.registration import REGISTERED_ENVS

FOLDER = Path(__file__).parents[2] / "tasks"
IDS = {
    "push_cube": "WorkbenchPushCube-v1",
    "minimal": "WorkbenchMinimal-v1",
    "articulated": "WorkbenchArticulated-v1",
    "cameras": "WorkbenchCameras-v1",
    "custom_scene": "WorkbenchCustomScene-v1",
    "different_objects": "WorkbenchDifferentObjects-v1",
    "fail_conditions": "WorkbenchFailConditions-v1",
    "locomotion": "WorkbenchLocomotion-v1",
    "obs_history": "WorkbenchObsHistory-v1",
    "own_robot": "WorkbenchOwnRobot-v1",
    "reward_terms": "WorkbenchRewardTerms-v1",
    "swing_up": "WorkbenchSwingUp-v1",
    "task_state": "WorkbenchTaskState-v1",
    "two_robots": "WorkbenchTwoRobots-v1",
}
ROBOTS = ("workbench_pen_arm", "workbench_pendulum")
"""Robots that the examples register."""
LOGGED = {"locomotion": {"Currently ManiSkill does not support loading plane geometries from MJCFs"}}
"""Unavoidable log lines by example: the robot's file contains a floor."""


def import_file(name: str) -> None:
    spec = importlib.util.spec_from_file_location(f"example_{name}", FOLDER / f"{name}.py")
    assert spec is not None and spec.loader is not None
    spec.loader.exec_module(importlib.util.module_from_spec(spec))


def forget_examples() -> None:
    for env_id in IDS.values():
        gym.registry.pop(env_id, None)
        REGISTERED_ENVS.pop(env_id, None)
    for uid in ROBOTS:
        REGISTERED_AGENTS.pop(uid, None)


@pytest.fixture(scope="module", autouse=True)
def example_tasks() -> Iterator[None]:
    # ManiSkill would not replace an edited version that another test left registered.
    forget_examples()
    for name in IDS:
        import_file(name)
    yield
    forget_examples()


@pytest.fixture
def make(example_tasks: None) -> Iterator[Callable[..., gym.Env]]:
    """Plain ``gym.make`` on ManiSkill's own single CPU env."""
    envs: list[gym.Env] = []

    def make_env(name: str, render_backend: str = "none", **kwargs: Any) -> gym.Env:
        env = gym.make(IDS[name], num_envs=1, sim_backend="cpu", render_backend=render_backend, **kwargs)
        envs.append(env)
        return env

    yield make_env
    for env in envs:
        env.close()


@pytest.fixture
def mani_skill_log() -> Iterator[list[str]]:
    """Yield the lines that ManiSkill logs; its logger, whose name ends in a space, does not propagate."""
    lines: list[str] = []
    handler = logging.Handler()
    handler.emit = lambda record: lines.append(record.getMessage())  # type: ignore[method-assign]
    logger = logging.getLogger("mani_skill ")
    logger.addHandler(handler)
    yield lines
    logger.removeHandler(handler)
