"""Renders chosen cameras of one env."""

from __future__ import annotations

import linecache
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import sapien
import sapien.render
import torch
from numpy.typing import NDArray

from workbench.envs import maniskill_private
from workbench.envs.backends import why_no_ray_tracing
from workbench.envs.camera_data import CameraInfo, CameraKey, CameraKind, Picture, PictureDegree
from workbench.envs.cpu_scene import BatchedCpuScene
from workbench.envs.gpu_rules import Finding
from workbench.envs.indices import require_env
from workbench.envs.rendering.camera_shader import replaced_shader
from workbench.envs.rendering.drawing import drawing, read_texture
from workbench.envs.scene.scene_index import hidden_poses, scene_index
from workbench.envs.simulation.drawn_poses import NOWHERE_ELSE, Places, drawn_at, temporarily
from workbench.envs.simulation.hiding import shown_visibility
from workbench.envs.task_env import TaskEnv
from workbench.pictures.placed_cameras import rows_of_pose, settings_of

_MODALITIES = ("rgb", "depth", "segmentation", "position", "normal", "albedo")
_MAX_INT16_METRES = 32.767
"""Largest coordinate that the minimal shader can write, as int16 millimetres."""

KINDS: tuple[CameraKind, ...] = ("sensor", "human")
Request = tuple[str, CameraKind, Sequence[str]]
"""Name, kind and modalities of a requested picture."""


def list_cameras(env: Any) -> tuple[CameraInfo, ...]:
    """All cameras of a ManiSkill env: its sensors (the robot's too), then its human render cameras.

    Empty without a render device. Stereo cameras and sensor classes of the task are left out.
    """
    infos = []
    for (kind, name), camera in cameras_of(env).items():
        components = maniskill_private.camera_components(camera)
        component = components[0]
        gives = {m for modalities in camera.config.shader_config.texture_names.values() for m in modalities}
        infos.append(
            CameraInfo(
                name=name,
                kind=kind,
                width=component.width,
                height=component.height,
                fovy=float(component.fovy),
                near=float(component.near),
                far=float(component.far),
                intrinsic=np.array(component.get_intrinsic_matrix(), dtype=np.float32),
                mount=mount_of(env, camera),
                modalities=tuple(m for m in _MODALITIES if m in gives),
                settings=settings_of(camera.config),
                varies=_varies(camera.config, components),
                site=maniskill_private.camera_site(camera.config),
                replaced_shader=replaced_shader(camera.config),
            )
        )
    return tuple(infos)


def findings_of_shaders(cameras: Iterable[CameraInfo]) -> list[Finding]:
    """One finding for each camera whose shader is replaced, at the line where its config is made."""
    found = []
    for camera in cameras:
        if not camera.replaced_shader:
            continue
        message = f"camera {camera.name!r} is ray traced (shader_pack {camera.replaced_shader!r}). {here_without_ray_tracing()}"
        site = camera.site
        at = (None, None, "", "")
        if site is not None:
            code = linecache.getline(site.file, site.line).strip()
            at = (site.file, site.line, code, site.function.rpartition(".")[2])
        found.append(Finding("ray-traced", "warn", message, *at, 1, 0))
    return found


def here_without_ray_tracing() -> str:
    """What this machine does with ray traced cameras, as a sentence; empty if it can trace rays."""
    why = why_no_ray_tracing()
    if why is None:
        return ""
    return f"Ray tracing needs a GPU driver that supports it, and {why}: here the camera renders with shader_pack 'default'."


def segmentation_names(env: Any) -> dict[int, str]:
    """Body name of every id in a segmentation picture, except 0, the background.

    Ids count the entities of a sub-scene, so they are the same in all envs that are built from the same parts.
    If an id stands for different bodies in different envs, its name is ``a | b``.
    """
    index = scene_index(env)
    names: dict[int, list[str]] = {}
    for row in index.entities:
        for entity, name in zip(row, index.names, strict=True):
            if entity is not None:
                known = names.setdefault(int(entity.per_scene_id), [])
                if name not in known:
                    known.append(name)
    return {number: " | ".join(known) for number, known in names.items()}


