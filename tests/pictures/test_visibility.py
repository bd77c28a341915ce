"""A camera's visibility report agrees with ManiSkill's own segmentation, and measuring leaves no trace."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import sapien
import torch
from numpy.testing import assert_allclose, assert_array_equal

from tests.drive.envs import batched
from workbench.envs.camera_data import CameraKey, CameraSettings
from workbench.envs.maniskill_private import camera_components
from workbench.envs.scene.scene_index import read_poses, scene_index
from workbench.pictures.camera_conventions import LookAt, compose, pose_from_look_at, relative_to, with_pose
from workbench.pictures.camera_report import CameraReport, ObjectSeen, join_reports
from workbench.pictures.render import cameras_of, segmentation_names, take_pictures
from workbench.pictures.visibility import (
    Placement,
    measure_placement,
    placement_of,
    present_settings,
    small_size,
)

pytestmark = pytest.mark.usefixtures("renderer")

N = 3
SENSOR: CameraKey = ("sensor", "base_camera")
PEOPLE: CameraKey = ("human", "render_camera")
FAR_FLOOR = LookAt((-1.5, 0.0, 0.5), (0.0, 0.0, 0.3))


def measure_camera(
    env: Any, camera: CameraKey, e: int, settings: CameraSettings | None = None, **how: Any
) -> CameraReport:
    return measure_placement(env, e, placement_of(env, camera, e, settings), **how)


def built(task: str, **kwargs: Any) -> Any:
    env = batched(task, N, render=True, **{"obs_mode": "rgb+depth+segmentation", **kwargs})
    env.reset(seed=3)
    shape: Any = env.action_space.shape
    env.step(torch.zeros(shape))
    return env


@pytest.fixture(scope="module")
def env() -> Iterator[Any]:
    """Yield PushCube with a sensor shader that differs from the one that reports use."""
    made = built("PushCube-v1", sensor_configs={"shader_pack": "default"})
    yield made
    made.close()


def looking(look_at: LookAt, **others: Any) -> CameraSettings:
    plain = CameraSettings((0, 0, 0), (1, 0, 0, 0), 1.0, None, 64, 64, 0.01, 100, "minimal")
    return with_pose(replace(plain, **others), pose_from_look_at(look_at))


def in_all_envs(env: Any, placement: Placement) -> CameraReport:
    return join_reports([measure_placement(env, e, placement) for e in range(N)])


def cube_at(env: Any, e: int) -> Any:
    return env.obj.pose.p[e].tolist()


def seen(report: CameraReport, name: str) -> ObjectSeen:
    return next(thing for thing in report.objects if thing.name == name)


def test_pixels_equal_maniskills_segmentation(env: Any) -> None:
    report = join_reports([measure_camera(env, SENSOR, e) for e in range(N)])
    images = env.get_obs(env.get_info())["sensor_data"]["base_camera"]
    cube = segmentation_names(env)
    number = next(number for number, name in cube.items() if name == "cube")
    for e in range(N):
        segmentation = images["segmentation"][e, ..., 0].numpy()
        assert seen(report, "cube").pixels[e] == (segmentation == number).sum() > 10
        depth = images["depth"][e, ..., 0].numpy() / 1000
        assert report.depth.background[e] == pytest.approx((segmentation == 0).mean(), abs=1e-6)
        assert report.depth.counts[e].sum() == (segmentation != 0).sum()
        assert report.depth.nearest[e] == pytest.approx(depth[segmentation != 0].min(), abs=0.002)
    summary = seen(report, "cube").summary()
    assert (summary.present, summary.seen, summary.cut) == (N, 1.0, 0.0)
    assert summary.median_pixels == np.median(seen(report, "cube").pixels)
    assert report.size == report.measured_size == (128, 128) and report.envs == (0, 1, 2)


def test_measuring_leaves_no_trace(env: Any) -> None:
    def state() -> list[Any]:
        scenes = env.scene.sub_scenes
        bodies = [b for s in scenes for b in s.render_system.render_bodies]
        return [
            [(s.physx_system.pack(), s.pack_poses(), [e.per_scene_id for e in s.entities]) for s in scenes],
            [(b.visibility, len(s.render_system.cameras)) for s in scenes for b in bodies],
            [present_settings(camera, e) for camera in cameras_of(env).values() for e in range(N)],
            sapien.render.get_camera_shader_dir(),
            [
                (p.rgb.tobytes(), p.depth.tobytes(), p.segmentation.tobytes())  # type: ignore[union-attr]
                for e in range(N)
                for p in take_pictures(
                    env,
                    e,
                    [(name, kind, ("rgb", "depth", "segmentation")) for kind, name in (SENSOR, PEOPLE)],
                )
            ],
        ]

    before = state()
    poses = read_poses(env)
    poses[..., 2] += 0.1
    for e in range(N):
        measure_camera(env, SENSOR, e, settings=looking(FAR_FLOOR), poses=poses[e])
    measure_camera(env, PEOPLE, 1, size=(32, 32))
    measure_placement(env, 0, Placement(looking(FAR_FLOOR), mount="panda/panda_hand"))
    with pytest.raises(ValueError, match="no body 'nothing'"):
        measure_placement(env, 0, Placement(looking(FAR_FLOOR), mount="nothing"))
    assert state() == before


def test_objects_hidden_by_the_robot_are_reported(env: Any) -> None:
    # From behind the robot's base at the cube's height, the base hides the cube.
    x, y, z = cube_at(env, 0)
    behind = looking(LookAt((-1.2, 0.0, z + 0.05), (x, y, z)), fov=0.6)
    above = looking(LookAt((x, y, 0.5), (x, y, 0.0)), fov=0.6)
    report = measure_placement(env, 0, Placement(behind))
    cube = seen(report, "cube")
    assert cube.pixels[0] == 0 and cube.unhindered[0] > 5 and cube.hidden_share[0] == 1
    assert cube.summary().wholly_hidden == 1 and report.env_marks(["cube"])[0] == 0
    free = measure_placement(env, 0, Placement(above))
    cube = seen(free, "cube")
    assert cube.pixels[0] == cube.unhindered[0] > 50 and cube.hidden_share[0] == 0 and not cube.cut[0]
    assert free.env_marks(["cube"])[0] > 0.7 and 0.3 < cube.margin[0] < 0.5


def test_an_object_is_cut_exactly_when_it_reaches_a_border(
    env: Any,
) -> None:
    x, y, _ = cube_at(env, 1)
    # From 0.4 m above, a pixel is 5 mm wide; the picture is not square.
    down = looking(LookAt((x, y, 0.4), (x, y, 0.0)), width=48, height=40, fov=0.5)

    def from_there(axis: int, by: float) -> ObjectSeen:
        at = np.array([x, y, 0.4])
        at[axis] += by
        position: Any = tuple(map(float, at))
        return seen(measure_placement(env, 1, Placement(replace(down, position=position))), "cube")

    for axis in (0, 1):
        for side in (-1, 1):
            assert not from_there(axis, 0).cut[0] and from_there(axis, side * 0.2).alone[0] == 0
            whole, cut = 0.0, 0.13
            while cut - whole > 0.002:
                middle = (whole + cut) / 2
                thing = from_there(axis, side * middle)
                whole, cut = (whole, middle) if thing.cut[0] or thing.alone[0] == 0 else (middle, cut)
            # Just before the object is cut, one row of pixels separates it from the border.
            near, over = from_there(axis, side * whole), from_there(axis, side * cut)
            assert near.margin[0] == pytest.approx(1 / 40) and over.margin[0] == 0, (axis, side)
            assert over.alone[0] > 0.5 * near.alone[0] > 10


def test_a_robot_out_of_view_and_scenery_take_no_pictures_of_their_own(env: Any) -> None:
    x, y, _ = cube_at(env, 0)
    away, at_robot = (
        looking(LookAt((x, y, 0.3), (x, y, 0.0)), fov=0.3),
        looking(LookAt((1.0, 0.0, 0.6), (-0.6, 0.0, 0.3))),
    )
    drawn = [thing.name for thing in measure_placement(env, 0, Placement(away)).wanted_objects()]
    assert set(drawn) == {"cube", "goal_region"}
    assert measure_placement(env, 0, Placement(away)).pictures == 3
    assert measure_placement(env, 0, Placement(at_robot)).pictures == 4
    sky = measure_placement(env, 0, Placement(looking(LookAt((0, 0, 1), (0, 0, 2)))))
    assert (
        sky.depth.background[0] == 1
        and np.isnan(sky.depth.nearest[0])
        and np.isnan(sky.depth.farthest_object[0])
    )
    floor = measure_placement(env, 0, Placement(looking(LookAt((-3, 0, 1), (-4, 0, 0)))))
    assert floor.depth.beyond[0] == 1 - floor.depth.background[0] > 0, (
        "nothing but the floor is beyond all objects"
    )


def test_a_camera_or_env_that_is_not_there_is_named(env: Any) -> None:
    with pytest.raises(
        ValueError, match=r"human camera 'base_camera'.*base_camera \(sensor\), render_camera \(human\)"
    ):
        placement_of(env, ("human", "base_camera"), 0)
    with pytest.raises(IndexError):
        placement_of(env, SENSOR, N)
    poses = read_poses(env)[0]
    poses[scene_index(env).names.index("cube")] = np.nan
    with pytest.raises(ValueError, match="no body 'cube'"):
        measure_placement(env, 0, Placement(looking(FAR_FLOOR), mount="cube"), poses=poses)


def test_a_smaller_picture_has_the_same_view_and_scales_its_counts(env: Any) -> None:
    x, y, _ = cube_at(env, 0)
    settings = looking(LookAt((x - 0.3, y, 0.5), (x, y, 0)), width=320, height=200, fov=0.8)
    whole = measure_placement(env, 0, Placement(settings))
    for size in [(160, 100), (64, 64), small_size(320, 200)]:
        small = measure_placement(env, 0, Placement(settings), size=size)
        assert (small.size, small.measured_size) == ((320, 200), size)
        assert seen(small, "cube").pixels[0] == pytest.approx(seen(whole, "cube").pixels[0], rel=0.15)
        assert_allclose(small.depth.background, whole.depth.background, atol=0.03)
    assert small_size(320, 200) == (102, 64) and small_size(20, 40) == (20, 40)


def test_depth_reports_background_far_floor_and_suggested_planes(env: Any) -> None:
    report = in_all_envs(env, Placement(looking(FAR_FLOOR)))
    depth = report.depth
    assert (depth.background > 0.2).all() and (depth.beyond > 0.05).all()
    assert (depth.farthest_object < 3).all()
    near, far = depth.suggested_near, depth.suggested_far
    assert near is not None and far is not None
    assert near <= depth.nearest.min() and depth.farthest_object.max() < far < 5
    tighter = in_all_envs(env, Placement(looking(FAR_FLOOR, near=near, far=far)))
    assert_array_equal(seen(tighter, "cube").pixels, seen(report, "cube").pixels)
    assert (tighter.depth.background > depth.background).all()


def test_the_present_placement_of_an_env_is_that_of_its_own_camera(env: Any) -> None:
    component = camera_components(cameras_of(env)[SENSOR])[2]
    was = component.local_pose
    component.local_pose = sapien.Pose([0.1, 0.2, 0.9])
    try:
        first, last = (placement_of(env, SENSOR, e).settings.position for e in (0, 2))
    finally:
        component.local_pose = was
    assert last == pytest.approx((0.1, 0.2, 0.9)) and first == pytest.approx(tuple(was.p))


def test_a_mounted_placement_follows_its_mount_in_every_env(env: Any) -> None:
    hand = scene_index(env).names.index("panda/panda_hand")
    poses = read_poses(env)
    x, y, _ = cube_at(env, 0)
    world = pose_from_look_at(LookAt((x, y - 0.1, 0.4), (x, y, 0.0)))
    local = relative_to(poses[0, hand], world)
    mounted = Placement(with_pose(looking(FAR_FLOOR), local), mount="panda/panda_hand")
    for e in range(N):
        there = Placement(with_pose(looking(FAR_FLOOR), compose(poses[e, hand], local)))
        from_mount, from_world = measure_placement(env, e, mounted), measure_placement(env, e, there)
        assert_array_equal(seen(from_mount, "cube").pixels, seen(from_world, "cube").pixels)


def test_a_goal_hidden_from_sensors_is_reported_as_never_drawn() -> None:
    env = built("PickCube-v1")
    sensor, people = measure_camera(env, SENSOR, 0), measure_camera(env, PEOPLE, 0, size=(128, 128))
    assert seen(sensor, "goal_site").never_drawn and seen(sensor, "goal_site").pixels[0] == 0
    assert not seen(people, "goal_site").never_drawn and seen(people, "goal_site").pixels[0] > 0
    assert [thing.name for thing in sensor.wanted_objects()] == ["cube"]
    assert {thing.name for thing in people.wanted_objects()} == {"cube", "goal_site"}
    env.close()
