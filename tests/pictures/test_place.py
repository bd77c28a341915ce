"""A camera placed on a running env equals, to the last bit, the camera of an env built with that config."""

# pyright: reportAttributeAccessIssue=false, reportOptionalMemberAccess=false, reportArgumentType=false

from __future__ import annotations

import pickle
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import sapien
import torch
from mani_skill.sensors.camera import CameraConfig

from tests.envs.stock_env import batch_of
from tests.envs.watched import RENDERED, Watched, pictures
from workbench.envs.camera_data import CameraKey, CameraSettings
from workbench.envs.hot_swap import exchange_cameras
from workbench.envs.snapshots.snapshot import restore_snapshot, take_snapshot
from workbench.pictures.placed_cameras import PlacedCameras, settings_of
from workbench.pictures.render import list_cameras, segmentation_names, take_pictures

N = 2
SEEDS = [4, 5]
BESIDE: CameraKey = ("sensor", "beside")
PEOPLE: CameraKey = ("human", "people")
TURNED = (0.96, 0.0, 0.28, 0.0)


@pytest.fixture(scope="module")
def envs(renderer: None) -> Iterator[tuple[Any, Any]]:
    """Yield an env whose cameras are placed, and one whose cameras are configured in ManiSkill."""
    pair = batch_of(Watched, N, **RENDERED), batch_of(Watched, N, **RENDERED)
    yield pair
    for env in pair:
        env.close()


@pytest.fixture
def env(envs: tuple[Any, Any]) -> Any:
    env = envs[0]
    exchange_cameras(env)
    env.reset(seed=SEEDS)
    return env


def settings_of_camera(env: Any, key: CameraKey) -> CameraSettings:
    info = next(c for c in list_cameras(env) if (c.kind, c.name) == key)
    assert info.settings is not None
    return info.settings


def configured(env: Any, key: CameraKey, settings: CameraSettings) -> Any:
    """Return `env` with cameras that ManiSkill built from a config with these settings."""
    values = dict(vars(settings))
    del values["distance"]  # not a field of CameraConfig
    pose = sapien.Pose(values.pop("position"), values.pop("quaternion"))
    intrinsic = values.pop("intrinsic")
    values["intrinsic"] = None if intrinsic is None else np.array(intrinsic)
    wanted = {key[1]: {"pose": pose, **values}}
    env._custom_sensor_configs = wanted if key[0] == "sensor" else None
    env._custom_human_render_camera_configs = wanted if key[0] == "human" else None
    exchange_cameras(env)
    env.reset(seed=SEEDS)
    return env


def assert_sees_alike(placed: Any, built: Any, key: CameraKey) -> None:
    here, there = (env.get_obs(env.get_info()) for env in (placed, built))
    for name, picture in pictures(there).items():
        assert np.array_equal(pictures(here)[name], picture), name
    for camera, params in there["sensor_param"].items():
        for name, matrix in params.items():
            assert np.array_equal(here["sensor_param"][camera][name], matrix), f"{camera}/{name}"
    assert np.array_equal(placed.render_rgb_array(), built.render_rgb_array())
    for i in range(N):
        mine, theirs = (take_pictures(e, i, [(key[1], key[0], ("rgb", "depth"))])[0] for e in (placed, built))
        assert np.array_equal(mine.rgb, theirs.rgb) and np.array_equal(mine.depth, theirs.depth)


INTRINSIC = ((20.0, 0.0, 15.0), (0.0, 22.0, 13.0), (0.0, 0.0, 1.0))


