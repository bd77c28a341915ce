"""Measures what a camera sees of the objects of a task, for a `CameraReport`."""

from __future__ import annotations

import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import sapien.physx
import sapien.render
from mani_skill.utils.scene_builder import SceneBuilder
from mani_skill.utils.structs.base import BaseStruct
from numpy.typing import NDArray

from workbench.envs import maniskill_private
from workbench.envs.camera_data import CameraKey, CameraKind, CameraSettings, Picture
from workbench.envs.indices import require_env
from workbench.envs.scene.scene_index import SceneIndex, read_poses, scene_index
from workbench.pictures.camera_conventions import compose, matrix3, pose_of, triple
from workbench.pictures.camera_report import (
    DEPTH_EDGES_METRES,
    CameraReport,
    DepthReport,
    ObjectSeen,
    ObjectToSee,
)
from workbench.pictures.render import cameras_of, mount_of
from workbench.pictures.temporary_camera import TemporaryCamera, temporary_camera, undrawn

MEASURED_SIDE_PIXELS = 64
"""Shorter side of the measured pictures; 64 pixels are enough to compare placements."""


@dataclass(frozen=True)
class SceneObject:
    """One object of the task, with its bodies."""

    name: str
    """Name of an actor or an articulation."""
    bodies: tuple[int, ...]
    """Columns of the scene's index: one for an actor, one for each link of an articulation."""
    robot: bool
    scenery: bool
    """Whether the object is the ground, a static body, or a kinematic body made by a scene builder of
    ManiSkill (such as a table)."""
    hidden: bool
    """Whether the task hides the object from the sensors."""


@dataclass(frozen=True)
class Placement:
    """Settings, kind and mount of a camera that need not exist in the env."""

    settings: CameraSettings
    kind: CameraKind = "sensor"
    mount: str | None = None
    """Name of the body in whose frame the pose in `settings` is given; None for the env's frame."""
    name: str = "suggested"


def list_objects(env: Any) -> tuple[SceneObject, ...]:
    """The objects of a scene: its actors, then its articulations."""
    index = scene_index(env)
    robots = {agent.robot.name for agent in maniskill_private.agents(env)}
    built = _built_by_scene_builders(env)
    members: dict[tuple[bool, str], list[int]] = {}
    for body, (owner, kind) in enumerate(zip(index.owners, index.kinds, strict=True)):
        members.setdefault((kind == "link", owner), []).append(body)
    found = []
    for (linked, name), bodies in members.items():
        entities = [e for e in index.entities[:, bodies].ravel() if e is not None]
        kinds = {index.kinds[body] for body in bodies}
        found.append(
            SceneObject(
                name=name,
                bodies=tuple(bodies),
                robot=linked and name in robots,
                scenery=name == "ground"
                or kinds == {"static"}
                # Scene builders also place objects that are to be picked up, so only kinematic and static
                # bodies count as scenery.
                or (kinds <= {"kinematic", "static"} and all(id(entity) in built for entity in entities)),
                hidden=all(index.hidden[body] for body in bodies),
            )
        )
    return tuple(found)


def objects_to_see(env: Any) -> tuple[ObjectToSee, ...]:
    """The task's objects without scenery, then its robots, as plain data."""
    names, objects = scene_index(env).names, list_objects(env)
    seen = tuple(
        ObjectToSee(
            thing.name,
            thing.hidden,
            tuple(names[body] for body in thing.bodies) if len(thing.bodies) > 1 else (),
        )
        for thing in objects
        if not (thing.robot or thing.scenery)
    )
    robots = [thing for thing in objects if thing.robot]
    return seen + tuple(ObjectToSee(t.name, False, _links_from_the_hand(env, t), True) for t in robots)


