"""Makes the description of an episode for its files."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np
from msgspec import UNSET
from numpy.typing import NDArray

from workbench.episodes import thumbnail
from workbench.episodes.document import SHARED, CameraJson, ColumnType, Description, SceneJson, checksum
from workbench.episodes.episode import Episode
from workbench.episodes.seal import seal


def describe(episode: Episode) -> Description:
    """The part of the description that is valid in any folder. `episode` must have a scene."""
    info, geometry, flags = episode.info, episode.geometry, episode.flags
    assert geometry is not None
    last = {name: bool(flag[-1]) for name, flag in flags.items()}
    once = {name: bool(flag.any()) for name, flag in flags.items()}
    folder = os.path.dirname(info.source_file) if info.source_file else ""
    return Description(
        **{name: getattr(info, name) for name in SHARED},
        seed=info.seed if info.seed >= 0 else None,
        source_file=os.path.basename(info.source_file) if info.source_file else None,
        source={_relative(path, folder): text for path, text in info.source.items()},
        length=episode.length,
        total_reward=float(np.sum(episode.reward, dtype=np.float64)) if info.has_reward else None,
        success=last.get("success"),
        success_once=once.get("success"),
        fail=last.get("fail"),
        fail_once=once.get("fail"),
        action_names=episode.action_names,
        cameras=[CameraJson.of(camera.info) for camera in episode.cameras],
        segmentation=episode.segmentation,
        scene=SceneJson(geometry.body_names, geometry.body_kinds, geometry.body_hidden),
        evaluate=_columns(episode.evaluate),
        batch=_columns(episode.batch),
        texts=episode.texts,
        obs=_columns(episode.obs),
        drawings=tuple(track.key for track in episode.drawn) or UNSET,
    )


def describe_json(episode: Episode, folder: Path, files: Sequence[Path], sealed: bool) -> Description:
    """`describe`, with the fields that only the ``.json`` has.

    Args:
        folder: folder of the recording.
        files: the other two files of the recording.
        sealed: add this installation's seal.
    """
    info = episode.info
    source = info.source_file if info.source_file and os.path.isabs(info.source_file) else None
    description = msgspec.structs.replace(
        describe(episode), files={path.suffix: checksum(path) for path in files}
    )
    return msgspec.structs.replace(
        description,
        source_path=None if source is None else _relative(source, os.fspath(folder.resolve())),
        thumbnail=thumbnail.of_episode(episode),
        made_here=seal(description, source) if sealed else None,
    )


def _columns(columns: dict[str, NDArray]) -> dict[str, ColumnType]:
    return {name: (column.dtype.str, column.shape[1:]) for name, column in columns.items()}


def _relative(path: str, folder: str) -> str:
    """`path` relative to `folder`: a recording must not reveal the folders above the task's folder."""
    if not folder:
        return os.path.basename(path)
    return os.path.relpath(path, folder)