@pytest.mark.parametrize(
    ("key", "change"),
    [
        (BESIDE, {"position": (0.5, -0.3, 1.4), "quaternion": TURNED}),
        (BESIDE, {"fov": 0.7, "near": 0.2, "far": 1.9}),
        (BESIDE, {"fov": None, "intrinsic": INTRINSIC}),
        (BESIDE, {"width": 41, "height": 30, "fov": 1.1}),
        (BESIDE, {"shader_pack": "default", "position": (0.2, 0.0, 1.1)}),
        (("sensor", "on_link"), {"position": (0.1, 0.2, 0.3), "quaternion": TURNED}),
        (("sensor", "on_actor"), {"width": 20, "position": (0.0, 0.2, 0.0)}),
        (PEOPLE, {"position": (-0.4, 0.0, 1.2), "fov": 0.9}),
    ],
)
def test_a_placed_camera_equals_one_built_from_config(
    env: Any, envs: tuple[Any, Any], key: CameraKey, change: dict[str, Any]
) -> None:
    settings = replace(settings_of_camera(env, key), **change)
    reshaped = PlacedCameras().place(env, key, settings)
    assert reshaped == bool(change.keys() & {"width", "height", "shader_pack"})
    # The camera is rendered before and after its exchange; the old camera group must not be used.
    assert_sees_alike(env, configured(envs[1], key, settings), key)
    assert segmentation_names(env) == segmentation_names(envs[1])


def test_placements_replace_each_other_and_can_be_undone(env: Any, envs: tuple[Any, Any]) -> None:
    before = pictures(env.get_obs(env.get_info()))
    placed, file = PlacedCameras(), settings_of_camera(env, BESIDE)
    for change in (
        {"fov": None, "intrinsic": INTRINSIC},
        {"position": (1.0, 0.0, 1.0)},
        {"fov": None, "intrinsic": INTRINSIC, "width": 50},
        {"quaternion": TURNED},
    ):
        placed.place(env, BESIDE, replace(file, **change))  # pyright: ignore[reportArgumentType]
        assert_sees_alike(env, configured(envs[1], BESIDE, replace(file, **change)), BESIDE)  # pyright: ignore[reportArgumentType]
    placed.place(env, BESIDE, None)
    assert settings_of_camera(env, BESIDE) == file
    after = pictures(env.get_obs(env.get_info()))
    assert all(np.array_equal(after[name], picture) for name, picture in before.items())


def test_resets_and_snapshots_keep_a_placed_camera(env: Any) -> None:
    placed = PlacedCameras()
    kept = take_snapshot(env)
    settings = replace(settings_of_camera(env, BESIDE), position=(0.5, 0.0, 1.3), width=30)
    placed.place(env, BESIDE, settings)
    for do in (
        lambda: env.reset(seed=SEEDS),
        lambda: env.reset(options={"env_idx": [1]}),
        lambda: restore_snapshot(env, kept),
        lambda: restore_snapshot(env, pickle.loads(pickle.dumps(take_snapshot(env)))),
    ):
        do()
        placed.put_back(env)
        (picture,) = take_pictures(env, 1, [("beside", "sensor", ("rgb",))])
        assert np.allclose(picture.pose, [0.5, 0, 1.3, 1, 0, 0, 0]) and picture.rgb.shape == (24, 30, 3)


class Wandering(Watched):
    """The human render camera has a different pose in each rebuilt scene."""

    builds = 0

    @property
    def _default_human_render_camera_configs(self) -> CameraConfig:
        return CameraConfig("people", sapien.Pose([0, 0, 1.0 + self.builds], TURNED), 32, 24, 1.5, 0.01, 10)

    def _load_scene(self, options: dict) -> None:
        super()._load_scene(options)
        self.builds += 1


