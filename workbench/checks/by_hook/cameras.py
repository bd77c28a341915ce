"""Checks of the sensor cameras: what they see, and how they are set up."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from workbench.checks.evidence.checkup import Check, Checkup, Found, NotApplicable, Note, NotKnown
from workbench.envs import maniskill_private
from workbench.envs.broken_rule import Place
from workbench.envs.camera_data import CameraKey, CameraKind
from workbench.envs.rendering.camera_shader import is_ray_traced
from workbench.envs.scene.scene_index import read_poses, scene_index
from workbench.machine.text import listed, of
from workbench.pictures.camera_report import CameraReport, join_reports
from workbench.pictures.placed_cameras import rows_of_pose
from workbench.pictures.render import cameras_of, here_without_ray_tracing, mount_of
from workbench.pictures.temporary_camera import temporary_camera
from workbench.pictures.visibility import (
    SceneObject,
    entities_of,
    is_drawn,
    list_objects,
    measure,
    placement_of,
    placement_pose,
    small_size,
)
from workbench.task.blame import blamed

RESETS = 4
"""Resets of `Checkup.pictured` whose pictures are measured."""
MOST_OBJECTS = 30
"""Objects that are looked for: each takes a picture of its own."""
MISSED_SHARE = 0.25
"""Of the pictures in which an object may be out of view."""
BACKGROUND_SHARE = 0.5
MOST_PIXELS = 512 * 512
HOOKS: Mapping[CameraKind, str] = {
    "sensor": "_default_sensor_configs",
    "human": "_default_human_render_camera_configs",
}
UNIT = 1e-3
"""Largest difference of a quaternion's length from 1."""


def camera_sees(checkup: Checkup) -> Iterator[Found | Note]:
    """Over the pictures of all sensor cameras after some resets."""
    reports = checkup.look(sensor_reports)
    in_view: dict[str, list[Any]] = {}
    uncovered: dict[str, list[Any]] = {}
    for report in reports.values():
        for thing in report.wanted_objects(None):
            in_view.setdefault(thing.name, []).append(np.where(thing.present, thing.alone > 0, True))
            uncovered.setdefault(thing.name, []).append(np.where(thing.present, thing.pixels > 0, True))
    if not in_view:
        raise NotApplicable("it has no objects besides the robot and the scenery")
    covered: list[str] = []
    found = False
    for name, of_cameras in in_view.items():
        missed = ~np.any(of_cameras, axis=0)
        if missed.mean() > MISSED_SHARE:
            found = True
            yield Found(
                f"{name} is out of view of every sensor camera ({', '.join(key[1] for key in reports)}) in "
                f"{of(int(missed.sum()), missed.size, 'picture')} after a reset. Aim one at it: "
                "`sapien_utils.look_at(eye=..., target=...)`, or widen its fov.",
                _place(checkup, next(iter(reports))),
                int(missed.sum()),
            )
        elif not np.any(uncovered[name]):
            covered.append(name)
    env = checkup.pictured.env
    for key, report in reports.items():
        things = report.wanted_objects(None)
        # Where it is the only one, each object says so.
        one_of_several = len(reports) > 1 and mount_of(env, cameras_of(env)[key]) is None
        if one_of_several and not any((thing.alone > 0).any() for thing in things):
            found = True
            yield Found(
                f"sensor camera {key[1]!r} has none of the task's objects in any picture after a reset "
                f"({listed([thing.name for thing in things])}). Aim it at them: `sapien_utils.look_at(eye=..., "
                "target=...)`, or leave it out.",
                _place(checkup, key),
            )
    if covered:
        yield Note(f"covered by other things in every picture after a reset: {listed(covered)}")
    if not found and (count := len(_drawn(env))) > MOST_OBJECTS:
        raise NotKnown(f"{MOST_OBJECTS} of {count} objects were looked for")


