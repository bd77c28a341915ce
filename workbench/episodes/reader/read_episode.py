"""Reads an episode from the three files of a recording."""

from __future__ import annotations

import errno
import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from workbench.envs.scene.shapes import SceneGeometry, SharedShapes
from workbench.episodes.columns import MAX_TEXT_LINES
from workbench.episodes.document import (
    CameraJson,
    ColumnType,
    Description,
    WrongDocument,
    check,
    description_in,
    read_document,
    task_file,
)
from workbench.episodes.drawings import wrong_drawings
from workbench.episodes.encoded_pictures import EncodedPictures, Modality
from workbench.episodes.episode import BrokenFile, CameraTrack, Episode
from workbench.episodes.maniskill.read import leaves
from workbench.episodes.maniskill.read import read_maniskill as read_maniskill
from workbench.episodes.maniskill.safe_h5 import open_h5
from workbench.episodes.maniskill.write import TRAJECTORY
from workbench.episodes.rerun.drawings import read_drawings
from workbench.episodes.rerun.entities import (
    CAMERAS,
    OBSERVATION,
    batch_entity,
    body_entities,
    camera_entities,
    evaluate_entity,
    wxyz_from_optical,
)
from workbench.episodes.rerun.read import RerunTable, rows_at
from workbench.episodes.row import UnreadableRecording
from workbench.machine.files import NotARegularFile

MAX_STATES = 10_000_000
MAX_COLUMN_BYTES = 1 << 29
"""Maximum size that a description may claim for one column. A small file can describe a large column, because
the file leaves out repeated rows."""


def read_episode(path: Path, shapes: SharedShapes | None = None) -> Episode:
    """The episode of a workbench recording.

    The ``.json`` describes the recording; the ``.rrd`` holds meshes, poses, pictures and curves; the ``.h5``
    holds env states, observations and actions. A broken or missing file is listed in `Episode.broken_files`.
    Without the .rrd, the episode has no geometry, poses and pictures; without the .h5, no env states. A lone
    ``.rrd`` counts as complete: no file is listed as missing. The geometry is that of this env alone, as env
    0 of 1. Pictures stay in the file until they are accessed.

    Args:
        path: the .rrd, .h5 or .json of the recording.
        shapes: shapes to share with other recordings.

    Raises:
        UnreadableRecording: it is not a workbench recording, or all files are broken.
    """
    episode, source_path = read_without_task(path, shapes)
    found = task_file(source_path, episode.info.task, Path(path).parent)
    if found is not None:
        episode.info = replace(episode.info, source_file=found)
    return episode


def read_without_task(path: Path, shapes: SharedShapes | None = None) -> tuple[Episode, str | None]:
    """`read_episode` without searching for the task's file; also returns the recorded path of that file.

    Raises the errors of `read_episode`.
    """
    path = Path(path)
    files = {suffix: path.with_suffix(suffix) for suffix in (".rrd", ".h5", ".json")}
    there = {suffix: file for suffix, file in files.items() if os.path.lexists(file)}
    if not there:
        raise UnreadableRecording(f"{path.name} no longer exists.")
    broken_files: list[BrokenFile] = []
    in_json, not_json = _read_description(there.get(".json"))
    if ".json" not in there and ".h5" in there:
        not_json = FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT))
    checksums = {} if in_json is None else in_json.files or {}
    table = states = None
    if in_json is not None or ".rrd" in there:
        try:
            check(files[".rrd"], checksums)
            table = RerunTable(files[".rrd"], shapes)
            if table.lost_pictures:
                cameras = ", ".join(entity.removeprefix(f"{CAMERAS}/") for entity in table.lost_pictures)
                what = f"was changed: pictures are missing ({cameras})."
                broken_files.append(BrokenFile(files[".rrd"].name, what))
        except (OSError, ValueError, RuntimeError) as error:
            lost = "its 3-D scene, its pictures and its evaluate() results are missing"
            broken_files.append(_broken_file(files[".rrd"], error, lost))
    if in_json is not None or ".h5" in there:
        try:
            check(files[".h5"], checksums)
            states = _read_states(files[".h5"])
        except (OSError, RuntimeError, KeyError, TypeError, ValueError) as error:
            broken_files.append(_broken_file(files[".h5"], error, "its env states are missing"))
    if table is None and states is None and broken_files:
        problems = " ".join(broken.sentence for broken in broken_files)
        raise UnreadableRecording(f"{problems} Copy the recording again from where it was recorded.")
    if not_json is not None and table is not None:
        broken_files.append(
            _broken_file(files[".json"], not_json, "its tags, its note and the path of its task are missing")
        )
    description = in_json or _description(there.get(".json"), not_json, table, path)
    try:
        episode = _episode(description, table)
        if states is not None:
            _add_states(episode, states)
        elif table is not None:
            episode.obs = dict(_observations(table, description.obs, episode.length + 1))
    except (OSError, RuntimeError, KeyError, TypeError, ValueError, IndexError) as error:
        raise UnreadableRecording(
            f"{path.stem} is a recording, but a broken one ({type(error).__name__}: {error})"
        ) from error
    episode.broken_files = tuple(broken_files)
    return episode, description.source_path or None


