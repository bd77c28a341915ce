"""What a recording says of itself, in words: the same JSON in the ``.json`` (key ``workbench``) and in the ``.rrd``.

A library of thousands of episodes lists them by this alone, and whoever reads one back learns from it what
neither of the two formats keeps: the types of the entries of ``evaluate()``, the names and kinds of bodies, the lenses of cameras.

    format          1
    id, task, env_index, seed (null where unknown), control_dt, control_mode, backend, versions, env_kwargs, reset_options,
    max_episode_steps, written_at, recovered, source_hash        as in `EpisodeInfo`
    source_file     the name of the task's file; null
    source_path     where it lies as seen from the recording's folder; null; not in the .rrd, which is handed on
    source          path as seen from the task's file, to text
    acted_by        what chose the actions: pairs of the number of an action, and what it was from that one on; may lack
    side_files      what else the task reads and is not held here: path as seen from the task's file, to hash; may lack
    length, return, success, success_once, fail, fail_once       the last four null where the task has no such entry
    action_names, cameras, segmentation, scene, evaluate, obs    what the columns are
    batch           what the columns are of numbers that ``evaluate()`` returned without a row for each env; may lack
    texts           of its entries that are no numbers, from each state on where it changes: type, text, whether it is per env, whether
                    that is all of it; null where it is not there; may lack
    files           suffix of each of the other two files, to how many bytes it has and what they hash to; may lack; in the .json alone
    made_here       the seal of the installation that recorded it (`made_here`), null where it could not make one; may lack; in the .json alone
    thumbnail       base64 of a JPEG at most 160 pixels wide; null without cameras; in the .json alone
"""

from __future__ import annotations

import base64
import io
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from workbench.core.geometry import SceneGeometry
from workbench.machine.regular_file import read_regular_file
from workbench.recording.checksums import checksum
from workbench.recording.columns import BATCH
from workbench.recording.entry_texts import tracks_words
from workbench.recording.episode import EpisodeInfo, acted_by_from
from workbench.recording.made_here import seal, seal_from
from workbench.recording.survey import Survey, camera_words

FORMAT = 1
THUMBNAIL_WIDTH = 160
MOST_PARTS = 40
"""Folders in the place of a task that are looked for: the place is what a recording says."""
MOST_SOURCE_BYTES = 4 << 20
"""Of a task's file that is looked for by what it names."""


@dataclass(frozen=True)
class Column:
    """What one column of a whole episode is, without its rows."""

    dtype: np.dtype
    shape: tuple[int, ...]
    """Of one row."""


def describe(survey: Survey) -> dict[str, Any]:
    """What a recording says of itself wherever it goes; JSON."""
    info = survey.info
    folder = os.path.dirname(info.source_file) if info.source_file else ""
    geometry = survey.header.geometry
    return {
        "format": FORMAT,
        "id": info.id,
        "task": info.task,
        "env_index": info.env_index,
        "seed": info.seed if info.seed >= 0 else None,
        "control_dt": info.control_dt,
        "control_mode": info.control_mode,
        "backend": info.backend,
        "versions": info.versions,
        "env_kwargs": info.env_kwargs,
        "reset_options": info.reset_options,
        "max_episode_steps": info.max_episode_steps,
        "written_at": info.written_at,
        "recovered": info.recovered,
        "source_hash": info.source_hash,
        "source_file": os.path.basename(info.source_file) if info.source_file else None,
        "source": {_relative(path, folder): text for path, text in info.source.items()},
        "side_files": info.side_files,
        "acted_by": [list(pair) for pair in info.acted_by],
        "length": survey.length,
        "return": float(np.sum(survey.reward, dtype=np.float64)),
        "success": _last(survey, "success"),
        "success_once": _once(survey, "success"),
        "fail": _last(survey, "fail"),
        "fail_once": _once(survey, "fail"),
        "action_names": list(survey.header.action_names),
        "cameras": [camera_words(camera.info) for camera in survey.cameras],
        "segmentation": {str(key): name for key, name in survey.header.segmentation.items()},
        "scene": _scene(geometry),
        "evaluate": _columns(survey.evaluate()),
        "batch": _columns(survey.named(BATCH)),
        "texts": tracks_words(survey.texts),
        "obs": _columns(survey.named("obs/")),
    }


