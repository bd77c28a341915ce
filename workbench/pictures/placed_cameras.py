"""Places live cameras in all envs: pose, lens, size and shader."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import sapien
import sapien.render
import torch
from mani_skill.render import PREBUILT_SHADER_CONFIGS
from mani_skill.utils.structs.pose import Pose

from workbench.envs import maniskill_private
from workbench.envs.backends import give_brdf_table
from workbench.envs.camera_data import NOT_ON_THE_GPU, CameraKey, CameraSettings, why_no_camera
from workbench.envs.rendering.camera_shader import drawable, note_shader, selected
from workbench.envs.simulation.cpu_system import batched_system
from workbench.pictures.camera_conventions import matrix3, triple


@dataclass
class _PlacedCamera:
    camera: Any
    """ManiSkill's camera."""
    config: Any
    """The task's own config."""
    poses: list[sapien.Pose]
    """Local pose of the camera's component in each env before the placement. It is stored because the
    task's code may have moved the components away from the config's pose."""
    settings: CameraSettings


class PlacedCameras:
    """The cameras of one env whose pose, lens, size or shader differ from the task's.

    Pose and lens are set on SAPIEN's camera components. Size and shader are fixed when a component is made:
    to change them, a new component replaces the old one on the same entity. Bodies and physics are
    untouched. The ManiSkill objects that hold the components are updated (config, cached matrices, camera
    group), so observations and ``get_params`` are those of an env that was built with the changed config. A
    placement survives resets and restored snapshots, except a reset that rebuilds the scene: call `put_back`
    after such a reset.
    """

    def __init__(self) -> None:
        self._placed: dict[CameraKey, _PlacedCamera] = {}

    def forget(self) -> None:
        """Drop all placements without changing the env."""
        self._placed.clear()

    @property
    def all(self) -> dict[CameraKey, CameraSettings]:
        """The settings of each placed camera."""
        return {key: placed.settings for key, placed in self._placed.items()}

    def settings(self, key: CameraKey) -> CameraSettings | None:
        """Settings of a placed camera; None if the camera is not placed."""
        placed = self._placed.get(key)
        return None if placed is None else placed.settings

    def place(self, env: Any, key: CameraKey, settings: CameraSettings | None) -> bool:
        """Place a camera in all envs; None restores the task's own settings.

        No picture may be pending.

        Returns:
            Whether the shape or the modalities of the camera's pictures changed.

        Raises:
            ValueError: there is no such camera, or it cannot be placed; nothing has changed.
        """
        camera = _camera(env, key)
        known = self._placed.get(key)
        if known is not None and known.camera is not camera:
            known = None  # the scene was rebuilt
        if settings is None:
            self._placed.pop(key, None)
            return known is not None and _set(env, key, camera, known.config, known.poses)
        config = camera.config if known is None else known.config
        poses = (
            [c.local_pose for c in maniskill_private.camera_components(camera)]
            if known is None
            else known.poses
        )
        changed = _set(env, key, camera, _config(config, settings), [_pose(settings)] * len(poses))
        self._placed[key] = _PlacedCamera(camera, config, poses, settings)
        return changed

    def put_back(self, env: Any) -> None:
        """Place the cameras again if the scene was rebuilt, for example by a reset."""
        for key, placed in list(self._placed.items()):
            camera = maniskill_private.cameras(env).get(key)
            if camera is None:
                del self._placed[key]
            elif camera is not placed.camera:
                self.place(env, key, placed.settings)


def _camera(env: Any, key: CameraKey) -> Any:
    kind, name = key
    camera = maniskill_private.cameras(env).get(key)
    if camera is None:
        raise ValueError(f"there is no {kind} camera {name!r}")
    if moved := maniskill_private.why_not(maniskill_private.PLACING):
        raise ValueError(moved)
    if not maniskill_private.camera_components(camera):
        raise ValueError(
            f"{name!r} is a stereo camera or a sensor class of the task: only ordinary cameras can be placed"
        )
    if env.scene.gpu_sim_enabled and batched_system(env.scene) is None:
        raise ValueError(NOT_ON_THE_GPU)
    return camera


def _pose(settings: CameraSettings) -> sapien.Pose:
    return sapien.Pose(list(settings.position), list(settings.quaternion))


