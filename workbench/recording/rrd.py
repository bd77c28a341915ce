"""Write an episode as an ``.rrd``.

Its chunks are made while rerun writes them, so that its pictures are never in memory all at once, and what the disk refuses is
an error here and not on a thread of rerun's.
"""

from __future__ import annotations

import datetime
import errno
import os
import re
import uuid
from collections.abc import Iterable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

import rerun as rr
from rerun.chunk import Chunk, LazyChunkStream
from rerun.error_utils import catch_and_log_exceptions

from workbench.recording.blueprint import Arrangement, arrangement, blueprint_of
from workbench.recording.blueprint_in_file import BlueprintBytes, add_blueprint, encode_blueprint
from workbench.recording.description import describe
from workbench.recording.document import fields_of, json_text
from workbench.recording.episode import EpisodeInfo, acted_by_in_words
from workbench.recording.layout import static_chunks, time_chunks
from workbench.recording.rerun_chunks import property_chunk, static_chunk
from workbench.recording.survey import Pictures, Survey


def write_rrd(survey: Survey, pictures: Iterable[Pictures], path: Path) -> None:
    """Write the episode of `survey` with its `pictures` to `path`; what lies there is written over.

    Raises:
        OSError: it cannot be written.
        ValueError: rerun refuses something in it.
        Whatever `pictures` raises.
    """
    application_id = _application_id(survey.info)
    # Without strict mode a mesh that rerun refuses is a warning, and the file lacks it.
    with catch_and_log_exceptions(strict=True):
        write_chunks(_chunks(survey, pictures), path, application_id)
        add_blueprint(path, _blueprint(application_id, arrangement(survey)))


def _chunks(survey: Survey, pictures: Iterable[Pictures]) -> Iterator[Chunk]:
    written = datetime.datetime.fromisoformat(survey.info.written_at).timestamp()
    started = rr.encodings.TimeInt(seconds=written)
    info = rr.archetypes.RecordingInfo(name=_title(survey), start_time=started)
    yield static_chunk("/__properties", info)
    for name, values in properties(survey).items():
        yield property_chunk(name, values)
    yield from static_chunks(survey)
    yield from time_chunks(survey, pictures)


def write_chunks(chunks: Iterator[Chunk], path: Path, application_id: str) -> None:
    """Write `chunks` as a recording of its own. Raises OSError, and whatever `chunks` raises."""
    failed: list[BaseException] = []

    def watched() -> Iterator[Chunk]:
        try:
            yield from chunks
        except GeneratorExit:  # rerun wants no more
            raise
        except BaseException as error:
            failed.append(error)
            raise

    stream = LazyChunkStream.from_iter(watched())
    try:
        # Rerun derives a default id from the process, so two episodes of one process would be taken for one.
        stream.write_rrd(path, application_id=application_id, recording_id=uuid.uuid4().hex)
    except RuntimeError as error:
        if failed:
            raise failed[0] from None
        raise _disk_error(error, path) from error


def _disk_error(error: RuntimeError, path: Path) -> OSError:
    """What rerun says of a disk, with the number that the system gave."""
    number = re.search(r"\(os error (\d+)\)", str(error))
    if number is None:
        return OSError(errno.EIO, f"{path.name} could not be written ({error})")
    return OSError(int(number[1]), os.strerror(int(number[1])), str(path))


@lru_cache(maxsize=64)
def _blueprint(application_id: str, arranged: Arrangement) -> BlueprintBytes:
    return encode_blueprint(application_id, blueprint_of(arranged))


def _application_id(info: EpisodeInfo) -> str:
    """The viewer keeps one blueprint an application id; a slash in it makes rerun rename it."""
    return f"workbench {info.task}".replace("/", "-")


def _title(survey: Survey) -> str:
    flags = survey.flags
    outcome = (
        "success"
        if "success" in flags and flags["success"][-1]
        else "fail"
        if "fail" in flags and flags["fail"][-1]
        else "no success"
    )
    info = survey.info
    seed = f"seed {info.seed}" if info.seed >= 0 else "no seed"
    return f"{info.task} {seed} env {info.env_index}: {outcome}, {survey.length} steps"


def properties(survey: Survey) -> dict[str, dict[str, Any]]:
    """What the file says of the episode as a whole, property by property.

    ``success`` and ``fail`` are those of the last state, ``success_once`` and ``fail_once`` of any, as
    in ManiSkill's own metrics. ``source`` holds the text of the task's files, so that the episode can
    be made again where the files have changed since. ``workbench`` is the `Description` for programs.
    """
    said = fields_of(describe(survey))
    words = ("task", "seed", "env_index", "length", "return", "control_mode", "control_dt", "backend", "id")
    words += ("source_file", "source_hash", "max_episode_steps", "written_at", "recovered")
    episode = {name: said[name] for name in words}
    for name in ("success", "success_once", "fail", "fail_once"):
        episode[name] = bool(said[name])
    episode["acted_by"] = acted_by_in_words(survey.info.acted_by)
    for name in ("env_kwargs", "reset_options"):
        episode[name] = json_text(said[name])
    values: dict[str, dict[str, Any]] = {"episode": episode}
    if said["versions"]:
        values["versions"] = dict(said["versions"])
    if said["source"]:
        values["source"] = {"files": list(said["source"]), "texts": list(said["source"].values())}
    # The texts are megabytes in no task, and once is enough.
    values["workbench"] = {"description": json_text({**said, "source": None})}
    return values
