"""What the same API gives on a GPU: simulation there, or only pictures. Skipped where there is none."""

# pyright: reportArgumentType=false, reportCallIssue=false, reportAttributeAccessIssue=false, reportOptionalSubscript=false

from __future__ import annotations

from collections.abc import Iterator

import mani_skill.envs  # noqa: F401  registers the ids
import numpy as np
import pytest
from mani_skill.utils.registration import REGISTERED_ENVS

from workbench.core import actions
from workbench.core.task_env import EnvOptions, TaskEnv, make_env

pytestmark = pytest.mark.gpu

N = 4
SPEC = REGISTERED_ENVS["PickCube-v1"]


@pytest.fixture
def simulated_there() -> Iterator[TaskEnv]:
    env = TaskEnv(make_env(SPEC.cls, EnvOptions(N, "gpu")), SPEC.max_episode_steps)
    yield env
    env.close()


def test_gpu_simulation_gives_the_same_interface(simulated_there: TaskEnv) -> None:
    env = simulated_there
    env.reset(seed=0)
    step = env.step(actions.hold_action(env.parts, N))
    assert step.poses.shape == (N, len(env.table.names), 7) and np.isfinite(step.poses).all()


def test_a_partial_reset_leaves_the_other_envs(simulated_there: TaskEnv) -> None:
    env = simulated_there
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(5):
        before = env.step(actions.random_action(env.parts, N, rng))
    after = env.reset(seed=7, env_idx=[1])
    assert after.elapsed_steps.tolist() == [5, 0, 5, 5]
    others = [0, 2, 3]
    np.testing.assert_allclose(after.poses[others], before.poses[others], atol=1e-5)


def test_cpu_simulation_is_drawn_by_the_gpu() -> None:
    env = make_env(SPEC.cls, EnvOptions(N, "cpu", kwargs={"obs_mode": "rgb"}))
    assert env.backend.render_backend == "sapien_cuda"
    obs, _ = env.reset(seed=0)
    rgb = obs["sensor_data"]["base_camera"]["rgb"]
    assert rgb.shape == (N, 128, 128, 3) and rgb.float().std() > 1
    env.close()
