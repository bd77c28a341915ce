"""The meshes of a scene in a file of their own, while episodes of it are being recorded.

An episode that is to survive its writer needs the scene's meshes on the disk from its first row on. They are megabytes
(ManiSkill's table alone has a texture of 4 MB), and sixty-four envs begin an episode at once. So all
episodes of one process and one scene share one file: each has a name of its own for it, a hard link, and the file is gone
when the last name is. Plain arrays and a line of JSON in numpy's own archive, which checks what it reads and runs no code.
"""

from __future__ import annotations

import json
import os
import threading
import weakref
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from workbench.core.geometry import Material, Mesh, SceneGeometry, Visual
from workbench.machine.regular_file import open_regular_file

_MESH = tuple(field.name for field in fields(Mesh))
_lock = threading.Lock()
_last: tuple[weakref.ref[SceneGeometry], Path] | None = None


def keep_scene(geometry: SceneGeometry, path: Path) -> None:
    """Have `geometry` in the file `path`, which must not exist. Raises OSError."""
    global _last
    with _lock:
        if _last is not None and _last[0]() is geometry and _last[1].parent == path.parent:
            try:
                os.link(_last[1], path)
                return
            except OSError:  # that episode is over and its file gone, or the filesystem has no links
                pass
        _write(geometry, path)
        _last = (weakref.ref(geometry), path)


def read_visuals(path: Path) -> tuple[Visual, ...]:
    """The visuals of what `keep_scene` kept; none where the file is missing or broken."""
    try:
        with open_regular_file(path) as file, np.load(file, allow_pickle=False) as archive:
            return tuple(_visuals(archive))
    except (OSError, BadZipFile, KeyError, ValueError, TypeError, EOFError):
        return ()


def _write(geometry: SceneGeometry, path: Path) -> None:
    arrays: dict[str, Any] = {}
    visuals = []
    for index, visual in enumerate(geometry.visuals):
        held = {name: getattr(visual.mesh, name) for name in _MESH}
        held |= {"texture": visual.material.texture, "envs": visual.envs, "bodies": visual.bodies}
        arrays |= {f"{index}/{name}": array for name, array in held.items() if array is not None}
        material = visual.material
        visuals.append([visual.name, material.base_color, material.metallic, material.roughness])
    arrays["scene"] = np.frombuffer(json.dumps({"visuals": visuals}).encode(), dtype=np.uint8)
    try:
        with path.open("xb") as file:
            np.savez(file, **arrays)
    except OSError:
        path.unlink(missing_ok=True)
        raise


def _visuals(archive: Any) -> Iterator[Visual]:
    scene = json.loads(bytes(archive["scene"]))
    for index, (name, base_color, metallic, roughness) in enumerate(scene["visuals"]):
        held: dict[str, Any] = {
            key: archive[f"{index}/{key}"] if f"{index}/{key}" in archive else None
            for key in (*_MESH, "texture", "envs", "bodies")
        }
        r, g, b, a = base_color
        material = Material((r, g, b, a), metallic, roughness, held["texture"])
        mesh = Mesh(**{key: held[key] for key in _MESH})
        yield Visual(name, mesh, material, held["envs"], held["bodies"])