def take_pictures(
    env: Any,
    env_index: int,
    requests: Sequence[Request],
    poses: NDArray[np.float32] | None = None,
    degree: PictureDegree | None = None,
) -> tuple[Picture, ...]:
    """Render the requested cameras of env `env_index`, in the order of `requests`.

    ManiSkill renders all cameras of all envs or none, 50 ms a picture on a software driver. Here only the requested
    cameras are rendered, from the env's own sub-scene, with ManiSkill's shaders and texture transforms.

    Args:
        poses: (B, 7) where to draw the env's bodies, as `read_poses` returns them; None for where they are. Only the
            render bodies are moved, so a past moment can be rendered without changing the simulation. A
            camera moves with its mount; colours and lights are the present ones.
        degree: None for the degree that the env was made with. Only a batch on the CPU can draw fast
            pictures; all other envs draw exact ones.

    Raises:
        IndexError: there is no such env.
        ValueError: there is no such camera, or it cannot give the requested modalities.
        CannotDraw: the renderer failed; the exception is a RuntimeError.
    """
    pictures: dict[int, Picture] = {}
    for kind in KINDS:
        chosen = [i for i, request in enumerate(requests) if request[1] == kind]
        begun = begin_pictures(env, env_index, [requests[i] for i in chosen], poses, degree)
        pictures.update(zip(chosen, begun.finish(), strict=True))
    return tuple(pictures[i] for i in range(len(requests)))


@dataclass(frozen=True)
class PendingPictures:
    """Pictures that the renderer is drawing; see `begin_pictures`."""

    _taken: tuple[
        tuple[Any, Any, str, CameraKind, int, tuple[str, ...], NDArray[np.float32], PictureDegree], ...
    ]

    def finish(self) -> tuple[Picture, ...]:
        """Wait until the renderer is done; returns the pictures in the order of the requests."""
        return tuple(_read(*taken) for taken in self._taken)


def begin_pictures(
    env: Any,
    env_index: int,
    requests: Sequence[Request],
    poses: NDArray[np.float32] | None = None,
    degree: PictureDegree | None = None,
) -> PendingPictures:
    """Start rendering the requested cameras, and return at once.

    SAPIEN submits a picture to the driver in 0.05 ms, and waits only when the picture is read. Meanwhile a
    GPU, or the threads of a software driver, draw it, and the simulation can continue. (Measured on two cores
    with lavapipe: 26 control steps of 16 envs took 151 ms while a picture was drawn; without steps, the
    picture takes 51 ms.) The scene is drawn in its present state; do not close it or render another camera
    before `finish`.

    Args:
        requests: all of one kind, since sensors and human cameras see different objects.
        poses, degree: as in `take_pictures`.

    Raises:
        As `take_pictures`.
    """
    require_env(env_index, env.num_envs)
    kinds = {kind for _, kind, _ in requests}
    if len(kinds) > 1:
        raise ValueError("pictures of sensors and of human cameras cannot be rendered together")
    cameras = cameras_of(env)
    for name, kind, modalities in requests:
        _check(name, kind, modalities, cameras)
    if not requests:
        return PendingPictures(())
    scene = env.scene
    if scene.gpu_sim_enabled:
        scene.px.sync_poses_gpu_to_cpu()
    sub_scene = scene.sub_scenes[env_index]
    taken = []
    components = [
        maniskill_private.camera_components(cameras[kind, name])[env_index] for name, kind, _ in requests
    ]
    places = places_to_draw(env, env_index, poses)
    with (
        show_hidden_objects(env, env_index, shown=kinds == {"human"}),
        drawn_at(places, components) as move_bodies,
    ):
        batched = scene if isinstance(scene, BatchedCpuScene) else None
        needed = [_textures(cameras[kind, name], modalities) for name, kind, modalities in requests]
        degrees = [_degree_of(scene, component, degree) for component in components]
        for (name, kind, _), textures, drawn in zip(requests, needed, degrees, strict=True):
            if batched is not None and drawn == "fast":
                batched.prepare_fast(env_index, (kind, name), textures, places)
        sub_scene.update_render()
        move_bodies()
        each = zip(requests, components, needed, degrees, strict=True)
        for (name, kind, modalities), component, textures, drawn in each:
            drawn_by = component
            with drawing((kind, name), maniskill_private.camera_site(cameras[kind, name].config)):
                if batched is None:
                    component.take_picture()
                else:
                    drawn_by = batched.take_picture(env_index, (kind, name), component, textures, degree)
            pose = component.get_global_pose()
            where = np.array([*pose.p, *pose.q], dtype=np.float32)
            taken.append(
                (cameras[kind, name], drawn_by, name, kind, env_index, tuple(modalities), where, drawn)
            )
    return PendingPictures(tuple(taken))