def test_a_camera_is_restored_to_its_pose_in_the_rebuilt_scene(renderer: None) -> None:
    env = batch_of(Wandering, 2, **RENDERED)
    env.reset(seed=SEEDS)
    placed, first = PlacedCameras(), settings_of_camera(env, PEOPLE)
    placed.place(env, PEOPLE, replace(first, position=(-1.0, 0.5, 0.2)))
    env.reset(seed=SEEDS, options={"reconfigure": True})
    second = settings_of_camera(env, PEOPLE)
    assert second.position != first.position
    placed.put_back(env)
    assert np.allclose(settings_of_camera(env, PEOPLE).position, (-1.0, 0.5, 0.2))
    placed.place(env, PEOPLE, None)
    assert settings_of_camera(env, PEOPLE) == second
    (picture,) = take_pictures(env, 1, [("people", "human", ("rgb",))])
    assert np.allclose(picture.pose, [*second.position, *second.quaternion])
    env.close()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"near": 2.0, "far": 1.0}, "near must be"),
        ({"fov": 3.5}, "below pi"),
        ({"fov": None}, "either a fov or an intrinsic"),
        ({"width": 0}, "width and height"),
        ({"height": 100_000}, "width and height"),
        ({"position": (float("nan"), 0.0, 0.0)}, "finite"),
        ({"quaternion": (2.0, 0.0, 0.0, 0.0)}, "unit length"),
        ({"shader_pack": "nonsense"}, "there is no shader pack"),
    ],
)
def test_invalid_settings_are_refused_and_change_nothing(env: Any, change: dict, says: str) -> None:
    before = settings_of_camera(env, BESIDE)
    with pytest.raises(ValueError, match=says):
        PlacedCameras().place(env, BESIDE, replace(before, **change))
    with pytest.raises(ValueError, match="there is no human camera"):
        PlacedCameras().place(env, ("human", "beside"), before)
    assert settings_of_camera(env, BESIDE) == before


def test_a_camera_whose_lens_differs_between_envs_has_no_settings_and_an_equal_one_has() -> None:
    pose = sapien.Pose([0.1, 0.2, 0.3], [2.0, 0, 0, 0])

    def settings(**lens: Any) -> CameraSettings | None:
        return settings_of(CameraConfig("eye", pose, 32, 24, near=0.01, far=10, **lens))

    alike = settings(fov=torch.tensor([0.7, 0.7]))
    assert alike is not None and alike.fov == pytest.approx(0.7) and alike.intrinsic is None
    assert alike.position == pytest.approx((0.1, 0.2, 0.3)) and alike.quaternion == (1, 0, 0, 0)
    assert settings(fov=torch.tensor([0.7, 0.8])) is None
    matrix = np.array(INTRINSIC)
    by_matrix = settings(intrinsic=np.stack([matrix, matrix]))
    assert by_matrix is not None and by_matrix.intrinsic == INTRINSIC and by_matrix.fov is None
    assert settings(intrinsic=np.stack([matrix, 2 * matrix])) is None
    pose = sapien.Pose([np.nan, 0, 0])
    assert settings(fov=0.7) is None


def test_placements_of_several_cameras_are_kept_apart(env: Any) -> None:
    placed = PlacedCameras()
    first, second = (
        replace(settings_of_camera(env, key), position=(x, 0.1, 1.2))
        for key, x in ((BESIDE, 0.3), (PEOPLE, 0.6))
    )
    placed.place(env, BESIDE, first)
    placed.place(env, PEOPLE, second)
    assert placed.all == {BESIDE: first, PEOPLE: second} and placed.settings(BESIDE) == first
    placed.place(env, BESIDE, None)
    assert placed.all == {PEOPLE: second} and placed.settings(BESIDE) is None
    assert settings_of_camera(env, PEOPLE).position == pytest.approx(second.position)
    assert placed.place(env, BESIDE, None) is False, "it is not placed"
    placed.forget()
    assert placed.all == {} and settings_of_camera(env, PEOPLE).position == pytest.approx(second.position)


def test_a_pose_that_differs_between_envs_is_flagged_and_restored(env: Any) -> None:
    for i, component in enumerate(env._sensors["beside"].camera._render_cameras):
        component.local_pose = sapien.Pose([0.1 * i, 0, 1])
    info = next(c for c in list_cameras(env) if c.name == "beside")
    assert info.varies and not next(c for c in list_cameras(env) if c.name == "people").varies
    placed = PlacedCameras()
    placed.place(env, BESIDE, replace(settings_of_camera(env, BESIDE), position=(0.5, 0.5, 0.5)))
    placed.place(env, BESIDE, None)
    (picture,) = take_pictures(env, 1, [("beside", "sensor", ("rgb",))])
    assert np.allclose(picture.pose[:3], [0.1, 0, 1])
