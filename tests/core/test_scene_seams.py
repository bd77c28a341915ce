# pyright: reportArgumentType=false
"""Every private name of ManiSkill that drawing and pictures rely upon: an upgrade fails here first."""

from __future__ import annotations

import copy
import inspect
import re
import sys

import numpy as np
import pytest
import sapien
from mani_skill.envs import sapien_env
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.sensors.camera import Camera, CameraConfig
from mani_skill.utils import sapien_utils
from mani_skill.utils.structs import Actor
from mani_skill.utils.structs.base import BaseStruct, PhysxRigidBodyComponentStruct
from mani_skill.utils.structs.render_camera import RenderCamera

from workbench.core import maniskill_private


@pytest.mark.parametrize("name", ["_objs", "_scene_idxs"])
def test_structs_know_their_objects_and_envs(name: str) -> None:
    assert name in BaseStruct.__dataclass_fields__


def test_bodies_know_their_rows() -> None:
    assert "_body_data_index" in PhysxRigidBodyComponentStruct.__dict__


def test_hiding_in_gpu_simulation_keeps_the_pose_aside_and_moves_the_actor() -> None:
    source = inspect.getsource(Actor.hide_visual)
    assert "self.before_hide_pose = self.pose.raw_pose.clone()" in source
    assert "self.scene.gpu_sim_enabled" in source and "visibility = 0" in source
    assert {"hidden", "px_body_type"} <= set(Actor.__dataclass_fields__)


@pytest.mark.parametrize("name", ["_sensors", "_human_render_cameras", "_hidden_objects"])
def test_envs_hold_their_cameras_and_hidden_objects(name: str) -> None:
    assert name in sapien_env.BaseEnv.__annotations__
    assert f"self.{name}" in inspect.getsource(sapien_env)


def test_sensors_see_without_and_human_cameras_with_hidden_objects() -> None:
    assert "obj.hide_visual()" in inspect.getsource(sapien_env.BaseEnv._get_obs_sensor_data)
    human = inspect.getsource(sapien_env.BaseEnv.render_rgb_array)
    assert human.index("obj.show_visual()") < human.index("self.scene.update_render")


def test_cameras_hold_one_component_an_env() -> None:
    assert {"_render_cameras", "mount"} <= set(RenderCamera.__dataclass_fields__)
    assert "shader_config" in CameraConfig.__dataclass_fields__
    assert "self.camera" in inspect.getsource(Camera.__init__)


@pytest.mark.parametrize(
    "name", ["actors", "articulations", "actor_views", "articulation_views", "sub_scenes"]
)
def test_a_scene_lists_its_objects_and_views(name: str) -> None:
    assert f"self.{name}" in inspect.getsource(ManiSkillScene.__init__)


def test_packed_poses_are_quaternion_then_position_of_every_entity_in_order() -> None:
    scene = sapien.Scene([sapien.physx.PhysxCpuSystem()])
    for i in range(3):
        entity = sapien.Entity()
        entity.pose = sapien.Pose([i, 2, 3], [0.5, 0.5, -0.5, 0.5])
        scene.add_entity(entity)
    packed = np.frombuffer(scene.pack_poses(), np.float32).reshape(-1, 7)
    np.testing.assert_allclose(packed, [[0.5, 0.5, -0.5, 0.5, i, 2, 3] for i in range(3)])
    assert [e.pose.p[0] for e in scene.entities] == [0, 1, 2]


def test_cameras_are_made_by_one_method_and_kept_in_these_lists() -> None:
    source = inspect.getsource(sapien_env.BaseEnv._setup_sensors)
    for line in (
        "self._sensors = dict()",
        "self._human_render_cameras = dict()",
        "self.scene.sensors = self._sensors",
        "self.scene.human_render_cameras = self._human_render_cameras",
    ):
        assert line in source
    assert "self._setup_sensors(options)" in inspect.getsource(sapien_env.BaseEnv._reconfigure)
    assert "self.camera_groups" in inspect.getsource(ManiSkillScene.__init__)


def test_a_step_flattens_after_the_reward_and_a_reset_says_whom_it_resets() -> None:
    step = inspect.getsource(sapien_env.BaseEnv.step)
    assert step.index("self.get_reward(") < step.index("obs = self._flatten_raw_obs(obs)")
    assert "self.scene._reset_mask[env_idx] = True" in inspect.getsource(sapien_env.BaseEnv.reset)
    assert "self._init_raw_obs = obs" in inspect.getsource(sapien_env.BaseEnv.update_obs_space)


def test_what_placing_a_camera_writes_is_there() -> None:
    cached = {
        f"_cached_{name}" for name in ("model_matrix", "extrinsic_matrix", "intrinsic_matrix", "local_pose")
    }
    assert cached == {name for name in RenderCamera.__dataclass_fields__ if name.startswith("_cached")}
    source = inspect.getsource(sapien_env.BaseEnv._setup_sensors)
    assert "self._sensor_configs" in source and "self._human_render_camera_configs" in source
    init = inspect.getsource(Camera.__init__)
    # What `Camera` keeps of its config, and what else it is made of: with the shader's config in nightly builds.
    kept = set(re.findall(r"self\.(\w+) =", init))
    nightly = {"_shader_config"} & kept
    assert kept == {"entity", "camera", *nightly}
    assert f"set_shader_pack(self.{'_shader_config' if nightly else 'config.shader_config'})" in init
    assert "Pose.create(self.pose)" in inspect.getsource(CameraConfig.__post_init__)


def test_a_config_knows_where_it_was_made(monkeypatch: pytest.MonkeyPatch) -> None:
    # Whatever ran an author's hooks in this process before has marked the class: here it begins as ManiSkill has it.
    stock = getattr(CameraConfig.__init__, "_workbench_stock", CameraConfig.__init__)
    monkeypatch.setattr(CameraConfig, "__init__", stock)
    monkeypatch.setattr(sapien_utils, "look_at", sapien_utils.look_at)  # to be put back
    maniskill_private.mark_camera_configs()
    maniskill_private.mark_camera_configs()

    def hook() -> list[CameraConfig]:
        pose = sapien.Pose()
        return [
            CameraConfig("a", pose, 8, 6, fov=1.0),
            CameraConfig(
                "b",
                pose=sapien.Pose(
                    [0, 0, 1]
                ),
                width=8, height=6, fov=1.0,
            ),
        ]  # fmt: skip

    first = inspect.getsourcelines(hook)[1]
    sites = [maniskill_private.camera_site(copy.copy(config)) for config in hook()]
    assert [site and (site.file, site.line - first) for site in sites] == [(__file__, 3), (__file__, 4)]
    if sys.version_info >= (3, 11):
        assert sites[0].function == "test_a_config_knows_where_it_was_made.<locals>.hook"  # type: ignore[union-attr]
    monkeypatch.setattr(CameraConfig, "__init__", stock)
    assert maniskill_private.camera_site(hook()[0]) is None
