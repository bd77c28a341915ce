"""Recordings for tests of the library: valid ``.json`` files with dummy files that the library does not open."""

from __future__ import annotations

import base64
import io
import json
import uuid
from pathlib import Path
from typing import Any

from PIL import Image


def jpeg(size: tuple[int, int] = (64, 48), colour: tuple[int, int, int] = (200, 60, 20)) -> bytes:
    written = io.BytesIO()
    Image.new("RGB", size, colour).save(written, "JPEG")
    return written.getvalue()


def describe(folder: Path, name: str, **fields: Any) -> Path:
    """Write the three files of a workbench recording into `folder`; returns the ``.json``."""
    folder.mkdir(parents=True, exist_ok=True)
    described = {
        "format": 1,
        "id": uuid.uuid4().hex,
        "task": "PushCube-v1",
        "env_index": 0,
        "seed": 7,
        "control_dt": 0.05,
        "control_mode": "pd_joint_delta_pos",
        "backend": "cpu (batched)",
        "versions": {},
        "env_kwargs": {},
        "reset_options": {},
        "max_episode_steps": None,
        "written_at": "2026-11-21T10:00:00+00:00",
        "recovered": False,
        "source_hash": "aaaaaaaaaaaa",
        "source_file": "push_cube.py",
        "source": {"push_cube.py": "class Task: ...\n"},
        "length": 12,
        "return": 3.5,
        "success": True,
        "success_once": True,
        "fail": None,
        "fail_once": None,
        "action_names": [],
        "cameras": [],
        "segmentation": {},
        "scene": {"body_names": [], "body_kinds": [], "body_hidden": []},
        "evaluate": {},
        "obs": {},
        "thumbnail": base64.b64encode(jpeg()).decode(),
        **fields,
    }
    episode = {"episode_id": 0, "episode_seed": 7, "elapsed_steps": 12, "success": True}
    whole = {"env_info": {"env_id": "PushCube-v1"}, "episodes": [episode], "workbench": described}
    for suffix in (".h5", ".rrd"):
        (folder / f"{name}{suffix}").write_bytes(suffix.encode())
    path = folder / f"{name}.json"
    path.write_text(json.dumps(whole, indent=2))
    return path
