"""Images show bodies at their current poses, whether or not a task's last writes were applied and fetched."""

# ManiSkill annotates an env's members as the widest thing they may be in any task.
# pyright: reportAttributeAccessIssue=false, reportOptionalMemberAccess=false, reportArgumentType=false
# pyright: reportIndexIssue=false, reportOptionalSubscript=false

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import sapien
import torch
from mani_skill.envs.tasks.tabletop.push_cube import PushCubeEnv
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils.structs.pose import Pose

from tests.envs.drawn_envs import batched
from workbench.envs.scene.scene_index import read_poses, scene_index
from workbench.envs.task_env import TaskEnv
from workbench.pictures.camera_report import join_reports
from workbench.pictures.render import step_pictures, take_pictures
from workbench.pictures.visibility import measure_placement, placement_of

pytestmark = [
    pytest.mark.usefixtures("renderer"),
    pytest.mark.filterwarnings("ignore::workbench.envs.broken_rule.RuleWarning"),
]
MODE = "rgb+segmentation"
N = 2
AWAY_METRES = 50.0
SENSOR = ("base_camera", "sensor", ("rgb", "segmentation"))
ON_CUBE = ("on_cube", "sensor", ("rgb", "segmentation"))
HUMAN = ("render_camera", "human", ("rgb",))


class Pushing(PushCubeEnv):
    """PushCube with an additional camera on the cube."""

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        (base,) = super()._default_sensor_configs
        base.width = base.height = 64
        above = sapien.Pose([0, 0, 0.2], [0.7071068, 0, 0.7071068, 0])
        return [base, CameraConfig("on_cube", above, 32, 32, 1.2, 0.01, 10, mount=self.obj)]

    @property
    def _default_human_render_camera_configs(self) -> CameraConfig:
        camera = super()._default_human_render_camera_configs
        camera.width = camera.height = 64
        return camera


class Hiding(Pushing):
    """``evaluate`` moves the cube far away in every env but the first."""

    def evaluate(self) -> dict:
        result = super().evaluate()
        pose = self.obj.pose.raw_pose.clone()
        pose[1:, 2] = AWAY_METRES
        self.obj.set_pose(Pose.create(pose))
        return result


@pytest.fixture(scope="module")
def hiding() -> Iterator[Any]:
    env = batched(Hiding, N, obs_mode=MODE, render_mode="rgb_array")
    yield env
    env.close()


@pytest.fixture
def pushing(pushing_env: Any) -> Any:
    pushing_env.reset(seed=3)
    return pushing_env


@pytest.fixture(scope="module")
def pushing_env() -> Iterator[Any]:
    env = batched(Pushing, N, obs_mode=MODE, render_mode="rgb_array")
    yield env
    env.close()


def has_cube(env: Any, segmentation: Any) -> list[bool]:
    return [bool((np.asarray(row) == int(env.obj.per_scene_id[0])).any()) for row in segmentation]


def drawn(env: Any, *requests: Any) -> list[Any]:
    return [take_pictures(env, e, requests) for e in range(N)]


def move_applied_and_fetched(env: Any, poses: torch.Tensor) -> None:
    env.obj.set_pose(Pose.create(poses))
    env.scene._gpu_apply_all()
    env.scene._gpu_fetch_all()


def test_a_cube_that_evaluate_moves_away_is_in_no_image(hiding: Any, pushing: Any) -> None:
    obs, _ = hiding.reset(seed=3)
    data = obs["sensor_data"]["base_camera"]
    assert has_cube(hiding, data["segmentation"]) == [True, False]
    # Compare with an env whose cube was moved there in the simulation.
    pose = pushing.obj.pose.raw_pose.clone()
    pose[1:, 2] = AWAY_METRES
    move_applied_and_fetched(pushing, pose)
    truth = pushing.get_obs(pushing.evaluate())["sensor_data"]
    for camera, textures in obs["sensor_data"].items():
        for texture, picture in textures.items():
            np.testing.assert_array_equal(picture, truth[camera][texture], err_msg=f"{camera} {texture}")
    np.testing.assert_array_equal(hiding.render_rgb_array(), pushing.render_rgb_array())
    np.testing.assert_array_equal(
        hiding.scene.sensors["on_cube"].camera.get_global_pose().raw_pose,
        pushing.scene.sensors["on_cube"].camera.get_global_pose().raw_pose,
    )