def _links_from_the_hand(env: Any, robot: SceneObject) -> tuple[str, ...]:
    """Names of a robot's drawn links: its hand, then the others by increasing distance from the tool centre
    point.

    In ManiSkill's agents with a hand, the tool centre point is the link ``tcp``; the hand is the drawn link
    that carries ``tcp``, even if the fingers are nearer to ``tcp``. Without a ``tcp``, the links are in
    reverse order, the last one first.
    """
    names, entities = scene_index(env).names, scene_index(env).entities[0]
    drawn = [body for body in reversed(robot.bodies) if is_drawn(entities[body])]
    agents = [agent for agent in maniskill_private.agents(env) if agent.robot.name == robot.name]
    tools = [maniskill_private.tool_of(agent) for agent in agents]
    name = f"{robot.name}/{getattr(tools[0], 'name', '')}" if tools else ""
    if name in names:
        places = read_poses(env)[0, :, :3]
        tool = names.index(name)
        hand = _carrier(entities[tool])
        drawn.sort(key=lambda body: float(np.linalg.norm(places[body] - places[tool])))
        drawn.sort(key=lambda body: entities[body] is not hand)
    return tuple(names[body] for body in drawn)


def _carrier(entity: Any) -> Any:
    """This link if it is drawn, else the nearest drawn link towards the root; None if there is none."""
    while entity is not None and not is_drawn(entity):
        link = entity.find_component_by_type(sapien.physx.PhysxArticulationLinkComponent)
        parent = None if link is None else link.parent
        entity = None if parent is None else parent.entity
    return entity


def is_drawn(entity: Any) -> bool:
    """Whether a ``sapien.Entity`` has anything that cameras see."""
    body = None if entity is None else entity.find_component_by_type(sapien.render.RenderBodyComponent)
    return body is not None and len(body.render_shapes) > 0


def placement_of(env: Any, camera: CameraKey, e: int, settings: CameraSettings | None = None) -> Placement:
    """The placement of a camera in one env: its present settings, or `settings` (in the mount's frame).

    Raises:
        ValueError: there is no such camera.
        IndexError: there is no such env.
    """
    cameras = cameras_of(env)
    if camera not in cameras:
        there = ", ".join(f"{name} ({kind})" for kind, name in cameras) or "none"
        raise ValueError(f"there is no {camera[0]} camera {camera[1]!r} to report on; there are: {there}")
    require_env(e, env.num_envs)
    found, (kind, name) = cameras[camera], camera
    return Placement(settings or present_settings(found, e), kind, mount_of(env, found), name)


def measure_placement(
    env: Any,
    e: int,
    placement: Placement,
    poses: NDArray[np.float32] | None = None,
    size: tuple[int, int] | None = None,
) -> CameraReport:
    """Report what a camera, which need not exist, sees in one env.

    Args:
        poses: (B, 7) where to draw the bodies, as `read_poses` returns them; None for their present poses.
        size: width and height of the measured pictures (see `small_size`); None for the camera's own size.

    Raises:
        ValueError: the lens is not valid, or there is no such mount.
        IndexError: there is no such env.
        RuntimeError: the renderer failed.
    """
    index = scene_index(env)
    pose = placement_pose(placement, read_poses(env)[e] if poses is None else poses, index)
    with temporary_camera(env, e, placement.kind, placement.settings, size, poses) as view:
        camera = placement.kind, placement.name
        return measure(view, pose, e, list_objects(env), index, camera, placement.settings)


def picture_of(
    env: Any,
    e: int,
    placement: Placement,
    poses: NDArray[np.float32] | None = None,
    size: tuple[int, int] | None = None,
) -> Picture:
    """A picture from a camera that need not exist; arguments and errors as for `measure_placement`."""
    pose = placement_pose(placement, read_poses(env)[e] if poses is None else poses, scene_index(env))
    with temporary_camera(env, e, placement.kind, placement.settings, size, poses) as view:
        segmentation, depth = view.look(pose)
        rgb = view.colours()
    return Picture("suggested", placement.kind, e, pose.astype(np.float32), rgb, depth, segmentation)