def _broken_file(file: Path, error: Exception, lost: str) -> BrokenFile:
    if isinstance(error, FileNotFoundError):
        return BrokenFile(file.name, f"is missing: {lost}.")
    if isinstance(error, WrongDocument):
        return BrokenFile(file.name, f"{error}: {lost}.")
    if isinstance(error, NotARegularFile):
        return BrokenFile(file.name, f"{error.strerror}: {lost}.")
    if isinstance(error, OSError) and error.errno is not None:
        return BrokenFile(file.name, f"cannot be read ({error.strerror}): {lost}.")
    why = " ".join(str(error).split()).removeprefix(f"Failed to read RRD file at {file}: ")
    why = why if len(why) <= 160 else why[:159] + "\u2026"
    return BrokenFile(file.name, f"was cut short or changed ({why}): {lost}.")


def _read_description(file: Path | None) -> tuple[Description | None, Exception | None]:
    """(description in the .json, error). The description is None if the file is missing, unreadable or from
    another program; the error is None unless reading the file failed."""
    if file is None:
        return None, None
    try:
        document = read_document(file)
    except (OSError, WrongDocument) as error:
        return None, error
    try:
        return document.description() if document.is_ours else None, None
    except WrongDocument as error:
        raise UnreadableRecording(
            f"{file.stem} is a recording, but a broken one: {file.name} {error}."
        ) from error


def _description(
    file: Path | None, not_json: Exception | None, table: RerunTable | None, path: Path
) -> Description:
    """The description in the .rrd, for a recording without a .json of the workbench. Raises
    UnreadableRecording."""
    if file is not None and table is None:
        if not_json is not None:
            raise UnreadableRecording(f"{file.name} {not_json}.") from not_json
        raise UnreadableRecording(f"{file.name} is not from the workbench; read it as ManiSkill's.")
    if table is None:
        raise UnreadableRecording(f"{path.stem}.json, which describes {path.name}, is missing.")
    description = table.property("workbench", "description")
    if not isinstance(description, str):
        raise UnreadableRecording(f"{path.stem}.rrd is from another program, or from an older workbench.")
    files, texts = (_list(table.property("source", key)) for key in ("files", "texts"))
    try:
        return description_in(description, dict(zip(files, texts)))
    except WrongDocument as error:
        raise UnreadableRecording(f"{path.stem}.rrd {error}.") from error


def _list(value: Any) -> list[Any]:
    return [] if value is None else value if isinstance(value, list) else [value]


def _episode(description: Description, table: RerunTable | None) -> Episode:
    states = description.length + 1
    if not 0 < states <= MAX_STATES:
        raise ValueError(f"it claims {description.length} steps")
    if sum(map(len, description.texts.values())) > MAX_TEXT_LINES:
        raise ValueError(f"it has more than {MAX_TEXT_LINES} lines of entries that are not numbers")
    geometry = poses = None
    cameras: list[CameraTrack] = []
    if table is not None:
        scene = description.scene
        bare = SceneGeometry(1, scene.body_names, scene.body_kinds, scene.body_hidden, ())
        entities = body_entities(bare)
        geometry = table.geometry(bare, entities)
        _check_room("the poses", (states, len(entities), 7), np.dtype(np.float32))
        poses = table.poses(entities, states)
        cameras = list(_cameras(description.cameras, table, states))
    drawn = () if table is None else tuple(read_drawings(table, description.drawings or ()))
    if (wrong := wrong_drawings(drawn, states)) is not None:
        raise ValueError(f"it has {wrong}")
    actions, number, flag = ("<f4", (len(description.action_names),)), ("<f4", ()), ("|b1", ())
    return Episode(
        info=description.info(),
        geometry=geometry,
        segmentation=description.segmentation,
        poses=poses,
        action=_column(table, "/action", actions, 1, states),
        action_names=description.action_names,
        reward=_column(table, "/reward", number, 1, states),
        terminated=_column(table, "/episode/terminated", flag, 1, states),
        truncated=_column(table, "/episode/truncated", flag, 1, states),
        evaluate=_columns(table, description.evaluate, evaluate_entity, states),
        cameras=cameras,
        batch=_columns(table, description.batch, batch_entity, states),
        texts=description.texts,
        drawn=drawn,
    )


