"""ManiSkill's ``look_at`` straight down returns a quaternion of length 0.707; our pictures equal stock's with it, too."""

# ManiSkill annotates poses as what they become.
# pyright: reportArgumentType=false

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
import torch
from mani_skill.envs.tasks.tabletop.push_cube import PushCubeEnv
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils
from mani_skill.utils.registration import REGISTERED_ENVS, register_env

import workbench
from workbench.envs.scene.scene_index import read_poses
from workbench.pictures.render import take_pictures
from workbench.pictures.visibility import picture_of, placement_of

ID = "SeenFromAbove-v1"


class SeenFromAbove(PushCubeEnv):
    @property
    def _default_sensor_configs(self) -> CameraConfig:
        return CameraConfig("above", sapien_utils.look_at([0, 0, 0.6], [0, 0, 0]), 64, 64, 1.0, 0.01, 10)


@pytest.mark.slow
def test_pictures_and_parameters_equal_stocks(renderer: None) -> None:
    register_env(ID, max_episode_steps=50, override=True)(SeenFromAbove)
    try:
        ours = workbench.make(ID, obs_mode="rgb+depth+segmentation")
        stock = gym.make(ID, obs_mode="rgb+depth+segmentation")
    finally:
        del REGISTERED_ENVS[ID], gym.registry[ID]
    seen, theirs = ours.reset(seed=3)[0], stock.reset(seed=3)[0]
    for name, picture in theirs["sensor_data"]["above"].items():
        assert torch.equal(seen["sensor_data"]["above"][name], picture), name
    for name, matrix in theirs["sensor_param"]["above"].items():
        torch.testing.assert_close(seen["sensor_param"]["above"][name], matrix, atol=1e-6, rtol=0)
    env, rgb = ours.unwrapped, theirs["sensor_data"]["above"]["rgb"][0].numpy()
    request, poses = ("above", "sensor", ("rgb",)), read_poses(env)[0]
    shown = {
        "exact": take_pictures(env, 0, [request]),
        "fast": take_pictures(env, 0, [request], degree="fast"),
        "past": take_pictures(env, 0, [request], poses),
        "studio": [picture_of(env, 0, placement_of(env, ("sensor", "above"), 0))],
    }
    for how, (picture,) in shown.items():
        assert picture.degree == "exact" and np.array_equal(picture.rgb, rgb), how
    ours.close()
    stock.close()