def present_settings(camera: Any, env_index: int) -> CameraSettings:
    """Present settings of one env's camera (from `cameras_of`), with the lens as an intrinsic matrix."""
    component = maniskill_private.camera_components(camera)[env_index]
    local = component.local_pose
    qw, qx, qy, qz = map(float, local.q)
    return CameraSettings(
        position=triple(local.p),
        quaternion=(qw, qx, qy, qz),
        fov=None,
        intrinsic=matrix3(component.get_intrinsic_matrix()),
        width=component.width,
        height=component.height,
        near=float(component.near),
        far=float(component.far),
        shader_pack=camera.config.shader_config.shader_pack,
    )


def small_size(width: int, height: int, shorter: int = MEASURED_SIDE_PIXELS) -> tuple[int, int]:
    """Width and height, shrunk so that the shorter side has at most `shorter` pixels; keeps the aspect ratio
    approximately."""
    scale = min(1.0, shorter / min(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))


# --- measuring ---------------------------------------------------------------------------------------------------


def placement_pose(
    placement: Placement, bodies: NDArray[np.float32], index: SceneIndex
) -> NDArray[np.float64]:
    """(7,) pose of a placement in the env's frame, with bodies at `bodies` (B, 7)."""
    if placement.mount is None:
        # Not normalised: with a quaternion that is not of unit length, SAPIEN draws a different picture.
        return np.array([*placement.settings.position, *placement.settings.quaternion])
    mount = bodies[mount_column(index, placement.mount)]
    if not np.isfinite(mount).all():
        raise ValueError(f"this env has no body {placement.mount!r} to mount a camera on")
    return compose(mount, pose_of(placement.settings))


def mount_column(index: SceneIndex, name: str) -> int:
    """Column of the body with this name."""
    if name not in index.names:
        raise ValueError(f"there is no body {name!r} to mount a camera on")
    return index.names.index(name)


def measure(
    view: TemporaryCamera,
    pose: NDArray,
    e: int,
    objects: Sequence[SceneObject],
    index: SceneIndex,
    camera: CameraKey,
    settings: CameraSettings,
    bare: CameraReport | None = None,
) -> CameraReport:
    """Render pictures and count pixels; returns the report of one env.

    Bounding boxes and frustums ignore occlusion, so pictures are rendered: one of the whole scene, whose
    segmentation gives each pixel's object; one without the robot, to find what the robot covers; and one of
    each object alone, to find what the border cuts and what other things cover. Only the first is slow, since
    the robot's meshes are nearly all of a picture's cost (30 ms with a Panda on a software driver, 2 ms
    without). If the camera is a sensor, an object that the
    task hides from sensors counts as never drawn.

    Args:
        settings: settings of the camera; pixel counts are scaled to its size, since `view` may be smaller.
        bare: the report from this pose without the robot; if it is given, only the whole scene is rendered.
    """
    began = time.perf_counter()
    shown = [thing for thing in objects if not (thing.robot or thing.name == "ground")]
    ids = [{entity.per_scene_id for entity in entities_of(thing, e, index)} for thing in shown]
    segmentation, depth = view.look(pose)
    height, width = segmentation.shape
    scale = np.float32(settings.width * settings.height / (width * height))
    # For a few ids, `_mask` is ten times faster than np.isin; a search measures hundreds of pictures.
    here = set(np.unique(segmentation).tolist())
    pixels = [_one(_mask(segmentation, here & own).sum()) * scale for own in ids]
    robot = [entity for thing in objects if thing.robot for entity in entities_of(thing, e, index)]
    pictures = 1
    if bare is not None:
        found = [replace(thing, pixels=count) for thing, count in zip(bare.objects, pixels, strict=True)]
    else:
        without = segmentation
        if here & {entity.per_scene_id for entity in robot}:
            with undrawn(robot):
                without, _ = view.look(pose)
            pictures += 1
        found, left = [], set(np.unique(without).tolist())
        for thing, own, count in zip(shown, ids, pixels, strict=True):
            never_drawn = thing.hidden and camera[0] == "sensor"
            alone = mask = _mask(without, left & own)
            if not (thing.scenery or never_drawn):
                with undrawn([x for x in index.entities[e] if x is not None and x.per_scene_id not in own]):
                    alone = view.look(pose)[0] != 0
                pictures += 1
            margin = _one(_margin(alone))
            found.append(
                ObjectSeen(
                    name=thing.name,
                    never_drawn=never_drawn,
                    scenery=thing.scenery,
                    present=np.array([bool(own)]),
                    pixels=count,
                    unhindered=_one(mask.sum()) * scale,
                    alone=_one(alone.sum()) * scale,
                    cut=alone.any() & (margin == 0),
                    margin=margin,
                )
            )
    counted = {entity.per_scene_id for entity in robot}.union(
        *(own for thing, own in zip(shown, ids, strict=True) if not thing.scenery)
    )
    return CameraReport(
        camera=camera,
        size=(settings.width, settings.height),
        measured_size=(width, height),
        envs=(e,),
        objects=tuple(found),
        depth=_depths(depth, segmentation != 0, _mask(segmentation, here & counted)),
        pictures=pictures,
        milliseconds=1000 * (time.perf_counter() - began),
    )


