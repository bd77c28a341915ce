"""Pictures of chosen cameras equal ManiSkill's own for the same state."""

from __future__ import annotations

from typing import Any

import mani_skill.envs  # noqa: F401 (registers the tasks)
import numpy as np
import pytest
import sapien
import torch
from mani_skill.envs.tasks.tabletop.pick_cube import PickCubeEnv
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils.structs import Pose

from tests.drive.render_device import RENDER_BACKEND
from tests.envs.drawn_envs import batched, stock
from workbench.envs.camera_data import Picture
from workbench.envs.scene.scene_index import scene_index
from workbench.pictures.render import list_cameras, segmentation_names, take_pictures

pytestmark = pytest.mark.usefixtures("renderer")

OBS_MODE = "rgb+depth+segmentation"
ALL = ("rgb", "depth", "segmentation")


def act(env: Any) -> None:
    env.step(torch.from_numpy(np.atleast_2d(env.action_space.sample())))


def assert_same(picture: Picture, obs: dict[str, torch.Tensor], float_shader: bool = False) -> None:
    """Assert that the picture equals ManiSkill's observation, with depth in whole millimetres."""
    assert picture.rgb is not None and picture.depth is not None and picture.segmentation is not None
    e = picture.env
    np.testing.assert_array_equal(picture.rgb, obs["rgb"][e].cpu().numpy())
    np.testing.assert_array_equal(picture.segmentation, obs["segmentation"][e, ..., 0].cpu().numpy())
    millimetres = obs["depth"][e, ..., 0].cpu().numpy()
    assert picture.depth.dtype == np.float32 and picture.depth.min() >= 0
    beyond = millimetres == -32768  # ManiSkill's value for everything beyond 32.767 m
    assert (picture.depth[beyond] > 32.7).all()
    # The minimal shader rounds to millimetres; ManiSkill truncates float positions.
    whole = np.trunc if float_shader else np.rint
    np.testing.assert_array_equal(whole(picture.depth * np.float32(1000))[~beyond], millimetres[~beyond])


@pytest.mark.parametrize(("task", "make"), [("PickCube-v1", stock), ("PegInsertionSide-v1", batched)])
def test_sensor_pictures_equal_maniskills_observation(task: str, make: Any) -> None:
    env = make(task, obs_mode=OBS_MODE)
    act(env)
    obs = env.get_obs(env.get_info())["sensor_data"]
    assert {c.name for c in list_cameras(env) if c.kind == "sensor"} == set(obs)
    for e in range(env.num_envs):
        for picture in take_pictures(env, e, [(name, "sensor", ALL) for name in obs]):
            assert_same(picture, obs[picture.camera])
    env.close()


def test_pictures_of_float_shaders_equal_maniskills() -> None:
    more = ("position", "normal", "albedo")
    mode = "+".join((OBS_MODE, *more))
    env = batched("PickCube-v1", obs_mode=mode, sensor_configs={"shader_pack": "default"})
    act(env)
    obs = env.get_obs(env.get_info())["sensor_data"]["base_camera"]
    (picture,) = take_pictures(env, 0, [("base_camera", "sensor", (*ALL, *more))])
    assert_same(picture, obs, float_shader=True)
    assert picture.position is not None and picture.normal is not None and picture.depth is not None
    np.testing.assert_array_equal(
        picture.position, obs["position"][0].cpu().numpy().astype(np.float32) / 1000
    )
    np.testing.assert_array_equal(picture.normal, obs["normal"][0].cpu().numpy())
    np.testing.assert_array_equal(picture.albedo, obs["albedo"][0].cpu().numpy())
    np.testing.assert_allclose(-picture.position[..., 2], picture.depth, atol=1e-3)
    lengths = np.linalg.norm(picture.normal, axis=-1)
    np.testing.assert_allclose(lengths[picture.depth > 0], 1, atol=1e-2)
    env.close()


def test_human_pictures_of_a_stock_env_equal_maniskills_rendering() -> None:
    env = stock("PickCube-v1", obs_mode="rgb", render_mode="rgb_array")
    act(env)
    env.get_obs(env.get_info())  # leaves the goal hidden
    (picture,) = take_pictures(env, 0, [("render_camera", "human", ["rgb"])])
    np.testing.assert_array_equal(picture.rgb, env.render_rgb_array().cpu().numpy()[0])
    assert (picture.kind, picture.env) == ("human", 0)
    env.close()