def _degree_of(scene: Any, component: Any, asked: PictureDegree | None = None) -> PictureDegree:
    """Degree in which a picture is drawn if `asked` is requested; exact unless the env is a CPU batch."""
    return scene.degree_of(component, asked) if isinstance(scene, BatchedCpuScene) else "exact"


def _textures(camera: Any, modalities: Sequence[str]) -> set[str]:
    """Textures of the camera's shader that contain the modalities."""
    of = camera.config.shader_config.texture_names
    return {texture for texture, gives in of.items() if set(gives) & set(modalities)}


def places_to_draw(env: Any, env_index: int, poses: NDArray[np.float32] | None) -> Places:
    """Entities of an env, each with its pose in `poses`; call this before objects are shown or hidden.

    Args:
        poses: as in `take_pictures`.
    """
    if poses is None:
        return NOWHERE_ELSE
    each = zip(scene_index(env).entities[env_index], poses, strict=True)
    return {id(entity): (entity, pose) for entity, pose in each if np.isfinite(pose).all()}


def cameras_of(env: Any) -> dict[CameraKey, Any]:
    """The cameras of an env, without stereo cameras and sensor classes of the task."""
    return {
        key: camera
        for key, camera in maniskill_private.cameras(env).items()
        if maniskill_private.camera_components(camera)
    }


def _varies(config: Any, components: Sequence[Any]) -> bool:
    """Whether the poses differ between envs, or are not those of the config."""
    configured = rows_of_pose(config)
    real = np.array([[*c.local_pose.p, *c.local_pose.q] for c in components])
    return bool((configured != configured[:1]).any() or np.abs(real - configured[:1]).max() > 1e-5)


def mount_of(env: Any, camera: Any) -> str | None:
    """Name of the body that a camera is mounted on; `camera` is from `cameras_of`."""
    mount = camera.camera.mount
    return None if mount is None else scene_index(env).name_of(maniskill_private.objects_of(mount)[0])


def _check(name: str, kind: str, modalities: Sequence[str], cameras: dict[CameraKey, Any]) -> None:
    camera = cameras.get((kind, name))  # type: ignore[call-overload]
    if camera is None:
        there = ", ".join(f"{n} ({k})" for k, n in cameras) or "none"
        raise ValueError(f"there is no {kind} camera {name!r} to take a picture with; there are: {there}")
    gives = {m for ms in camera.config.shader_config.texture_names.values() for m in ms}
    for modality in modalities:
        if modality not in _MODALITIES:
            raise ValueError(f"{modality!r} cannot be shown; choose from {', '.join(_MODALITIES)}")
        if modality not in gives:
            pack = camera.config.shader_config.shader_pack
            raise ValueError(f"camera {name!r} gives no {modality} with the shader pack {pack!r}")


