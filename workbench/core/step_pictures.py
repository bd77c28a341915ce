"""The pictures that belong to a step, out of the observation where it has them already.

A task that observes pictures (``obs_mode="rgb+depth"`` and the like) has drawn its sensors for this very step, and a
picture takes 25 to 50 ms on a software renderer: a recording that draws them again would take twice as long as the
episode. So what the observation holds is taken from there, and only the rest is drawn. Both are the same picture (tested),
with two exceptions that are drawn: depth that does not fit into ManiSkill's whole millimetres, which end at 32.767 m, and
shaders that give more than millimetres.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from workbench.core import seams
from workbench.core.drawn_poses import NOWHERE_ELSE, Places, camera_pose
from workbench.core.pictures import Picture
from workbench.core.take_pictures import Request, cameras_of, take_pictures
from workbench.core.task_env import TaskEnv


def step_pictures(task: TaskEnv, env_index: int, requests: Sequence[Request]) -> tuple[Picture, ...]:
    """Pictures of the cameras that are asked for, of the state that was observed last. Raises as `take_pictures`."""
    found = {i: _observed(task, env_index, request) for i, request in enumerate(requests)}
    drawn = [i for i, picture in found.items() if picture is None]
    made = take_pictures(task.env, env_index, [requests[i] for i in drawn]) if drawn else ()
    found.update(zip(drawn, made, strict=True))
    return tuple(picture for picture in found.values() if picture is not None)


@dataclass(frozen=True)
class Seen:
    """What a sensor saw in all envs, as the observation has it; copies."""

    camera: str
    poses: NDArray[np.float32]
    """(N, 7) as in a `Picture`."""
    images: dict[str, NDArray]
    """(N, H, W, 3) uint8 rgb, (N, H, W) depth in whole millimetres, none below 0, (N, H, W) segmentation; by modality."""


def observed_pictures(task: TaskEnv, requests: Sequence[Request]) -> list[Seen] | None:
    """What is asked for, out of the last observation; None where some of it is not there and must be drawn.

    For envs on the CPU. A conversion of every picture at every step takes longer than copying them all, and
    whoever encodes them can do without."""
    seen: list[Seen] = []
    cameras = cameras_of(task.env) if requests else {}
    elsewhere = _elsewhere(task, range(task.num_envs)) if requests else {}
    for name, kind, modalities in requests:
        images = _images(task, name, kind, modalities)
        camera = cameras.get(("sensor", name))
        if images is None or camera is None or camera.config.shader_config.shader_pack != "minimal":
            return None
        depth = images.get("depth")
        if depth is not None and (depth.dtype != torch.int16 or bool(depth.min() < 0)):
            return None
        components = seams.camera_components(camera)
        assert components is not None, "`cameras_of` names no others"
        poses = [camera_pose(c, elsewhere.get(env, NOWHERE_ELSE)) for env, c in enumerate(components)]
        held = {modality: image.numpy().copy() for modality, image in images.items()}
        seen.append(
            Seen(
                name,
                np.array([[*pose.p, *pose.q] for pose in poses], dtype=np.float32),
                {modality: image if modality == "rgb" else image[..., 0] for modality, image in held.items()},
            )
        )
    return seen


def _images(
    task: TaskEnv, name: str, kind: str, modalities: Sequence[str]
) -> Mapping[str, torch.Tensor] | None:
    seen: Any = task.obs.get("sensor_data", {}) if isinstance(task.obs, Mapping) else {}
    images = seen.get(name) if kind == "sensor" else None
    if not isinstance(images, Mapping) or not modalities or not set(modalities) <= set(images):
        return None
    return {modality: images[modality] for modality in modalities}


def _observed(task: TaskEnv, env_index: int, request: Request) -> Picture | None:
    name, kind, modalities = request
    images = _images(task, name, kind, modalities)
    if images is None:
        return None
    camera = cameras_of(task.env).get(("sensor", name))
    if camera is None or camera.config.shader_config.shader_pack != "minimal":
        return None
    rows = {modality: _row(images[modality], env_index) for modality in modalities}
    depth = rows.get("depth")
    if depth is not None and (depth.dtype != np.int16 or depth.min() < 0):
        return None
    components = seams.camera_components(camera)
    assert components is not None, "`cameras_of` names no others"
    scene: Any = task.env.scene
    if scene.gpu_sim_enabled:
        scene.px.sync_poses_gpu_to_cpu()
    places = _elsewhere(task, [env_index]).get(env_index, NOWHERE_ELSE)
    pose = camera_pose(components[env_index], places)
    segmentation = rows.get("segmentation")
    return Picture(
        camera=name,
        kind="sensor",
        env=env_index,
        pose=np.array([*pose.p, *pose.q], dtype=np.float32),
        rgb=rows.get("rgb"),
        depth=None if depth is None else depth[..., 0].astype(np.float32) / np.float32(1000.0),
        segmentation=None if segmentation is None else segmentation[..., 0].astype(np.int32),
    )


def _elsewhere(task: TaskEnv, envs: Sequence[int]) -> dict[int, Places]:
    px = seams.batched_system(task.env.scene)
    return {} if px is None else px.elsewhere(envs)


def _row(images: torch.Tensor, env_index: int) -> NDArray:
    return np.ascontiguousarray(images[env_index].cpu().numpy()).copy()