def test_a_picture_leaves_no_trace() -> None:
    env = batched("PickCube-v1", obs_mode="rgb")
    env.get_obs(env.get_info())
    goal = env.goal_site

    def state() -> list[Any]:
        bodies = [o.find_component_by_type(sapien.render.RenderBodyComponent).visibility for o in goal._objs]
        packed = [(s.physx_system.pack(), s.pack_poses()) for s in env.scene.sub_scenes]
        return [bodies, packed, goal.hidden, goal.pose.raw_pose.tolist()]

    for hide in (goal.hide_visual, goal.show_visual):
        hide()
        before = state()
        take_pictures(env, 0, [("base_camera", "sensor", ["rgb"]), ("render_camera", "human", ["rgb"])])
        assert state() == before
    env.close()


def test_cameras_are_described_with_maniskills_poses() -> None:
    env = batched("PegInsertionSide-v1")
    act(env)
    info = {c.name: c for c in list_cameras(env)}
    assert set(info) == {"base_camera", "hand_camera", "render_camera"}
    assert info["hand_camera"].mount == "panda_wristcam/camera_link" and info["base_camera"].mount is None
    assert not any(camera.varies for camera in info.values())
    assert info["render_camera"].kind == "human" and set(ALL) <= set(info["base_camera"].modalities)
    cameras = {**env._sensors, **env._human_render_cameras}
    for name, camera in cameras.items():
        assert (info[name].width, info[name].height) == (camera.config.width, camera.config.height)
        np.testing.assert_allclose(
            info[name].intrinsic, camera.camera.get_intrinsic_matrix()[0].cpu().numpy()
        )
        wanted = camera.camera.get_global_pose().raw_pose.expand(2, 7).cpu().numpy()
        for e in range(2):
            (picture,) = take_pictures(env, e, [(name, info[name].kind, ["rgb"])])
            np.testing.assert_allclose(picture.pose[:3], wanted[e, :3], atol=1e-5)
            # q and -q are the same rotation, and both occur here.
            assert abs(picture.pose[3:] @ wanted[e, 3:]) == pytest.approx(1.0, abs=1e-5)
    env.close()


class FarWallEnv(PickCubeEnv):
    """Walls at distances that overflow and that wrap around an int16 of millimetres."""

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        return [CameraConfig("far", Pose.create(sapien.Pose([0, 50, 0])), 64, 64, 0.5, 0.01, 200)]

    def _load_scene(self, options: dict) -> None:
        super()._load_scene(options)
        for i, distance in enumerate([10.0, 32.7, 40.0, 70.0]):
            builder: Any = self.scene.create_actor_builder()
            half = 0.05 * distance
            builder.add_box_visual(half_size=[0.001, half, half])
            builder.initial_pose = Pose.create(sapien.Pose([distance, 50 + (i - 1.5) * 2 * half, 0]))
            builder.build_kinematic(f"wall_{i}")


@pytest.mark.parametrize("shader", ["minimal", "default"])
def test_depth_is_correct_beyond_maniskills_int16_range(shader: str) -> None:
    env: Any = FarWallEnv(
        render_backend=RENDER_BACKEND, reward_mode="none", sensor_configs={"shader_pack": shader}
    )
    env.reset(seed=0)
    (picture,) = take_pictures(env, 0, [("far", "sensor", ["depth", "segmentation"])])
    assert picture.depth is not None and picture.segmentation is not None
    names = segmentation_names(env)
    for i, distance in enumerate([10.0, 32.7, 40.0, 70.0]):
        wall = next(number for number, name in names.items() if name == f"wall_{i}")
        seen = picture.depth[picture.segmentation == wall]
        assert len(seen) > 20
        np.testing.assert_allclose(seen, distance, rtol=2e-3)
    assert (picture.depth[picture.segmentation == 0] == 0).all() and (picture.segmentation == 0).any()
    env.close()


def test_equal_envs_share_their_segmentation_ids() -> None:
    env = batched("PegInsertionSide-v1", num_envs=3)
    names = segmentation_names(env)
    assert set(names.values()) == set(scene_index(env).names)
    ids = [[entity.per_scene_id for entity in row] for row in scene_index(env).entities]
    assert ids[0] == ids[1] == ids[2]
    env.close()