@contextmanager
def show_hidden_objects(env: Any, env_index: int, shown: bool) -> Iterator[None]:
    """Context in which the task's hidden objects are drawn in this env if `shown`, else are not drawn.

    ManiSkill hides ``_hidden_objects`` from sensors and shows them to human cameras: on the CPU by
    visibility, in GPU simulation by moving the object 99999 m away. Here visibility is used. An object that
    was moved away is put back for human cameras, and stays where it is for sensors: if other code has moved
    it back into view, sensors see it here too, as the policy does. Visibility and poses are restored
    afterwards, so a picture does not change the simulation.
    """
    slot_of = scene_index(env).slot_of
    true = (
        {slot: pose for rows in hidden_poses(env) for slot, pose in zip(*rows, strict=True)} if shown else {}
    )
    changes: list[tuple[Any, str, Any]] = []
    actors = maniskill_private.hidden_objects(env)
    for actor in actors:
        moved_away = maniskill_private.pose_before_hiding(actor) is not None
        for entity, env_of in zip(
            maniskill_private.objects_of(actor), maniskill_private.envs_of(actor), strict=True
        ):
            body = entity.find_component_by_type(sapien.render.RenderBodyComponent)
            if env_of != env_index or body is None:
                continue
            if shown:
                changes.append((body, "visibility", shown_visibility(actors, body)))
            elif not moved_away:
                changes.append((body, "visibility", 0.0))
            pose = true.get(slot_of[id(entity)]) if id(entity) in slot_of else None
            if pose is not None:
                changes.append((entity, "pose", sapien.Pose(pose[:3], pose[3:])))
    with temporarily(changes):
        yield


def _read(
    camera: Any,
    component: Any,
    name: str,
    kind: CameraKind,
    env_index: int,
    modalities: tuple[str, ...],
    pose: NDArray[np.float32],
    degree: PictureDegree,
) -> Picture:
    config = camera.config.shader_config
    made: dict[str, torch.Tensor] = {}
    depth = None
    for texture, gives in config.texture_names.items():
        if not set(gives) & set(modalities):
            continue
        data = read_texture(component, texture, (kind, name), maniskill_private.camera_site(camera.config))
        transformed = config.texture_transforms[texture](torch.from_numpy(data)[None])
        made.update({m: image[0] for m, image in transformed.items() if m in modalities})
        if "depth" in gives and "depth" in modalities:
            depth = depth_in_metres(texture, data, made["depth"].numpy()[..., 0], component)
    segmentation, position, normal = (made.get(m) for m in ("segmentation", "position", "normal"))
    return Picture(
        camera=name,
        kind=kind,
        env=env_index,
        pose=pose,
        rgb=np.ascontiguousarray(made["rgb"].numpy()) if "rgb" in made else None,
        depth=depth,
        segmentation=None if segmentation is None else segmentation.numpy()[..., 0].astype(np.int32),
        position=None if position is None else position.numpy().astype(np.float32) / np.float32(1000.0),
        normal=None if normal is None else np.ascontiguousarray(normal.numpy(), dtype=np.float32),
        albedo=np.ascontiguousarray(made["albedo"].numpy()) if "albedo" in made else None,
        degree=degree,
    )