def test_images_poses_and_camera_reports_agree_on_the_moved_cube(hiding: Any) -> None:
    """Covers the page's images, 3-D scene and camera report."""
    obs, _ = hiding.reset(seed=3)
    human_images = hiding.render_rgb_array()
    poses = read_poses(hiding)
    assert (poses[:, scene_index(hiding).names.index("cube"), 2] > AWAY_METRES / 2).tolist() == [False, True]
    for e, (sensor, on_cube) in enumerate(drawn(hiding, SENSOR, ON_CUBE)):
        for picture in (sensor, on_cube):
            data = obs["sensor_data"][picture.camera]
            np.testing.assert_array_equal(picture.rgb, data["rgb"][e])
            np.testing.assert_array_equal(picture.segmentation, data["segmentation"][e, ..., 0])
        assert (on_cube.pose[2] > AWAY_METRES / 2) == (e == 1)
        (human,) = take_pictures(hiding, e, [HUMAN])
        np.testing.assert_array_equal(human.rgb, human_images[e])
    report = join_reports(
        [measure_placement(hiding, e, placement_of(hiding, ("sensor", "base_camera"), e)) for e in range(N)]
    )
    cube = next(seen for seen in report.objects if seen.name == "cube")
    assert (cube.pixels > 0).tolist() == [True, False]
    observed = step_pictures(_task(hiding, obs), range(N), [ON_CUBE])
    assert [picture.pose[2] > AWAY_METRES / 2 for picture in observed] == [False, True]


def _task(env: Any, obs: Any) -> TaskEnv:
    task = TaskEnv(env)
    task.obs = obs
    return task


# --- states that are written, applied, stepped or fetched -------------------------------------------


def write_pose(env: Any) -> None:
    pose = env.obj.pose.raw_pose.clone()
    pose[:, 2] += 0.1
    env.obj.set_pose(Pose.create(pose))


def write_and_apply(env: Any) -> None:
    write_pose(env)
    env.scene._gpu_apply_all()


def step_alone(env: Any) -> None:
    """Step the simulation without a fetch: the arm moves, the tensors do not change."""
    env.agent.robot.set_qvel(torch.ones_like(env.agent.robot.qvel))
    env.scene._gpu_apply_all()
    for _ in range(5):
        env.scene.step()


def apply_qpos(env: Any) -> None:
    env.agent.robot.set_qpos(env.agent.robot.qpos + 0.3)
    env.scene._gpu_apply_all()


def write_root(env: Any) -> None:
    env.agent.robot.set_pose(sapien.Pose([-0.5, 0.2, 0.1]))


def write_link(env: Any) -> None:
    env.agent.tcp.set_pose(sapien.Pose([0, 0, 0.5]))


@pytest.mark.parametrize(
    "change", [write_pose, write_and_apply, step_alone, apply_qpos, write_root, write_link]
)
def test_bodies_are_drawn_where_they_are(change: Callable[[Any], None], pushing: Any) -> None:
    before = drawn(pushing, SENSOR)
    change(pushing)
    poses = read_poses(pushing)
    packs = pushing.scene.px.packs()
    observed = pushing.get_obs({})["sensor_data"]["base_camera"]
    for e, (picture,) in enumerate(drawn(pushing, SENSOR)):
        np.testing.assert_array_equal(picture.rgb, observed["rgb"][e])
        np.testing.assert_array_equal(picture.segmentation, observed["segmentation"][e, ..., 0])
        (wanted,) = take_pictures(pushing, e, [SENSOR], poses[e])
        np.testing.assert_array_equal(picture.segmentation, wanted.segmentation)
        moved = not np.array_equal(picture.segmentation, before[e][0].segmentation)
        assert moved == (change is not write_link), (
            "only a write to a link without shapes may leave the image"
        )
    assert pushing.scene.px.packs() == packs
