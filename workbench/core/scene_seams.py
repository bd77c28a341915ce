"""Private names of ManiSkill 3.0.1 that drawing and pictures lean on, one small function each.

`seams` holds those of the simulation. Each function says what it relies on, and
``tests/core/test_scene_seams.py`` names every attribute, so that an upgrade of ManiSkill fails loudly
there and not as a picture that is subtly wrong.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from mani_skill.utils.structs import Actor
from mani_skill.utils.structs.render_camera import RenderCamera
from numpy.typing import NDArray


def objects_of(struct: Any) -> list[Any]:
    """The SAPIEN objects behind an Actor, Link or Articulation: ``_objs``, one an env that has it.

    An Actor's are entities, a Link's are link components, an Articulation's are physx articulations.
    """
    return struct._objs


def envs_of(struct: Any) -> NDArray[np.int64]:
    """The env of each of `objects_of`: ``_scene_idxs``."""
    return struct._scene_idxs.cpu().numpy().astype(np.int64)


def data_rows_of(struct: Any) -> torch.Tensor:
    """The row of each of `objects_of` in ``px.cuda_rigid_body_data``: ``_body_data_index``.

    Only where ``scene.gpu_sim_enabled``, for what is not static, and after ``gpu_init``.
    """
    return struct._body_data_index


def hidden_objects(env: Any) -> list[Any]:
    """What the task hides from its sensors: ``_hidden_objects``, Actors (merged ones too)."""
    return env._hidden_objects


def pose_before_hiding(actor: Actor) -> torch.Tensor | None:
    """Where an actor that is hidden now really is, (M, 7) or (7,), or None if it is not hidden.

    ``Actor.hide_visual`` cannot switch off drawing in GPU simulation: it keeps the pose in
    ``before_hide_pose`` and moves the actor 99999 m away. On a stock CPU env nothing moves.
    """
    if not actor.hidden or not actor.scene.gpu_sim_enabled:
        return None
    return actor.before_hide_pose  # type: ignore[attr-defined]


def sensors(env: Any) -> dict[str, Any]:
    """``_sensors``; an env made without a render device has no such attribute."""
    return getattr(env, "_sensors", {})


def human_render_cameras(env: Any) -> dict[str, Any]:
    """``_human_render_cameras``; an env made without a render device has no such attribute."""
    return getattr(env, "_human_render_cameras", {})


def camera_components(camera: Any) -> list[Any] | None:
    """The ``RenderCameraComponent`` of every env behind a ManiSkill camera: ``camera._render_cameras``.

    None for what is no plain camera: tactile sensors, or the stereo depth camera (which ManiSkill
    3.0.1 cannot build: its constructor wants an argument that BaseEnv does not pass).
    """
    inner = getattr(camera, "camera", None)
    return inner._render_cameras if isinstance(inner, RenderCamera) else None
