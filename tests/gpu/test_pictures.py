"""Pictures drawn by the GPU agree with those drawn by the batched CPU in the same state, even before a pose is applied."""

# ManiSkill annotates an env's members as the widest thing they may be in any task.
# pyright: reportAttributeAccessIssue=false, reportArgumentType=false, reportOptionalSubscript=false
# pyright: reportCallIssue=false

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch
from mani_skill.envs.tasks.tabletop.push_cube import PushCubeEnv
from mani_skill.utils.structs.pose import Pose

from tests.gpu.conftest import Simulation
from workbench.envs.backends import BackendUnavailable
from workbench.envs.task_env import EnvOptions, make_env
from workbench.pictures.render import take_pictures

N = 2
MODE = "rgb+depth+segmentation"
SENSOR = ("base_camera", "sensor", ("rgb", "depth", "segmentation"))

pytestmark = pytest.mark.filterwarnings("ignore::workbench.envs.broken_rule.RuleWarning")


@pytest.fixture(scope="module")
def pushes(simulation: Simulation, renderer: str) -> Iterator[tuple[Any, Any]]:
    """Yield PushCube on the backend under test and on the batched CPU."""

    def opened(backend: Simulation) -> Any:
        kwargs = {"obs_mode": MODE, "render_backend": renderer}
        return make_env(PushCubeEnv, EnvOptions(N, backend, kwargs=kwargs))

    under_test, reference = opened(simulation), opened("cpu")
    yield under_test, reference
    under_test.close()
    reference.close()


@pytest.fixture
def in_one_state(pushes: tuple[Any, Any]) -> tuple[Any, Any]:
    under_test, reference = pushes
    reference.reset(seed=[3, 4])
    under_test.reset(seed=[3, 4])
    state = reference.get_state_dict()
    under_test.set_state_dict(
        {
            kind: {name: row.to(under_test.device) for name, row in rows.items()}
            for kind, rows in state.items()
        }
    )
    for env in pushes:
        env.scene._gpu_apply_all()
        env.scene.px.gpu_update_articulation_kinematics()
        env.scene._gpu_fetch_all()
    return under_test, reference


def seen(env: Any) -> dict[str, np.ndarray]:
    data = env.get_obs(env.evaluate())["sensor_data"]["base_camera"]
    return {name: picture.cpu().numpy() for name, picture in data.items()}


def cube_pixels(env: Any, segmentation: np.ndarray) -> list[int]:
    return [int((row == int(env.obj.per_scene_id[i])).sum()) for i, row in enumerate(segmentation)]


def test_the_same_state_gives_the_same_picture(in_one_state: tuple[Any, Any]) -> None:
    (env, reference), (here, there) = in_one_state, map(seen, in_one_state)
    names = {
        backend: {int(k): v.name for k, v in backend.segmentation_id_map.items()} for backend in in_one_state
    }
    assert set(names[env].values()) == set(names[reference].values())
    for picture in ("rgb", "depth", "segmentation"):
        assert here[picture].shape == there[picture].shape and here[picture].dtype == there[picture].dtype
    name_of = np.vectorize(lambda number, table: table.get(number, "-"), otypes=[object])
    same = name_of(here["segmentation"], names[env]) == name_of(there["segmentation"], names[reference])
    assert same.mean() > 0.99, "only edge pixels may differ"
    inside = same[..., 0]
    np.testing.assert_allclose(
        np.median(np.abs(here["depth"][inside].astype(int) - there["depth"][inside].astype(int))), 0, atol=2
    )
    assert np.abs(here["rgb"].astype(int) - there["rgb"].astype(int)).mean() < 8


def test_the_pages_picture_equals_the_envs_observation(in_one_state: tuple[Any, Any]) -> None:
    env, _ = in_one_state
    observed = seen(env)
    for number in range(N):
        (picture,) = take_pictures(env, number, [SENSOR])
        np.testing.assert_array_equal(picture.segmentation, observed["segmentation"][number, ..., 0])
        np.testing.assert_array_equal(picture.rgb, observed["rgb"][number])


def test_an_unapplied_pose_is_in_the_picture(in_one_state: tuple[Any, Any]) -> None:
    counted = []
    for env in in_one_state:
        before = cube_pixels(env, seen(env)["segmentation"])
        away = env.obj.pose.raw_pose.clone()
        away[1:, 2] += 50
        env.obj.set_pose(Pose.create(away))
        after = cube_pixels(env, seen(env)["segmentation"])
        env.step(torch.zeros(env.action_space.shape, device=env.device))
        again = cube_pixels(env, seen(env)["segmentation"])
        assert all(before) and after[0] and not after[1]
        assert bool(again[1]) == (env.device.type == "cuda"), "on a GPU physics never sees the write"
        counted.append(after)
    assert counted[0][0] == pytest.approx(counted[1][0], rel=0.1)


@pytest.mark.gpu
def test_cpu_simulation_is_rendered_on_the_gpu(renderer: str) -> None:
    env = make_env(PushCubeEnv, EnvOptions(N, "cpu", kwargs={"obs_mode": "rgb"}))
    assert renderer == "gpu" and env.backend.render_backend == "sapien_cuda"
    obs, _ = env.reset(seed=0)
    rgb = obs["sensor_data"]["base_camera"]["rgb"]
    assert rgb.shape == (N, 128, 128, 3) and rgb.float().std() > 1
    env.close()


@pytest.mark.gpu
def test_fast_pictures_are_refused_where_a_gpu_draws(renderer: str) -> None:
    with pytest.raises(BackendUnavailable):
        make_env(PushCubeEnv, EnvOptions(N, "cpu", pictures="fast", kwargs={"render_backend": renderer}))