def _depths(
    depth: NDArray[np.float32], something: NDArray[np.bool_], counts: NDArray[np.bool_]
) -> DepthReport:
    """Depth report of one picture (H, W). Two masks: `something` is all but the background; `counts` is robot
    and objects."""
    far, of_objects = depth[something], depth[counts]
    limit = float(of_objects.max()) if len(of_objects) else np.nan
    histogram, _ = np.histogram(
        np.clip(far, DEPTH_EDGES_METRES[0], DEPTH_EDGES_METRES[-1]), DEPTH_EDGES_METRES
    )
    return DepthReport(
        counts=histogram.astype(np.int64)[None],
        background=_one(1 - something.mean()),
        # If neither robot nor objects are in view, everything counts as beyond them.
        beyond=_one((far > np.nan_to_num(limit, nan=-1.0)).sum() / depth.size),
        nearest=_one(far.min() if len(far) else np.nan),
        farthest_object=_one(limit),
    )


def entities_of(thing: SceneObject, e: int, index: SceneIndex) -> list[Any]:
    """The ``sapien.Entity`` of each body of an object, without bodies that env `e` does not have."""
    return [entity for entity in index.entities[e, list(thing.bodies)] if entity is not None]


def _mask(segmentation: NDArray[np.int32], numbers: Collection[int]) -> NDArray[np.bool_]:
    mask = np.zeros(segmentation.shape, bool)
    for number in numbers:
        mask |= segmentation == number
    return mask


def _one(number: Any) -> NDArray[np.float32]:
    return np.array([number], np.float32)


def _margin(mask: NDArray[np.bool_]) -> float:
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return 0.0
    height, width = mask.shape
    least = min(rows[0], height - 1 - rows[-1], columns[0], width - 1 - columns[-1])
    return float(least) / min(width, height)


def _built_by_scene_builders(env: Any) -> set[int]:
    """``id`` of every entity that the env's ManiSkill scene builders made: tables and rooms."""
    entities: set[int] = set()
    for builder in vars(env).values():
        if not isinstance(builder, SceneBuilder):
            continue
        listed: Any = getattr(builder, "scene_objects", None) or ()
        things: Collection[Any] = listed.values() if isinstance(listed, dict) else listed
        for thing in things:
            # The builder of ManiSkill's planar worlds lists an ActorBuilder too.
            if isinstance(thing, BaseStruct):
                entities.update(id(entity) for entity in maniskill_private.objects_of(thing))
    return entities