def _columns(
    table: RerunTable | None,
    columns: Mapping[str, ColumnType],
    entity_of: Callable[[str], str],
    states: int,
) -> dict[str, NDArray]:
    if table is None:
        return {}
    return {name: _column(table, entity_of(name), kind, 0, states) for name, kind in columns.items()}


def _column(table: RerunTable | None, entity: str, kind: ColumnType, first: int, states: int) -> NDArray:
    """The numbers of `entity`, a row per state from `first` on. `kind` is the dtype and a row's shape."""
    dtype, shape = np.dtype(kind[0]), (states - first, *kind[1])
    _check_room(entity, shape, dtype)
    out = np.full(shape, np.nan if dtype.kind == "f" else 0, dtype=dtype)
    if table is None or out.size == 0:
        return out
    steps, values = table.scalars(entity)
    if len(steps) == 0:
        return out
    flat = out.reshape(len(out), -1)
    if dtype.kind == "b":
        values = values != 0
    at = rows_at(steps, first, states)
    flat[at >= 0] = values[at[at >= 0]].astype(dtype)
    return out


def _check_room(what: str, shape: tuple[int, ...], dtype: np.dtype) -> None:
    """Check a described size before allocating it. Raises ValueError."""
    if dtype.kind not in "biuf":
        raise ValueError(f"{what} claims the type {dtype}, which is not a plain number")
    if any(size < 0 for size in shape) or math.prod(shape) * dtype.itemsize > MAX_COLUMN_BYTES:
        raise ValueError(f"{what} claims {shape} numbers")


def _cameras(cameras: Sequence[CameraJson], table: RerunTable, states: int) -> Iterator[CameraTrack]:
    infos = [camera.info() for camera in cameras]
    for info, entity in zip(infos, camera_entities(infos)):
        held: dict[Modality, tuple[NDArray[np.int64], EncodedPictures]] = {}
        for modality in ("rgb", "depth", "segmentation"):
            found = table.pictures(f"{entity}/{modality}", modality, info)
            if found is not None:
                held[modality] = found
        if not held:
            continue
        frame = next(iter(held.values()))[0]
        pose = wxyz_from_optical(table.pose_rows(entity, frame, states))
        pictures = {modality: track for modality, (_, track) in held.items()}
        yield CameraTrack(
            info, frame, pose, pictures.get("rgb"), pictures.get("depth"), pictures.get("segmentation")
        )


def _observations(
    table: RerunTable, columns: Mapping[str, ColumnType], states: int
) -> Iterator[tuple[str, NDArray]]:
    begin = 0
    together = sum(math.prod(shape) for _, shape in columns.values())
    values = _column(table, OBSERVATION, ("<f8", (together,)), 0, states)
    for name, (dtype, shape) in columns.items():
        end = begin + math.prod(shape)
        yield name, values[:, begin:end].astype(dtype).reshape(states, *shape)
        begin = end


_FLAGS = ("success", "fail")


def _read_states(path: Path) -> dict[str, Any]:
    """Content of the .h5. It takes precedence over the same columns of the .rrd, because ManiSkill reads the
    .h5."""
    with open_h5(path) as file:
        group = file.group(TRAJECTORY)
        if group is None:
            raise KeyError(f"it has no {TRAJECTORY}")
        held: dict[str, Any] = {name: dict(leaves(group.get(name))) for name in ("env_states", "obs")}
        held |= {name: group.numbers(name) for name in ("actions", "rewards", "terminated", "truncated")}
        return held | {name: group.numbers(name) for name in _FLAGS if name in group}


def _add_states(episode: Episode, held: dict[str, Any]) -> None:
    episode.env_states, episode.obs = held["env_states"], held["obs"]
    episode.action, episode.reward = held["actions"], held["rewards"]
    episode.terminated, episode.truncated = held["terminated"], held["truncated"]
    if not episode.evaluate:
        for name in _FLAGS:
            if name in held:
                episode.evaluate[name] = np.concatenate([[False], held[name]])
