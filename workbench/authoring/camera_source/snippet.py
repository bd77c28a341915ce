"""A camera as text to copy, for where the author's file is left alone."""

from __future__ import annotations

import json
from collections.abc import Sequence

from workbench.authoring.source.numbers import (
    list_text,
    matrix_text,
    number_text,
    quaternion_texts,
)
from workbench.core.camera_settings import CameraSettings


def snippet(
    uid: str, settings: CameraSettings, indent: str = "", more: Sequence[str] = (), pose: str = ""
) -> str:
    """``CameraConfig(...)``, an argument a line, with `more` of them as they are.

    It needs ``import sapien`` unless the `pose` is given as a text of its own, and numpy as np for an intrinsic.
    """
    quaternion = ", ".join(quaternion_texts(settings.quaternion))
    pose = pose or f"sapien.Pose(p={list_text(settings.position, 4)}, q=[{quaternion}])"
    lines = [
        repr_text(uid),
        f"pose={pose}",
        f"width={settings.width}",
        f"height={settings.height}",
    ]
    if settings.intrinsic is not None:
        lines.append(f"intrinsic=np.array({matrix_text(settings.intrinsic)})")
    elif settings.fov is not None:
        lines.append(f"fov={number_text(settings.fov, 4)}")
    lines += [f"near={number_text(settings.near, 4)}", f"far={number_text(settings.far, 4)}"]
    if settings.shader_pack != "minimal":
        lines.append(f"shader_pack={repr_text(settings.shader_pack)}")
    lines += more
    inside = "".join(f"{indent}    {line},\n" for line in lines)
    return f"CameraConfig(\n{inside}{indent})"


def repr_text(text: str) -> str:
    """A Python string in double quotes, whatever is in it: JSON's escapes are all Python's too."""
    return json.dumps(text, ensure_ascii=False)
