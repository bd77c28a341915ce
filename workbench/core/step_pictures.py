"""The pictures that belong to a step, out of the observation where it has them already.

A task that observes pictures (``obs_mode="rgb+depth"`` and the like) has drawn its sensors for this very step, and a
picture takes 25 to 50 ms on a software renderer: a recording that draws them again would take twice as long as the
episode. So what the observation holds is taken from there, and only the rest is drawn. Both are the same picture (tested),
with two exceptions that are drawn: depth that does not fit into ManiSkill's whole millimetres, which end at 32.767 m, and
shaders that give more than millimetres.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from workbench.core import seams
from workbench.core.drawn_poses import NOWHERE_ELSE, camera_pose
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


def _observed(task: TaskEnv, env_index: int, request: Request) -> Picture | None:
    name, kind, modalities = request
    seen: Any = task.obs.get("sensor_data", {}) if isinstance(task.obs, Mapping) else {}
    images = seen.get(name) if kind == "sensor" else None
    if not isinstance(images, Mapping) or not modalities or not set(modalities) <= set(images):
        return None
    camera = cameras_of(task.env).get(("sensor", name))
    if camera is None or camera.config.shader_config.shader_pack != "minimal":
        return None
    rows = {modality: _row(images[modality], env_index) for modality in modalities}
    depth = rows.get("depth")
    if depth is not None and (depth.dtype != np.int16 or depth.min() < 0):
        return None
    scene: Any = task.env.scene
    if scene.gpu_sim_enabled:
        scene.px.sync_poses_gpu_to_cpu()
    px = seams.batched_system(scene)
    elsewhere = {} if px is None else px.elsewhere([env_index])
    pose = camera_pose(seams.camera_components(camera)[env_index], elsewhere.get(env_index, NOWHERE_ELSE))
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


def _row(images: torch.Tensor, env_index: int) -> NDArray:
    return np.ascontiguousarray(images[env_index].cpu().numpy()).copy()
