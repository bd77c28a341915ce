"""Ray traced cameras equal stock's where the driver can trace rays, and fall back to another shader with a warning elsewhere."""

# ManiSkill annotates poses as what they become.
# pyright: reportArgumentType=false

from __future__ import annotations

import inspect
import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from mani_skill.envs.tasks.tabletop.push_cube import PushCubeEnv
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils
from mani_skill.utils.registration import REGISTERED_ENVS, register_env

import workbench
from workbench.envs.backends import why_no_ray_tracing
from workbench.envs.rendering import camera_shader
from workbench.pictures.render import list_cameras, take_pictures

pytestmark = pytest.mark.usefixtures("renderer")

ID = "RayTracedPushCube-v1"


class RayTraced(PushCubeEnv):
    @property
    def _default_human_render_camera_configs(self) -> CameraConfig:
        pose = sapien_utils.look_at([0.4, 0, 0.5], [0, 0, 0])
        return CameraConfig("render_camera", pose, 64, 64, 1, 0.01, 10, shader_pack="rt-fast")


@pytest.fixture(autouse=True)
def registered() -> Any:
    register_env(ID, max_episode_steps=50, override=True)(RayTraced)
    yield
    del REGISTERED_ENVS[ID], gym.registry[ID]


def test_without_ray_tracing_the_default_shader_is_used_with_a_warning() -> None:
    if why_no_ray_tracing() is None:
        pytest.skip("this machine traces rays")
    with pytest.warns(Warning, match="render_camera") as warned:
        traced = workbench.make(ID, num_envs=2, render_mode="rgb_array")
    lines, first = inspect.getsourcelines(RayTraced)
    line = first + next(n for n, text in enumerate(lines) if "rt-fast" in text)
    assert (__file__, line) in [(each.filename, each.lineno) for each in warned]
    human = {"human_render_camera_configs": {"shader_pack": "default"}}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        default = workbench.make(ID, num_envs=2, render_mode="rgb_array", **human)
    for env in (traced, default):
        env.reset(seed=[0, 1])
    assert torch.equal(torch.as_tensor(traced.render()), torch.as_tensor(default.render()))
    cameras = {camera.name: camera.replaced_shader for camera in list_cameras(traced.unwrapped)}
    assert cameras == {"base_camera": "", "render_camera": "rt-fast"}
    for env in (traced, default):
        env.close()


@pytest.mark.slow  # a software driver compiles shaders for about 20 s
def test_with_ray_tracing_pictures_equal_stocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(camera_shader, "why_no_ray_tracing", lambda: None)
    ours = workbench.make(ID, num_envs=2, render_mode="rgb_array")
    stock = gym.make(ID, render_mode="rgb_array")
    ours.reset(seed=[3, 4])
    stock.reset(seed=3)
    pictures, theirs = np.asarray(ours.render()), np.asarray(stock.render())[0]
    assert np.array_equal(pictures[0], theirs)
    for number in range(2):
        (page,) = take_pictures(ours.unwrapped, number, [("render_camera", "human", ("rgb",))])
        assert np.array_equal(page.rgb, pictures[number])
    stock.close()
    ours.close()
