"""A temporary camera at any pose in one env."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import sapien
import sapien.render
from numpy.typing import ArrayLike, NDArray

from workbench.envs.backends import give_brdf_table
from workbench.envs.camera_data import CameraKey, CameraKind, CameraSettings
from workbench.envs.indices import require_env
from workbench.envs.rendering.camera_shader import MINIMAL, selected
from workbench.envs.rendering.drawing import drawing
from workbench.envs.simulation.drawn_poses import drawn_at, temporarily
from workbench.pictures.camera_conventions import intrinsic_of, scaled_intrinsic
from workbench.pictures.render import depth_in_metres, places_to_draw, show_hidden_objects

_TEXTURE = "PositionSegmentation"


@dataclass
class TemporaryCamera:
    """A camera that renders segmentation, depth and colours of the objects that its kind of camera sees."""

    _key: CameraKey
    _sub_scene: Any
    _component: Any
    _move_bodies: Any

    def look(self, pose: ArrayLike) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        """Segmentation (H, W), 0 for background, and depth (H, W) in metres, from a pose (7,) in the env's frame."""
        p = np.asarray(pose, np.float32).tolist()
        self._component.local_pose = sapien.Pose(p[:3], p[3:])
        # A camera renders from the pose that its entity had at the last update.
        self._sub_scene.update_render()
        self._move_bodies()
        with drawing(self._key):
            self._component.take_picture()
            data = self._component.get_picture(_TEXTURE)
        depth = depth_in_metres(_TEXTURE, data, -data[..., 2], self._component)
        return data[..., 3].astype(np.int32), depth

    def colours(self) -> NDArray[np.uint8]:
        """(H, W, 3) RGB of the last picture."""
        with drawing(self._key):
            return np.ascontiguousarray(self._component.get_picture("Color")[..., :3])


@contextmanager
def temporary_camera(
    env: Any,
    env_index: int,
    kind: CameraKind,
    settings: CameraSettings,
    size: tuple[int, int] | None = None,
    poses: NDArray[np.float32] | None = None,
) -> Iterator[TemporaryCamera]:
    """Context with a camera in one env. Until it ends, change nothing in the env and take no other picture.

    The camera is in a second, empty ``sapien.Scene`` that shares the sub-scene's render system. A camera in
    the sub-scene itself would change the order of its entities, on which the scene's index, snapshots and
    PhysX's packed state rely, and would use up a segmentation id. (Measured with sapien 3.0.3: entities,
    packed poses, ids and pictures of the other cameras are equal before and after.)

    Args:
        kind: sensors do not see what the task hides from them.
        settings: the camera's lens; the pose is an argument of `look`.
        size: width and height of the pictures; None for the size in `settings`. Another size does not change
            the view.
        poses: (B, 7) where to draw the env's bodies; None for where they are.

    Raises:
        IndexError: there is no such env.
        ValueError: the lens cannot be rendered.
        RuntimeError: the env was made without a render device, or the renderer failed.
    """
    require_env(env_index, env.num_envs)
    own, near, far = (settings.width, settings.height), settings.near, settings.far
    size = size or own
    k = scaled_intrinsic(intrinsic_of(settings), own, size)
    if not 0 < near < far:
        raise ValueError(f"near must be positive and less than far, not {near} m and {far} m")
    scene = env.scene
    sub_scene = scene.sub_scenes[env_index]
    render_system = sub_scene.render_system
    if render_system is None:
        raise RuntimeError("the env was made without a render device, and so without cameras")
    if scene.gpu_sim_enabled:
        scene.px.sync_poses_gpu_to_cpu()
    places = places_to_draw(env, env_index, poses)
    with ExitStack() as after:
        after.enter_context(show_hidden_objects(env, env_index, shown=kind == "human"))
        move_bodies = after.enter_context(drawn_at(places))
        second_scene = sapien.Scene([render_system])
        entity = sapien.Entity()
        with selected(MINIMAL):
            component = sapien.render.RenderCameraComponent(size[0], size[1])
            entity.add_component(component)
            second_scene.add_entity(entity)
            give_brdf_table(component)
        after.callback(second_scene.remove_entity, entity)
        component.near, component.far = near, far
        component.set_focal_lengths(k[0, 0], k[1, 1])
        component.set_principal_point(k[0, 2], k[1, 2])
        yield TemporaryCamera((kind, "temporary"), sub_scene, component, move_bodies)


@contextmanager
def undrawn(entities: Sequence[Any]) -> Iterator[None]:
    """Context in which these entities are not drawn; items that are None are ignored."""
    bodies = [body for entity in entities if entity is not None for body in entity.components]
    drawn = [body for body in bodies if isinstance(body, sapien.render.RenderBodyComponent)]
    with temporarily((body, "visibility", 0.0) for body in drawn):
        yield
