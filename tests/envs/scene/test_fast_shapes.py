"""Fast pictures of cameras on heavy bodies equal exact ones but for few pixels, in envs that differ."""

# ManiSkill annotates vectors and poses as what they become.
# pyright: reportAttributeAccessIssue=false, reportArgumentType=false, reportOptionalMemberAccess=false, reportOperatorIssue=false
# pyright: reportCallIssue=false, reportOptionalSubscript=false

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sapien
import torch
import trimesh
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils.structs.pose import Pose

from tests.drive.render_device import RENDER_BACKEND, RENDER_DEVICE
from tests.envs.stock_env import Bare
from workbench.envs.maniskill_private import camera_components
from workbench.envs.task_env import EnvOptions, make_env
from workbench.pictures.render import take_pictures

pytestmark = [
    pytest.mark.usefixtures("renderer"),
    pytest.mark.skipif(RENDER_DEVICE == "cuda", reason="a GPU draws exact pictures"),
]
N = 2
ALL = ("rgb", "depth", "segmentation")


class Balls(Bare):
    """Balls of 1280 triangles: one carries a camera that sees its rim, one is ahead, one translucent, one behind."""

    mesh_file = ""

    def _load_scene(self, options: dict) -> None:
        def ball(name: str, colour: list[float], place: sapien.Pose, scale: list[float]) -> Any:
            builder = self.scene.create_actor_builder()
            material = sapien.render.RenderMaterial(base_color=[*colour, 1])
            builder.add_visual_from_file(self.mesh_file, place, scale, material)
            builder.initial_pose = sapien.Pose([0, 0, 1])
            return builder.build_kinematic(name)

        turned = [0.9238795, 0, 0, 0.3826834]
        self.rider = ball("rider", [1, 0, 0], sapien.Pose([0.35, 0, -0.25], turned), [0.1, 0.3, 0.1])
        self.ahead = ball("ahead", [0, 1, 0], sapien.Pose([0, 0.1, 0], turned), [0.3, 0.1, 0.2])
        self.ghost = ball("ghost", [0, 0, 1], sapien.Pose(), [0.15] * 3)
        self.behind = ball("behind", [1, 1, 0], sapien.Pose(), [0.2] * 3)
        self.extra = self.scene.add_camera("extra", sapien.Pose([0, 0, 1]), 48, 36, 0.01, 10, fovy=1.2)

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        lens = {"width": 48, "height": 36, "fov": 1.2, "near": 0.01, "far": 10}
        return [
            CameraConfig("on_ball", pose=sapien.Pose(), mount=self.rider, **lens),
            CameraConfig("fixed", pose=sapien.Pose([0, 0, 1]), **lens),
        ]

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        number = env_idx.float()
        for body, x, y in (
            (self.rider, 0, 0),
            (self.ahead, 1.2, 0.2),
            (self.ghost, 1, -0.3),
            (self.behind, -1, 0),
        ):
            aside = 0 if body is self.rider else 0.15
            p = torch.stack([x + 0 * number, y + aside * number, 1 + 0.05 * number], dim=1)
            body.set_pose(Pose.create_from_pq(p))


@pytest.fixture(scope="module")
def env(tmp_path_factory: pytest.TempPathFactory, renderer: None) -> Iterator[Any]:
    Balls.mesh_file = str(tmp_path_factory.mktemp("mesh") / "ball.obj")
    trimesh.creation.icosphere(subdivisions=3).export(Path(Balls.mesh_file))
    env = make_env(Balls, options("exact"))
    env.reset(seed=0)
    yield env
    env.close()


def options(pictures: Any) -> EnvOptions:
    kwargs = {"obs_mode": "rgb+depth+segmentation", "render_backend": RENDER_BACKEND}
    return EnvOptions(N, "cpu", pictures=pictures, rules="off", kwargs=kwargs)


def assert_fast_equals_exact(env: Any, camera: str, *seen: str) -> None:
    for number in range(N):
        exact, fast = (
            take_pictures(env, number, [(camera, "sensor", ALL)], degree=degree)[0]
            for degree in ("exact", "fast")
        )
        for name in seen:
            body = getattr(env, name)._objs[number].per_scene_id
            assert (exact.segmentation == body).sum() > 20, f"{name} is not in view"
        assert (fast.segmentation != exact.segmentation).mean() < 0.02
        assert np.abs(fast.rgb.astype(int) - exact.rgb).mean() < 2
        assert (np.abs(fast.depth - exact.depth) > 0.05).mean() < 0.02


def test_a_camera_sees_its_mount_and_what_is_ahead_also_after_it_was_moved(env: Any) -> None:
    components = camera_components(env.scene.sensors["on_ball"])
    own = [component.local_pose for component in components]
    try:
        for _ in range(2):
            assert_fast_equals_exact(env, "on_ball", "rider", "ahead")
            for component in components:  # to the side, where other triangles of the mount are in view
                component.local_pose = sapien.Pose([0.1, -0.2, -0.2], [0.9238795, 0, 0, 0.3826834])
            assert_fast_equals_exact(env, "on_ball", "rider")
            for component, pose in zip(components, own, strict=True):
                component.local_pose = pose
    finally:
        for component, pose in zip(components, own, strict=True):
            component.local_pose = pose


def test_translucent_and_hidden_bodies_are_drawn_as_in_exact_pictures(env: Any) -> None:
    bodies = [entity.find_component_by_type(sapien.render.RenderBodyComponent) for entity in env.ghost._objs]
    for visibility in (0.4, 0.0, 1.0):
        for body in bodies:
            body.visibility = visibility
        assert_fast_equals_exact(env, "fixed", "ahead", *(["ghost"] if visibility == 1 else []))
        assert [body.visibility for body in bodies] == pytest.approx([visibility] * N)


def test_a_texture_that_the_fast_picture_lacks_is_drawn_in_every_env(env: Any) -> None:
    fast = make_env(Balls, options("fast"))
    observed, _ = fast.reset(seed=0)  # the first picture has colours only
    env.reset(seed=0)
    for camera, data in observed["sensor_data"].items():
        exact = env.get_obs(env.get_info())["sensor_data"][camera]
        assert not torch.equal(data["segmentation"][0], data["segmentation"][1])
        for number in range(N):
            off = [(data[name][number] - exact[name][number]).abs() for name in ("segmentation", "depth")]
            assert (off[0] > 0).float().mean() < 0.02 and (off[1] > 50).float().mean() < 0.02
    fast.close()


def test_a_camera_that_the_task_added_draws_each_env(env: Any) -> None:
    env.scene.update_render()
    env.extra.take_picture()
    (colour,) = env.extra.get_picture(["Color"])
    assert len(colour) == N and not torch.equal(colour[0], colour[1])
    for number in range(N):
        (wanted,) = take_pictures(env, number, [("fixed", "sensor", ["segmentation"])])
        drawn = (colour[number] != colour[number, 0, 0]).any(dim=-1).numpy()
        assert 50 < drawn.sum() < drawn.size / 2
        assert (drawn != (wanted.segmentation != 0)).mean() < 0.03