def _config(config: Any, settings: CameraSettings) -> Any:
    """Copy of the task's config with these settings, as if the author had written them."""
    wrong = why_no_camera(settings)
    if wrong is not None:
        raise ValueError(wrong)
    shaders = PREBUILT_SHADER_CONFIGS
    if settings.shader_pack != config.shader_pack and settings.shader_pack not in shaders:
        raise ValueError(
            f"there is no shader pack {settings.shader_pack!r}; choose from {', '.join(sorted(shaders))}"
        )
    placed = copy.copy(config)
    placed.pose = Pose.create(_pose(settings))
    placed.fov, placed.near, placed.far = settings.fov, settings.near, settings.far
    placed.intrinsic = None if settings.intrinsic is None else np.array(settings.intrinsic)
    placed.width, placed.height = settings.width, settings.height
    if settings.shader_pack != config.shader_pack:
        placed.shader_pack, placed.shader_config = settings.shader_pack, shaders[settings.shader_pack]
    return drawable(placed)


def _set(env: Any, key: CameraKey, camera: Any, config: Any, poses: list[sapien.Pose]) -> bool:
    before = camera.config
    old = maniskill_private.camera_components(camera)
    reshaped = (old[0].width, old[0].height) != (config.width, config.height)
    exchanged = reshaped or before.shader_config is not config.shader_config
    components = _exchanged(config, old) if exchanged else old
    for i, (component, pose) in enumerate(zip(components, poses, strict=True)):
        component.local_pose = pose
        _set_lens(component, config, i)
    maniskill_private.set_up_camera(env, key, camera, config, components)
    return exchanged


def _exchanged(config: Any, old: list[Any]) -> list[Any]:
    made = []
    with selected(config.shader_config):
        for component in old:
            new = sapien.render.RenderCameraComponent(config.width, config.height)
            new.name = component.name
            entity = component.entity
            entity.remove_component(component)
            entity.add_component(new)
            note_shader(new)
            give_brdf_table(new)
            made.append(new)
    return made


def _set_lens(component: Any, config: Any, env_index: int) -> None:
    """Set the lens as ``ManiSkillScene.add_camera`` does, on a component that may already have a lens."""
    component.near, component.far = _of_env(config.near, env_index), _of_env(config.far, env_index)
    if config.fov is not None:
        component.set_fovy(_of_env(config.fov, env_index), compute_x=True)
        component.set_principal_point(config.width / 2, config.height / 2)
        return
    matrices = np.asarray(config.intrinsic, dtype=np.float32).reshape(-1, 3, 3)
    k = matrices[env_index if len(matrices) > 1 else 0]
    component.set_focal_lengths(k[0, 0], k[1, 1])
    component.set_principal_point(k[0, 2], k[1, 2])


def _of_env(value: Any, env_index: int) -> float:
    return float(value if isinstance(value, (int, float)) else value[env_index])


# --- settings of a config ---------------------------------------------------------------------------


def settings_of(config: Any) -> CameraSettings | None:
    """A ``CameraConfig`` as plain numbers; if poses differ between envs, the pose of the first env.

    The quaternion is normalised (``look_at`` straight down gives one that is not of unit length). `distance`
    is the distance to the target if ``look_at`` made the pose, else None. Returns None if the lens, near or
    far differs between envs, or if the pose is invalid.
    """
    pose = rows_of_pose(config)[0].astype(np.float64)
    length = float(np.linalg.norm(pose[3:]))
    if not np.isfinite(pose).all() or length < 1e-6:
        return None
    fov, near, far = _one(config.fov), _one(config.near), _one(config.far)
    matrix = _one(config.intrinsic, 3, 3)
    intrinsic = None if matrix is None else matrix3(matrix)
    if near is None or far is None or (fov is None) == (intrinsic is None):
        return None
    w, i, j, k = (pose[3:] / length).tolist()
    target = maniskill_private.camera_target(config)
    return CameraSettings(
        position=triple(pose[:3]),
        quaternion=(w, i, j, k),
        fov=fov,
        intrinsic=intrinsic,
        width=int(config.width),
        height=int(config.height),
        near=near,
        far=far,
        shader_pack=str(config.shader_pack),
        distance=None if target is None else math.dist(_numbers(target).reshape(-1, 3)[0], pose[:3]),
    )


def rows_of_pose(config: Any) -> np.ndarray:
    """(1, 7) or (N, 7) local poses, p then wxyz."""
    return config.pose.raw_pose.detach().cpu().numpy()


def _numbers(value: Any) -> np.ndarray:
    return np.asarray(value.detach().cpu() if isinstance(value, torch.Tensor) else value, dtype=np.float64)


def _one(value: Any, *shape: int) -> Any:
    """The number, or matrix of this shape, that all envs share; None if the envs differ, or if there is no
    value."""
    numbers = np.zeros(0) if value is None else _numbers(value)
    if not numbers.size or numbers.shape[numbers.ndim - len(shape) :] != shape:
        return None
    each = numbers.reshape(-1, *shape)
    return each[0].tolist() if (each == each[0]).all() else None