def depth_in_metres(texture: str, data: NDArray, transformed: NDArray, component: Any) -> NDArray[np.float32]:
    """(H, W) depth in metres, 0 for background; `transformed` is ManiSkill's reading of the texture `data`.

    ManiSkill's standard is int16 millimetres. Where the texture holds float positions in metres, as
    in the default and ray tracing shaders, they are used directly. The minimal shader's texture is
    int16 itself: depth beyond 32.767 m is clamped to -32768 (measured on lavapipe; a driver may
    also wrap around) and is therefore read from the depth buffer.
    """
    if texture == "Position" and np.issubdtype(data.dtype, np.floating):
        # A background of -0.0 would be printed as "-0.0 m".
        return -data[..., 2] + np.float32(0.0)
    if np.issubdtype(transformed.dtype, np.floating):
        return transformed.astype(np.float32)
    depth = transformed.astype(np.float32) / np.float32(1000.0)
    beyond = (depth < 0.0) | (depth >= _MAX_INT16_METRES)
    if beyond.any():
        # Vulkan's depth in 0..1 of a perspective camera: z = f (1 - n / d) / (f - n).
        buffer = component.get_picture("GbufferDepth")
        z = buffer.reshape(*depth.shape, -1)[..., 0][beyond].astype(np.float64)
        near, far = float(component.near), float(component.far)
        depth[beyond] = near / np.maximum(1.0 - z * (far - near) / far, near / far)
    return depth


# --- pictures of a step ------------------------------------------------------------------------------


def recorded_pictures(cameras: Iterable[CameraInfo]) -> tuple[Request, ...]:
    """The pictures that an episode keeps: rgb, depth and segmentation of a sensor, rgb of a human camera."""
    asked = []
    for camera in cameras:
        wanted = ("rgb", "depth", "segmentation") if camera.kind == "sensor" else ("rgb",)
        kept = tuple(modality for modality in wanted if modality in camera.modalities)
        asked.append((camera.name, camera.kind, kept))
    return tuple(asked)


def step_pictures(task: TaskEnv, env_idx: Sequence[int], requests: Sequence[Request]) -> list[Picture]:
    """Pictures of the last observed state by the requested cameras, env by env.

    A picture takes 25 to 50 ms on a software renderer, so pictures in the observation are reused: they equal
    rendered pictures (tested), except that depth (millimetres) and segmentation are ManiSkill's int16.
    Pictures are rendered only if they are not in the observation, if they have depth beyond 32.767 m, or if
    their shader is more precise than millimetres. Raises as `take_pictures`.
    """
    if not requests:
        return []
    seen = [_observed(task, env_idx, request) for request in requests]
    drawn = [request for request, found in zip(requests, seen, strict=True) if found is None]
    pictures: list[Picture] = []
    for at, env in enumerate(env_idx):
        made = iter(take_pictures(task.env, env, drawn) if drawn else ())
        pictures += [next(made) if found is None else found[at] for found in seen]
    return pictures


def _observed(task: TaskEnv, env_idx: Sequence[int], request: Request) -> list[Picture] | None:
    """One picture of each env, from the env's last observation; None if the pictures must be rendered."""
    name, kind, modalities = request
    seen: Any = task.obs.get("sensor_data", {}) if isinstance(task.obs, Mapping) else {}
    images = seen.get(name) if kind == "sensor" else None
    if not isinstance(images, Mapping) or not modalities or not set(modalities) <= set(images):
        return None
    camera: Any = maniskill_private.cameras(task.env).get(("sensor", name))
    if camera is None or not (components := maniskill_private.camera_components(camera)):
        return None
    if camera.config.shader_config.shader_pack != "minimal":
        return None
    rows = {modality: images[modality][list(env_idx)].numpy(force=True) for modality in modalities}
    depth, segmentation = rows.get("depth"), rows.get("segmentation")
    if depth is not None and (depth.dtype != np.int16 or depth.min() < 0):
        return None
    scene: Any = task.env.scene
    if scene.gpu_sim_enabled:
        scene.px.sync_poses_gpu_to_cpu()
    found = []
    for at, env in enumerate(env_idx):
        pose = components[env].get_global_pose()
        found.append(
            Picture(
                camera=name,
                kind="sensor",
                env=env,
                pose=np.array([*pose.p, *pose.q], dtype=np.float32),
                rgb=None if "rgb" not in rows else rows["rgb"][at],
                depth=None if depth is None else depth[at, ..., 0],
                segmentation=None if segmentation is None else segmentation[at, ..., 0],
                degree=_degree_of(scene, components[env]),
            )
        )
    return found
