"""Cameras mounted on links and actors."""

# ManiSkill annotates an env's members as the widest thing they may be, and vectors as tuples.
# pyright: reportAttributeAccessIssue=false, reportOptionalMemberAccess=false, reportArgumentType=false
# pyright: reportOptionalIterable=false

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import sapien
import torch
from mani_skill.utils.structs.pose import Pose

from tests.envs.stock_env import batch_of, put_in_same_state, single
from tests.envs.watched import RENDERED, Watched, pictures

N = 3


@pytest.fixture(scope="module")
def env(renderer: None) -> Iterator[Any]:
    env = batch_of(Watched, N, **RENDERED)
    yield env
    env.close()


@pytest.mark.slow
def test_pictures_equal_a_stock_envs_before_and_after_the_mounts_moved(env: Any) -> None:
    obs, _ = env.reset(seed=[0, 1, 2])
    still = pictures(obs)
    for number in range(N):
        stock = single(Watched, first_env=number, **RENDERED)
        stock.reset(seed=number)
        env.reset(seed=[0, 1, 2])
        put_in_same_state(stock, env, number)
        for _ in range(4):
            ours = pictures(env.step(None)[0])
            theirs = pictures(stock.step(None)[0])
        assert ours.keys() == theirs.keys()
        for name in theirs:
            assert np.array_equal(ours[name][number], theirs[name][0]), f"{name} of env {number}"
        assert np.array_equal(env.render_rgb_array()[number], stock.render_rgb_array()[0])
        stock.close()
    for name in ("on_link/rgb", "on_link/depth", "on_link/segmentation"):
        for number in range(N):
            assert not np.array_equal(ours[name][number], still[name][number]), (
                "the link's camera did not move"
            )
    assert np.array_equal(ours["beside/depth"], still["beside/depth"])


def test_a_camera_that_the_task_moves_reports_its_new_pose(env: Any) -> None:
    env.reset(seed=[0, 1, 2])
    camera = env._sensors["beside"].camera
    (p, q), before = (
        np.split(camera.get_local_pose()[0].raw_pose[0].numpy(), [3]),
        camera.get_extrinsic_matrix(),
    )
    camera.set_local_pose(sapien.Pose(p + [0.25, 0, 0], q))
    try:
        np.testing.assert_allclose(camera.get_local_pose().p, np.tile(p + [0.25, 0, 0], (N, 1)), atol=1e-6)
        assert not torch.equal(camera.get_extrinsic_matrix(), before)
    finally:
        camera.set_local_pose(sapien.Pose(p, q))


def test_a_camera_on_an_actor_follows_the_actor_of_its_own_env(env: Any) -> None:
    obs, _ = env.reset(seed=[0, 1, 2])
    before = pictures(obs)["on_actor/rgb"]
    # Each env's rider stands in front of a different wall and sees mostly its colour.
    middle = before[:, 12, 16].astype(int)
    pose = env.rider.pose.raw_pose.clone()
    pose[1, 1] = 1.2
    env.rider.set_pose(Pose.create(pose))
    env.apply()
    after = np.asarray(env.get_obs(env.get_info())["sensor_data"]["on_actor"]["rgb"])
    assert np.array_equal(after[[0, 2]], before[[0, 2]])
    assert middle[1].argmax() == 1
    assert after[1, 12, 16].argmax() == 2
    model = env.scene.sensors["on_actor"].camera.get_model_matrix()
    assert model.shape == (N, 4, 4)
    torch.testing.assert_close(model[:, :3, 3], env.rider.pose.p, atol=1e-5, rtol=0)