def describe_beside(survey: Survey, folder: Path, files: Sequence[Path]) -> dict[str, Any]:
    """`describe`, with what is only worth saying in `folder`, where the recording lies; of which these are the other `files`."""
    info = survey.info
    source = info.source_file if info.source_file and os.path.isabs(info.source_file) else None
    said = {**describe(survey), "files": {path.suffix: checksum(path) for path in files}}
    return {
        **said,
        "source_path": None if source is None else _relative(source, os.fspath(folder.resolve())),
        "thumbnail": thumbnail(survey.sample),
        "made_here": seal(said, source) if survey.header.made_here else None,
    }


def thumbnail(picture: bytes | None) -> str | None:
    """`picture` (JPEG), small, in base64."""
    if picture is None:
        return None
    with Image.open(io.BytesIO(picture)) as image:
        small = image.convert("RGB")
    small.thumbnail((THUMBNAIL_WIDTH, THUMBNAIL_WIDTH))
    buffer = io.BytesIO()
    small.save(buffer, format="JPEG", quality=80)
    return base64.b64encode(buffer.getvalue()).decode()


def info_from(said: dict[str, Any], folder: Path) -> EpisodeInfo:
    """The info that `said` describes, of a recording in `folder`. Raises KeyError or TypeError."""
    source_file = task_file(said.get("source_path"), said["task"], folder) or said["source_file"]
    return EpisodeInfo(
        task=said["task"],
        env_index=said["env_index"],
        seed=-1 if said["seed"] is None else said["seed"],
        source_file=source_file,
        source_hash=said["source_hash"],
        source=dict(said["source"]),
        control_dt=said["control_dt"],
        control_mode=said["control_mode"],
        backend=said["backend"],
        versions=dict(said["versions"]),
        env_kwargs=dict(said["env_kwargs"]),
        reset_options=dict(said["reset_options"]),
        max_episode_steps=said["max_episode_steps"],
        written_at=said["written_at"],
        id=said["id"],
        recovered=said["recovered"],
        acted_by=acted_by_from(said.get("acted_by")),
        side_files={str(name): str(hashed) for name, hashed in dict(said.get("side_files") or {}).items()},
        seal=seal_from(said),
    )


def task_file(source_path: object, task: object, folder: Path) -> str | None:
    """The task's own file, where `source_path` leads to from the recording's `folder`; None where it is not found."""
    found = _source_where(str(source_path), str(task), folder) if source_path else None
    return None if found is None else os.fspath(found.resolve())


def _source_where(path: str, task: str, folder: Path) -> Path | None:
    """The task's file, where `path` leads to from `folder`; None where it is not found.

    A recording that was copied elsewhere has not taken its task along, and is mostly looked at from where that lies: so the end
    of `path` is looked for below the present folder and those above the recording as well. There the file has to name the task.
    """
    if (there := folder / path).is_file():
        return there
    parts = [part for part in Path(path).parts if part not in ("..", os.sep)] if path.endswith(".py") else []
    if len(parts) > MOST_PARTS:
        return None
    for place in (Path.cwd(), *folder.resolve().parents):
        for begin in range(len(parts)):
            candidate = place.joinpath(*parts[begin:])
            try:
                if task.encode(errors="surrogatepass") in read_regular_file(candidate, MOST_SOURCE_BYTES):
                    return candidate
            except OSError:
                continue
    return None


def columns_from(said: dict[str, Any]) -> dict[str, Column]:
    """The inverse of what `describe` says of ``evaluate`` and ``obs``."""
    return {name: Column(np.dtype(dtype), tuple(shape)) for name, (dtype, shape) in said.items()}


def _columns(columns: dict[str, NDArray]) -> dict[str, Any]:
    return {name: [column.dtype.str, list(column.shape[1:])] for name, column in columns.items()}


def _scene(geometry: SceneGeometry) -> dict[str, Any]:
    return {
        "body_names": list(geometry.body_names),
        "body_kinds": list(geometry.body_kinds),
        "body_hidden": list(geometry.body_hidden),
    }


def _last(survey: Survey, name: str) -> bool | None:
    return bool(survey.flags[name][-1]) if name in survey.flags else None


def _once(survey: Survey, name: str) -> bool | None:
    values: NDArray[np.bool_] | None = survey.flags.get(name)
    return None if values is None else bool(values.any())


def _relative(path: str, folder: str) -> str:
    """Where a source file lies as seen from the task's: the folders above it are nobody's business."""
    if not folder:
        return os.path.basename(path)
    return os.path.relpath(path, folder)