def camera_background(checkup: Checkup) -> Iterator[Found | Note]:
    """Over the pictures of sensor cameras that are not mounted on a body."""
    reports = checkup.look(sensor_reports)
    env = checkup.pictured.env
    fixed = {key: report for key, report in reports.items() if mount_of(env, cameras_of(env)[key]) is None}
    if not fixed:
        raise NotApplicable("its sensor cameras are mounted on bodies")
    for key, report in fixed.items():
        share = float(report.depth.background.mean())
        if share > BACKGROUND_SHARE:
            yield Found(
                f"{share:.0%} of the picture of sensor camera {key[1]!r} is empty background, whose depth is 0. Aim it "
                "down at the scene, narrow its fov, or build a ground.",
                _place(checkup, key),
            )


def camera_pose(checkup: Checkup) -> Iterator[Found | Note]:
    """The poses that the hooks return, for sensors of the task and for people."""
    configs = checkup.look(hook_configs)
    robots = {config.uid for config in checkup.look(sensor_configs)[1]}
    own = {key: config for key, config in configs.items() if key[0] == "human" or key[1] not in robots}
    if not own:
        raise NotApplicable("it has no camera of its own")
    for (kind, _), config in own.items():
        lengths = np.linalg.norm(rows_of_pose(config)[:, 3:], axis=1)
        if np.abs(lengths - 1).max() > UNIT:
            yield Found(
                f"the quaternion of camera {config.uid!r} has length {lengths[0]:.3g}: its picture is turned and zoomed, and "
                "its extrinsics are scaled. Give a unit quaternion; if look_at() looks straight up or down, move the eye "
                "aside by 0.001 m.",
                _site(checkup, config, HOOKS[kind]),
            )


def camera_names(checkup: Checkup) -> Iterator[Found | Note]:
    """The configs that the hooks of task and robot return."""
    of_task, of_robot = checkup.look(sensor_configs)
    if not of_task and not of_robot:
        raise NotApplicable("it has no sensor camera")
    robots = {config.uid for config in of_robot}
    for name, count in Counter(config.uid for config in of_task).items():
        if count > 1 or name in robots:
            config = [config for config in of_task if config.uid == name][-1]
            other = "the robot has one of that name too" if name in robots else f"{count} have that name"
            yield Found(
                f"sensor camera {name!r}: {other}, and only the last one is made. Rename it.",
                _site(checkup, config),
            )


def camera_size(checkup: Checkup) -> Iterator[Found | Note]:
    """The configs that the task's hook returns."""
    for config in _own_configs(checkup):
        if config.width * config.height > MOST_PIXELS:
            megabytes = config.width * config.height * 16 / 1e6
            yield Found(
                f"sensor camera {config.uid!r} has {config.width} x {config.height} pixels: its textures take about "
                f"{megabytes * 4096 / 1000:.0f} GB in 4096 envs. Use 128 x 128, and a human camera for films.",
                _site(checkup, config),
            )


def ray_traced(checkup: Checkup) -> Iterator[Found | Note]:
    """The configs that the hooks return, for sensors and for people."""
    configs = checkup.look(hook_configs)
    if not configs:
        raise NotApplicable("it has no camera")
    for (kind, name), config in configs.items():
        if is_ray_traced(str(config.shader_pack)):
            yield Found(
                f"camera {name!r} is ray traced (shader_pack {config.shader_pack!r}), which ManiSkill refuses for several "
                f"envs on a GPU. {here_without_ray_tracing()} For films, give shader_pack to gym.make of one env in "
                "human_render_camera_configs.".replace("  ", " "),
                _site(checkup, config, HOOKS[kind]),
            )


# --- evidence ------------------------------------------------------------------------------------------------


