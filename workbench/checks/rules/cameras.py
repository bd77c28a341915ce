"""Checks of the sensor cameras: what they see, and how they are set up."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from workbench.checks.evidence.collect import Checkup, Found, NotApplicable, Note, NotKnown
from workbench.checks.register_rule import rule
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
"""Number of resets of `Checkup.pictured` after which pictures are measured."""
MAX_OBJECTS = 30
"""Maximum number of objects that are looked for: each takes an extra picture."""
MISSED_SHARE = 0.25
"""Maximum share of the pictures in which an object may be out of view."""
BACKGROUND_SHARE = 0.5
"""Maximum share of the pixels that may be empty background."""
MAX_PIXELS = 512 * 512
"""Maximum number of pixels of a sensor camera."""
HOOKS: Mapping[CameraKind, str] = {
    "sensor": "_default_sensor_configs",
    "human": "_default_human_render_camera_configs",
}
UNIT_TOLERANCE = 1e-3
"""Maximum difference between the length of a quaternion and 1."""


@rule("camera-sees", "warn", "_default_sensor_configs")
def camera_sees(checkup: Checkup) -> Iterator[Found | Note]:
    """A sensor camera sees each object of the task, and each fixed sensor camera sees at least one object.

    The pictures do not show what a policy must act on.

    ## Why
    A policy from pictures cannot act on an object that is in none of the pictures. Training raises no error,
    and the policy learns the same action for all places of the object.

    ## Fix
    Aim the camera at the place where the objects are after a reset.

    ```python fragment
    pose = sapien_utils.look_at(eye=[0.45, 0, 0.6], target=[0.08, 0, 0])
    return [CameraConfig("base_camera", pose=pose, width=128, height=128, fov=1.0, near=0.01, far=10)]
    ```

    ## How it is checked
    Two envs are reset four times. The rule renders every sensor camera, once with the whole scene and once
    with each object alone. It reports an object that is out of view of all cameras in more than a quarter of
    the resets. It leaves out scenery, the robot, hidden bodies and bodies without visual shapes, and looks
    for at most 30 objects. It notes objects that are hidden by other bodies in every picture. It does not
    look at later steps.
    """
    reports = checkup.look(sensor_reports)
    in_view: dict[str, list[Any]] = {}
    uncovered: dict[str, list[Any]] = {}
    for report in reports.values():
        for thing in report.wanted_objects(None):
            in_view.setdefault(thing.name, []).append(np.where(thing.present, thing.alone > 0, True))
            uncovered.setdefault(thing.name, []).append(np.where(thing.present, thing.pixels > 0, True))
    if not in_view:
        raise NotApplicable("the task has no objects besides the robot and the scenery")
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
        # A single camera needs no finding of its own: each object that it misses is a finding already.
        one_of_several = len(reports) > 1 and mount_of(env, cameras_of(env)[key]) is None
        if one_of_several and not any((thing.alone > 0).any() for thing in things):
            found = True
            yield Found(
                f"Sensor camera {key[1]!r} has none of the task's objects in any picture after a reset "
                f"({listed([thing.name for thing in things])}). Aim it at them: `sapien_utils.look_at(eye=..., "
                "target=...)`, or leave it out.",
                _place(checkup, key),
            )
    if covered:
        yield Note(f"hidden by other bodies in every picture after a reset: {listed(covered)}")
    if not found and (count := len(_drawn(env))) > MAX_OBJECTS:
        raise NotKnown(f"only {MAX_OBJECTS} of {count} objects were looked for")


@rule("camera-background", "warn", "_default_sensor_configs")
def camera_background(checkup: Checkup) -> Iterator[Found | Note]:
    """At most half of the pixels of a sensor camera are empty background.

    Background pixels have depth 0, and cost memory and time for nothing.

    ## Why
    A ray that meets nothing has depth 0, which a network reads as very near. Pixels of sky cost as much
    memory and time as all others, in each of thousands of envs.

    ## Fix
    Aim the camera down at the scene.

    ```python fragment
    pose = sapien_utils.look_at(eye=[0.45, 0, 0.6], target=[0.08, 0, 0])
    ```

    ## How it is checked
    The rule uses the pictures of `camera-sees`, and reports a camera whose pictures are, on average, more
    than half empty background. It leaves out cameras that are mounted on a body.
    """
    reports = checkup.look(sensor_reports)
    env = checkup.pictured.env
    fixed = {key: report for key, report in reports.items() if mount_of(env, cameras_of(env)[key]) is None}
    if not fixed:
        raise NotApplicable("all sensor cameras are mounted on bodies")
    for key, report in fixed.items():
        share = float(report.depth.background.mean())
        if share > BACKGROUND_SHARE:
            yield Found(
                f"{share:.0%} of the picture of sensor camera {key[1]!r} is empty background, whose depth is 0. Aim it "
                "down at the scene, narrow its fov, or build a ground.",
                _place(checkup, key),
            )


@rule("camera-pose", "warn", "_default_sensor_configs")
def camera_pose(checkup: Checkup) -> Iterator[Found | Note]:
    """The quaternion of a camera has length 1.

    The picture is turned and zoomed, and extrinsics are scaled. look_at straight down or up gives a
    quaternion of length 0.707: tilt the view a little.

    ## Why
    SAPIEN does not normalise the quaternion of a camera: a shorter one turns and zooms the picture. It also
    scales the camera's matrices: points that are computed from depth are shifted, and point clouds are
    wrong without an error. ManiSkill's `look_at` gives a quaternion of length 0.707 if it looks straight up
    or down.

    ## Fix
    Move the eye aside by a millimetre.

    ```python fragment
    pose = sapien_utils.look_at(eye=[0.001, 0, 0.6], target=[0, 0, 0])
    ```

    ## How it is checked
    The rule reads the configs that `_default_sensor_configs` and `_default_human_render_camera_configs`
    return; it renders no picture. It reports a length that differs from 1 by more than 0.001. Cameras of the
    robot are left out.

    The page shows the picture that ManiSkill renders. If the page writes the pose to the file, it writes a
    unit quaternion, with which the camera looks where the call of `look_at` aims.
    """
    configs = checkup.look(hook_configs)
    robots = {config.uid for config in checkup.look(sensor_configs)[1]}
    own = {key: config for key, config in configs.items() if key[0] == "human" or key[1] not in robots}
    if not own:
        raise NotApplicable("the task has no camera of its own")
    for (kind, _), config in own.items():
        lengths = np.linalg.norm(rows_of_pose(config)[:, 3:], axis=1)
        if np.abs(lengths - 1).max() > UNIT_TOLERANCE:
            yield Found(
                f"The quaternion of camera {config.uid!r} has length {lengths[0]:.3g}: its picture is turned and zoomed, and "
                "its extrinsics are scaled. Give a unit quaternion; if look_at() looks straight up or down, move the eye "
                "aside by 0.001 m.",
                _site(checkup, config, HOOKS[kind]),
            )


@rule("camera-names", "warn", "_default_sensor_configs")
def camera_names(checkup: Checkup) -> Iterator[Found | Note]:
    """Sensor cameras of the task and of its robot have different names.

    The last camera with a name replaces the others silently.

    ## Why
    ManiSkill keeps sensor cameras in a dict by name: of two cameras with the same name it makes only the last
    one, and a camera of the robot replaces the task's. Observations lack a picture, and no error says so.

    ## Fix
    Give each camera its own name.

    ```python fragment
    return [
        CameraConfig("left_camera", pose=left, width=128, height=128, fov=1.0),
        CameraConfig("right_camera", pose=right, width=128, height=128, fov=1.0),
    ]
    ```

    ## How it is checked
    The rule compares the configs that the hooks of task and robot return; it renders no picture. A sensor
    camera and a camera for people may have the same name. The rule does not compare the names of the robot's
    own cameras with each other.
    """
    of_task, of_robot = checkup.look(sensor_configs)
    if not of_task and not of_robot:
        raise NotApplicable("the task has no sensor camera")
    robots = {config.uid for config in of_robot}
    for name, count in Counter(config.uid for config in of_task).items():
        if count > 1 or name in robots:
            config = [config for config in of_task if config.uid == name][-1]
            other = "the robot has one of that name too" if name in robots else f"{count} have that name"
            yield Found(
                f"Sensor camera {name!r}: {other}, and only the last one is made. Rename it.",
                _site(checkup, config),
            )


@rule("camera-size", "warn", "_default_sensor_configs")
def camera_size(checkup: Checkup) -> Iterator[Found | Note]:
    """A sensor camera has at most 512 x 512 pixels.

    Thousands of envs do not fit into the GPU's memory.

    ## Why
    Every env has its own textures: at 1920 x 1080 pixels, 4096 envs need far more memory than a GPU has, and
    the renderer fails when training begins.

    ## Fix
    Keep sensor cameras small, and give people a separate camera.

    ```python fragment
    return [CameraConfig("base_camera", pose=pose, width=128, height=128, fov=1.0)]
    ```

    ## How it is checked
    The rule reads the configs that `_default_sensor_configs` returns; it renders no picture. It reports more
    than 512 x 512 pixels. It does not add up several cameras.
    """
    for config in _own_configs(checkup):
        if config.width * config.height > MAX_PIXELS:
            megabytes = config.width * config.height * 16 / 1e6
            yield Found(
                f"Sensor camera {config.uid!r} has {config.width} x {config.height} pixels: its textures take about "
                f"{megabytes * 4096 / 1000:.0f} GB in 4096 envs. Use 128 x 128, and a human render camera for films.",
                _site(checkup, config),
            )


@rule("ray-traced", "warn", "_default_human_render_camera_configs")
def ray_traced(checkup: Checkup) -> Iterator[Found | Note]:
    """No camera is ray traced: shader_pack is minimal or default.

    render() of several envs raises "ray tracing shaders do not work with parallel rendering".

    ## Why
    ManiSkill renders the cameras of all envs of a GPU simulation together, and refuses ray tracing there:
    `render()` raises "ray tracing shaders do not work with parallel rendering". A ray-traced sensor cannot be
    used for training. A machine whose driver does not trace rays in hardware, such as one with Mesa's
    software driver, cannot render these pictures in a useful time.

    ## Fix
    Let the task render with `minimal` or `default`. Trace rays for a film only, with one env.

    ```python fragment
    env = gym.make("MyTask-v1", render_mode="rgb_array", human_render_camera_configs={"shader_pack": "rt"})
    ```

    ## How it is checked
    The rule reads the configs that the camera hooks of the task and its robot return; it renders no picture.
    It reports a `shader_pack` that begins with `rt`.

    On a machine that does not trace rays, the workbench renders such a camera with `default`, which has the
    same modalities. It says so when a task is opened, under the camera's name on the *Cameras* tab, and in
    recordings (`replaced_shader` of the camera in the `.json`). `workbench doctor` says whether this machine
    traces rays.
    """
    configs = checkup.look(hook_configs)
    if not configs:
        raise NotApplicable("the task has no camera")
    for (kind, name), config in configs.items():
        if is_ray_traced(str(config.shader_pack)):
            yield Found(
                f"Camera {name!r} is ray traced (shader_pack {config.shader_pack!r}), which ManiSkill refuses for several "
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
    """Evidence for `Checkup.look`: configs of all cameras (of no other sensors), as the hooks return them. Needs no
    renderer."""
    maniskill_private.mark_camera_configs()
    checkup.reset(checkup.task, checkup.seeds[0])
    with blamed("cameras", checkup.loaded, checkup.task):
        configs = maniskill_private.camera_configs(checkup.task.env)
    return {key: config for key, config in configs.items() if hasattr(config, "shader_pack")}


def sensor_reports(checkup: Checkup) -> dict[CameraKey, CameraReport]:
    """Evidence for `Checkup.look`: what each sensor camera sees after each of `RESETS` resets."""
    task = checkup.pictured
    sensors: list[CameraKey] = [key for key in cameras_of(task.env) if key[0] == "sensor"]
    if not sensors:
        raise NotApplicable("the task has no sensor camera")
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
    """The robots, the scenery and the first `MAX_OBJECTS` of the other objects."""
    scenery = [thing for thing in list_objects(env) if thing.robot or thing.scenery]
    return [*scenery, *_drawn(env)[:MAX_OBJECTS]]


def _drawn(env: Any) -> list[SceneObject]:
    """Objects that are drawn and are neither robot nor scenery. A body that only carries a camera is not
    drawn."""
    index = scene_index(env)
    return [
        thing
        for thing in list_objects(env)
        if not (thing.robot or thing.scenery)
        and any(is_drawn(entity) for e in range(env.num_envs) for entity in entities_of(thing, e, index))
    ]


def _own_configs(checkup: Checkup) -> list[Any]:
    """Configs of the task's sensor cameras. Raises NotApplicable if there are none."""
    of_task, _ = checkup.look(sensor_configs)
    if not of_task:
        raise NotApplicable("the task has no sensor camera of its own")
    return of_task


def _place(checkup: Checkup, key: CameraKey) -> Place | None:
    """The author's line that makes a sensor camera."""
    of_task, of_robot = checkup.look(sensor_configs)
    for config in (*of_task, *of_robot):
        if config.uid == key[1]:
            return _site(checkup, config)
    return checkup.places.hook("_default_sensor_configs")


def _site(checkup: Checkup, config: Any, hook: str = "_default_sensor_configs") -> Place | None:
    """The author's line that makes a config; the line of the hook if other code makes the config."""
    site = maniskill_private.camera_site(config)
    if site is None or site.file not in map(str, checkup.loaded.source_files):
        return checkup.places.hook(hook)
    return site.file, site.line, site.function.rpartition(".")[2]
