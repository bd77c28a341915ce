"""Writes an episode as an ``.rrd`` with a blueprint that resembles the workbench's page."""

from __future__ import annotations

import datetime
from collections.abc import Iterator
from functools import lru_cache
from itertools import chain
from pathlib import Path
from typing import Any

import rerun as rr
from rerun.chunk import Chunk
from rerun.error_utils import catch_and_log_exceptions

from workbench.envs.camera_data import moved_cameras_text
from workbench.episodes.describe import describe
from workbench.episodes.document import fields_of, json_text
from workbench.episodes.episode import Episode, EpisodeInfo, acted_by_text
from workbench.episodes.rerun.blueprint import Arrangement, arrangement, blueprint_of
from workbench.episodes.rerun.chunks import property_chunk, static_chunk
from workbench.episodes.rerun.entities import (
    chunks,
)
from workbench.episodes.rerun.stream import encode_blueprint, write_recording


def write_rrd(episode: Episode, path: Path) -> None:
    """Write `episode`, which has a scene, to `path`, overwriting a file there.

    Chunks are made while rerun writes them, so that the pictures are never all in memory at once.

    Raises:
        OSError: `path` cannot be written, or a picture cannot be read.
        ValueError: rerun refuses a value.
    """
    application_id = _application_id(episode.info)
    # Without strict mode, rerun only warns and drops a mesh that it refuses.
    with catch_and_log_exceptions(strict=True):
        blueprint = _blueprint(application_id, arrangement(episode))
        everything = chain(_property_chunks(episode), chunks(episode))
        write_recording(path, application_id, blueprint, everything)


def _property_chunks(episode: Episode) -> Iterator[Chunk]:
    written = datetime.datetime.fromisoformat(episode.info.written_at).timestamp()
    started = rr.encodings.TimeInt(seconds=written)
    info = rr.archetypes.RecordingInfo(name=_title(episode), start_time=started)
    yield static_chunk("/__properties", info)
    for name, values in properties(episode).items():
        yield property_chunk(name, values)


@lru_cache(maxsize=64)
def _blueprint(application_id: str, arranged: Arrangement) -> bytes:
    return encode_blueprint(application_id, blueprint_of(arranged))


def _application_id(info: EpisodeInfo) -> str:
    """Application id of a recording. The viewer keeps one blueprint per id, and renames an id with a slash."""
    return f"workbench {info.task}".replace("/", "-")


def _title(episode: Episode) -> str:
    flags = episode.flags
    outcome = (
        "success"
        if "success" in flags and flags["success"][-1]
        else "fail"
        if "fail" in flags and flags["fail"][-1]
        else "no success"
    )
    info = episode.info
    seed = f"seed {info.seed}" if info.seed >= 0 else "no seed"
    return f"{info.task} {seed} env {info.env_index}: {outcome}, {episode.length} steps"


def properties(episode: Episode) -> dict[str, dict[str, Any]]:
    """The properties of the recording, by name and component.

    ``success`` and ``fail`` are those of the last state, ``success_once`` and ``fail_once`` of any state, as in ManiSkill's
    metrics. ``source`` has the texts of the task's files, so that the episode can be replayed after they change.
    ``workbench`` is the `Description` for programs.
    """
    described = fields_of(describe(episode))
    words = ("task", "seed", "env_index", "length", "return", "control_mode", "control_dt", "backend", "id")
    words += ("source_file", "source_hash", "max_episode_steps", "written_at", "recovered", "pictures")
    plain = {name: described[name] for name in words}
    for name in ("success", "success_once", "fail", "fail_once"):
        plain[name] = bool(described[name])
    plain["acted_by"] = acted_by_text(episode.info.acted_by)
    if episode.info.moved_cameras:
        plain["moved_cameras"] = moved_cameras_text(episode.info.moved_cameras)
    if episode.info.observed_by:
        plain["observed_by"] = episode.info.observed_by
    for name in ("env_kwargs", "reset_options"):
        plain[name] = json_text(described[name])
    values: dict[str, dict[str, Any]] = {"episode": plain}
    if described["versions"]:
        values["versions"] = dict(described["versions"])
    if described["source"]:
        values["source"] = {"files": list(described["source"]), "texts": list(described["source"].values())}
    # Without the texts, which `source` holds.
    values["workbench"] = {"description": json_text({**described, "source": None})}
    return values
