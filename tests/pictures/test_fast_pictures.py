"""Fast pictures differ little from exact pictures of the same state and have no side effects."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import mani_skill.envs  # noqa: F401 (registers the tasks)
import numpy as np
import pytest
import sapien
import sapien.render
import torch

import workbench
from tests.drive.render_device import RENDER_DEVICE
from tests.envs.drawn_envs import batched
from workbench.envs.maniskill_private import camera_components
from workbench.pictures.render import take_pictures

pytestmark = pytest.mark.usefixtures("renderer")

ALL_THREE = ("rgb", "depth", "segmentation")


@pytest.fixture(scope="module")
def env() -> Iterator[Any]:
    env = batched("PickCube-v1", obs_mode="rgb+depth+segmentation")
    env.step(torch.from_numpy(env.action_space.sample()))
    yield env
    env.close()


def observed(env: Any) -> dict[str, np.ndarray]:
    return {
        key: value.numpy() for key, value in env.get_obs(env.get_info())["sensor_data"]["base_camera"].items()
    }


def test_a_fast_picture_differs_little_and_an_exact_one_not_at_all(env: Any) -> None:
    before = observed(env)
    env.scene.pictures = "fast"
    fast = observed(env)
    env.scene.pictures = "exact"
    after = observed(env)
    for name, exact in before.items():
        np.testing.assert_array_equal(after[name], exact)
    off = np.abs(fast["rgb"].astype(int) - before["rgb"])
    assert off.any(), "the fast picture must differ"
    assert off.mean() < 0.6 and (off.max(axis=-1) > 10).mean() < 0.008
    assert (fast["segmentation"] != before["segmentation"]).mean() < 0.01
    assert (np.abs(fast["depth"].astype(int) - before["depth"]) > 20).mean() < 0.01


def test_pictures_of_one_camera_equal_the_observation(env: Any) -> None:
    env.scene.pictures = "fast"
    seen = observed(env)
    env.scene.pictures = "exact"
    for index in range(env.num_envs):
        (picture,) = take_pictures(env, index, [("base_camera", "sensor", ALL_THREE)], degree="fast")
        np.testing.assert_array_equal(picture.rgb, seen["rgb"][index])
        np.testing.assert_array_equal(picture.segmentation, seen["segmentation"][index, ..., 0])
    (exact,) = take_pictures(env, 0, [("base_camera", "sensor", ALL_THREE)])
    np.testing.assert_array_equal(exact.rgb, observed(env)["rgb"][0])


def test_a_later_colour_change_shows_in_fast_and_exact_pictures(env: Any) -> None:
    link = env.agent.robot.links_map["panda_hand"]
    materials = [part.material for shape in link.render_shapes[0] for part in shape.parts]
    was = [list(material.base_color) for material in materials]
    take_pictures(env, 0, [("base_camera", "sensor", ["rgb"])], degree="fast")
    try:
        for material in materials:
            material.base_color = [0.0, 1.0, 0.0, 1.0]
        for degree in ("exact", "fast"):
            (picture,) = take_pictures(env, 0, [("base_camera", "sensor", ALL_THREE)], degree=degree)
            assert picture.rgb is not None
            hand = picture.rgb[picture.segmentation == link._objs[0].entity.per_scene_id].astype(int)
            assert len(hand) > 50
            assert (hand[:, 1] > hand[:, 0] + 20).mean() > 0.8
    finally:
        for material, color in zip(materials, was, strict=True):
            material.base_color = color


def test_a_hidden_body_is_hidden_in_fast_and_exact_pictures(env: Any) -> None:
    entity = env.agent.robot.links_map["panda_hand"]._objs[0].entity
    body = entity.find_component_by_type(sapien.render.RenderBodyComponent)
    take_pictures(env, 0, [("base_camera", "sensor", ["rgb"])], degree="fast")
    body.visibility = 0.0
    try:
        for degree in ("exact", "fast"):
            (picture,) = take_pictures(env, 0, [("base_camera", "sensor", ALL_THREE)], degree=degree)
            assert not (picture.segmentation == entity.per_scene_id).any()
        assert body.visibility == 0.0
    finally:
        body.visibility = 1.0


@pytest.mark.skipif(RENDER_DEVICE == "cuda", reason="a GPU draws exact pictures")
def test_make_with_fast_pictures_warns() -> None:
    with pytest.warns(UserWarning, match="simplified meshes"):
        env: Any = workbench.make("PickCube-v1", 1, obs_mode="rgb", pictures="fast")
    obs, _ = env.reset(seed=0)
    inner = env.unwrapped
    (exact,) = take_pictures(inner, 0, [("base_camera", "sensor", ["rgb"])], degree="exact")
    off = np.abs(obs["sensor_data"]["base_camera"]["rgb"][0].numpy().astype(int) - exact.rgb)
    assert 0 < off.mean() < 2
    env.close()


@pytest.fixture(scope="module")
def wrist() -> Iterator[Any]:
    env = batched("PickCube-v1", obs_mode="rgb", robot_uids="panda_wristcam")
    yield env
    env.close()


def drawn_by(env: Any, camera: str) -> dict[str, int]:
    """Return the number of simplified triangles drawn for each body in fast pictures of env 0, by body name."""
    count = {}
    for exact, fast in env.scene._fast[0].bodies(("sensor", camera), 0):
        shapes = [] if fast is None else fast.render_shapes
        count[exact.entity.name] = sum(len(part.triangles) for shape in shapes for part in shape.parts)
    return count


@pytest.mark.slow
def test_a_wrist_camera_skips_bodies_outside_its_view(wrist: Any) -> None:
    exact, fast = (
        take_pictures(wrist, 0, [("hand_camera", "sensor", ["rgb", "segmentation"])], degree=degree)[0]
        for degree in ("exact", "fast")
    )
    np.testing.assert_array_equal(fast.segmentation, exact.segmentation)
    assert fast.rgb is not None and exact.rgb is not None
    assert np.abs(fast.rgb.astype(int) - exact.rgb).mean() < 1
    drawn = drawn_by(wrist, "hand_camera")
    # camera_link is the camera's own body, with 425,000 triangles.
    assert drawn["camera_link"] == drawn["panda_link7"] == drawn["panda_link0"] == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("at", "turned"),
    [
        ((-0.25, 0, 0), (1, 0, 0, 0)),
        ((-0.2, 0, -0.2), (1, 0, 0, 0)),
        ((0.1, 0, 0.3), (0.7071068, 0, 0.7071068, 0)),
    ],
)
def test_a_camera_moved_on_its_mount_sees_the_mount(wrist: Any, at: Any, turned: Any) -> None:
    component = camera_components(wrist._sensors["hand_camera"])[0]
    take_pictures(wrist, 0, [("hand_camera", "sensor", ["rgb"])], degree="fast")
    was = component.local_pose
    component.local_pose = was * sapien.Pose(at, turned)
    try:
        exact, fast = (
            take_pictures(wrist, 0, [("hand_camera", "sensor", ["rgb", "segmentation"])], degree=degree)[0]
            for degree in ("exact", "fast")
        )
    finally:
        component.local_pose = was
    links = [link._objs[0].entity.per_scene_id for link in wrist.agent.robot.links]
    assert exact.segmentation is not None and np.isin(exact.segmentation, links).sum() > 50
    assert (fast.segmentation != exact.segmentation).mean() < 0.01
    take_pictures(wrist, 0, [("hand_camera", "sensor", ["rgb"])], degree="fast")
    assert drawn_by(wrist, "hand_camera")["camera_link"] == 0


def test_a_body_that_comes_into_view_is_drawn(env: Any) -> None:
    component = camera_components(env._sensors["base_camera"])[0]
    request: list[Any] = [("base_camera", "sensor", ["rgb", "segmentation"])]
    was = component.local_pose
    try:
        component.local_pose = was * sapien.Pose(q=[0, 0, 0, 1])
        (away,) = take_pictures(env, 0, request, degree="fast")
        assert set(drawn_by(env, "base_camera").values()) <= {0, 2}, (
            "only the floor may be drawn: the robot is behind the camera"
        )
    finally:
        component.local_pose = was
    exact, fast = (take_pictures(env, 0, request, degree=degree)[0] for degree in ("exact", "fast"))
    assert (fast.segmentation != exact.segmentation).mean() < 0.01
    assert (away.segmentation != exact.segmentation).mean() > 0.1
