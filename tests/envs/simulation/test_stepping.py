"""Threads and merged substeps give the same bits as stepping envs one by one, and hooks see no difference."""

# pyright: reportAttributeAccessIssue=false, reportArgumentType=false, reportCallIssue=false
# pyright: reportOptionalIterable=false

from __future__ import annotations

from typing import Any

import mani_skill.envs  # noqa: F401  registers the ids
import numpy as np
import pytest
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils.registration import REGISTERED_ENVS

from workbench.envs.cpu_scene import batched_class

pytestmark = pytest.mark.thorough

STATE_ONLY: dict[str, Any] = {"obs_mode": "state", "render_backend": "none"}
PICK_CUBE = REGISTERED_ENVS["PickCube-v1"].cls


def trajectory(task: type[BaseEnv], threads: int, steps: int = 30, num_envs: int = 5) -> list[bytes]:
    env = batched_class(task)(num_envs=num_envs, **STATE_ONLY)
    env.scene.px.stepper.threads = threads
    env.reset(seed=list(range(num_envs)))
    rng = np.random.default_rng(0)
    packs = []
    for _ in range(steps):
        # Downwards, so that fingers, cube and table touch.
        action = rng.uniform(-1, 0.2, (num_envs, *env.single_action_space.shape)).astype(np.float32)
        env.step(action)
        packs.append(b"".join(system.pack() for system in env.scene.px.systems))
    env.close()
    return packs


def watching(task: type[BaseEnv]) -> type[BaseEnv]:
    """Return the task with a hook between substeps, which prevents merging."""

    class Watches(task):
        seen = 0

        def _after_simulation_step(self) -> None:
            type(self).seen += 1

    return Watches


@pytest.mark.parametrize(
    "env_id", [pytest.param("PickCube-v1", marks=pytest.mark.slow), "StackCube-v1", "MS-CartpoleBalance-v1"]
)
def test_threads_and_merged_substeps_give_the_same_bits(env_id: str) -> None:
    task = REGISTERED_ENVS[env_id].cls
    expected = trajectory(watching(task), threads=1)
    assert trajectory(task, threads=1) == expected, "merged substeps, one thread"
    assert trajectory(task, threads=2) == expected, "merged substeps, two threads"
    assert trajectory(task, threads=5) == expected, "merged substeps, five threads"
    assert trajectory(watching(task), threads=3) == expected, "single substeps, three threads"


def test_a_hook_between_substeps_sees_every_substep() -> None:
    heights: list[float] = []

    class ReadsHeight(PICK_CUBE):
        def _after_simulation_step(self) -> None:
            heights.append(float(self.cube._objs[0].pose.p[2]))

    env = batched_class(ReadsHeight)(num_envs=2, **STATE_ONLY)
    env.reset(seed=[0, 1])
    pose = env.cube.pose.raw_pose.clone()
    pose[:, 2] = 1.5  # clear of the gripper
    env.cube.set_pose(pose)
    env.scene._gpu_apply_all()
    heights.clear()
    env.step(np.zeros((2, 8), np.float32))
    env.close()
    assert len(heights) == 5
    assert all(later < earlier for earlier, later in zip(heights, heights[1:], strict=False)), heights


def test_state_fetched_between_merged_substeps_is_current() -> None:
    env = batched_class(PICK_CUBE)(num_envs=2, **STATE_ONLY)
    env.reset(seed=[0, 1])
    px = env.scene.px
    with px.merging(5):
        px.step()
        px.step()
        env.scene._gpu_fetch_all()
        after_two = px.systems[0].pack()
        px.step()
    after_three = px.systems[0].pack()
    assert after_three != after_two
    env.close()


def test_an_error_in_a_control_step_leaves_no_pending_substep() -> None:
    class Fails(PICK_CUBE):
        def _after_control_step(self) -> None:
            raise KeyError("the author's")

    env = batched_class(Fails)(num_envs=2, **STATE_ONLY)
    env.reset(seed=[0, 1])
    with pytest.raises(KeyError):
        env.step(np.zeros((2, 8), np.float32))
    assert not env.scene.px.stepper.owes
    env.close()