def sensor_configs(checkup: Checkup) -> tuple[list[Any], list[Any]]:
    """Evidence for `Checkup.look`: configs of the task's and of the robot's sensor cameras. Needs no renderer."""
    maniskill_private.mark_camera_configs()
    checkup.reset(checkup.task, checkup.seeds[0])
    with blamed("cameras", checkup.loaded, checkup.task):
        of_task, of_robot = maniskill_private.sensor_configs_of_hooks(checkup.task.env)
    return [c for c in of_task if hasattr(c, "width")], [c for c in of_robot if hasattr(c, "width")]


def hook_configs(checkup: Checkup) -> dict[CameraKey, Any]:
    """Evidence for `Checkup.look`: configs of all plain cameras, as the hooks return them. Needs no renderer."""
    maniskill_private.mark_camera_configs()
    checkup.reset(checkup.task, checkup.seeds[0])
    with blamed("cameras", checkup.loaded, checkup.task):
        configs = maniskill_private.camera_configs(checkup.task.env)
    return {key: config for key, config in configs.items() if hasattr(config, "shader_pack")}


def sensor_reports(checkup: Checkup) -> dict[CameraKey, CameraReport]:
    """Evidence for `Checkup.look`: what each sensor camera sees after each of the `RESETS`."""
    task = checkup.pictured
    sensors: list[CameraKey] = [key for key in cameras_of(task.env) if key[0] == "sensor"]
    if not sensors:
        raise NotApplicable("it has no sensor camera")
    reports: dict[CameraKey, list[CameraReport]] = {key: [] for key in sensors}
    objects = _objects(task.env)
    for first in range(0, RESETS * task.num_envs, task.num_envs):
        checkup.reset(task, checkup.seeds[0] + first)
        for key in sensors:
            for e in range(task.num_envs):
                reports[key].append(_measured(task.env, e, key, objects))
    return {key: join_reports(each) for key, each in reports.items()}


def _measured(env: Any, e: int, key: CameraKey, objects: list[SceneObject]) -> CameraReport:
    placement, index = placement_of(env, key, e), scene_index(env)
    settings = placement.settings
    pose = placement_pose(placement, read_poses(env)[e], index)
    with temporary_camera(env, e, "sensor", settings, small_size(settings.width, settings.height)) as view:
        return measure(view, pose, e, objects, index, key, settings)


def _objects(env: Any) -> list[SceneObject]:
    """Robots and scenery, and the first of the others."""
    scenery = [thing for thing in list_objects(env) if thing.robot or thing.scenery]
    return [*scenery, *_drawn(env)[:MOST_OBJECTS]]


def _drawn(env: Any) -> list[SceneObject]:
    """Objects that are neither robot nor scenery and have anything to see: a body may only carry a camera."""
    index = scene_index(env)
    return [
        thing
        for thing in list_objects(env)
        if not (thing.robot or thing.scenery)
        and any(is_drawn(entity) for e in range(env.num_envs) for entity in entities_of(thing, e, index))
    ]


def _own_configs(checkup: Checkup) -> list[Any]:
    of_task, _ = checkup.look(sensor_configs)
    if not of_task:
        raise NotApplicable("it has no sensor camera of its own")
    return of_task


def _place(checkup: Checkup, key: CameraKey) -> Place | None:
    of_task, of_robot = checkup.look(sensor_configs)
    for config in (*of_task, *of_robot):
        if config.uid == key[1]:
            return _site(checkup, config)
    return checkup.places.hook("_default_sensor_configs")


def _site(checkup: Checkup, config: Any, hook: str = "_default_sensor_configs") -> Place | None:
    """Where the author's code makes a config; else the hook."""
    site = maniskill_private.camera_site(config)
    if site is None or site.file not in map(str, checkup.loaded.source_files):
        return checkup.places.hook(hook)
    return site.file, site.line, site.function.rpartition(".")[2]


CHECKS: Mapping[str, Check] = {
    "camera-sees": camera_sees,
    "camera-background": camera_background,
    "camera-pose": camera_pose,
    "camera-names": camera_names,
    "camera-size": camera_size,
    "ray-traced": ray_traced,
}
