"""Write an episode as an ``.rrd``, a piece at a time, and read back whether all of it arrived.

Rerun works on threads of its own and turns most errors into warnings. So its strict mode is on, its bytes go
through `recording_into` to a file that cannot fail it, and what lies there at the end is held against the account of what was handed over
(`rerun_log.Account`).
"""

from __future__ import annotations

import errno
import json
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import rerun as rr
from rerun.error_utils import catch_and_log_exceptions

from workbench.recording.blueprint import episode_blueprint
from workbench.recording.description import describe
from workbench.recording.episode import EpisodeInfo, acted_by_in_words
from workbench.recording.landing import RecordingError as RecordingError
from workbench.recording.landing import SafeFile
from workbench.recording.layout import EpisodeLog
from workbench.recording.rerun_log import Account
from workbench.recording.rerun_seam import read_index, recording_into, release_streams
from workbench.recording.survey import Piece, Survey


class RrdWriter:
    """`take` the pieces of an episode in order. Made by `rrd_writer`."""

    def __init__(self, recording: rr.RecordingStream, log: EpisodeLog, file: SafeFile) -> None:
        self._recording = recording
        self._log = log
        self._file = file

    def take(self, piece: Piece) -> None:
        """Raises OSError where the file could not be written."""
        self._log.take(piece)
        self._recording.flush()  # else what rerun has not yet encoded adds up
        if self._file.error is not None:
            raise self._file.error


@contextmanager
def rrd_writer(survey: Survey, path: Path) -> Iterator[RrdWriter]:
    """Write the episode of `survey` to `path`, which must not exist; the file is whole when the block is left.

    Raises:
        OSError: it cannot be written, or what arrived is not what was handed to rerun.
        ValueError: rerun refuses something in it.
    """
    info = survey.info
    file = SafeFile(path)
    try:
        # Without strict mode a mesh that rerun refuses is a warning, and the file lacks it.
        with catch_and_log_exceptions(strict=True):
            with recording_into(file.write, _application_id(info), episode_blueprint(survey)) as recording:
                log = EpisodeLog(recording, survey)
                for name, values in properties(survey).items():
                    recording.send_property(name, rr.AnyValues(**values))
                recording.send_recording_name(_title(survey))
                yield RrdWriter(recording, log, file)
        file.finish()
        check_written(path, log.account)
    finally:
        file.close()
        release_streams()


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
    be made again where the files have changed since. ``workbench`` is `description` for programs.
    """
    said = describe(survey)
    words = ("task", "seed", "env_index", "length", "return", "control_mode", "control_dt", "backend", "id")
    words += ("source_file", "source_hash", "max_episode_steps", "written_at", "recovered")
    episode = {name: said[name] for name in words}
    for name in ("success", "success_once", "fail", "fail_once"):
        episode[name] = bool(said[name])
    episode["acted_by"] = acted_by_in_words(survey.info.acted_by)
    for name in ("env_kwargs", "reset_options"):
        episode[name] = json.dumps(said[name])
    values: dict[str, dict[str, Any]] = {"episode": episode}
    if said["versions"]:
        values["versions"] = dict(said["versions"])
    if said["source"]:
        values["source"] = {"files": list(said["source"]), "texts": list(said["source"].values())}
    # The texts are megabytes in no task, and once is enough.
    values["workbench"] = {"description": json.dumps({**said, "source": None})}
    return values


def check_written(path: Path, account: Account) -> None:
    """Raise OSError unless the index at the end of `path` has every row and every static entity of `account`.

    Rerun writes the index last, of what it encoded; that its bytes arrived is `SafeFile`'s affair. So not a chunk need be decoded.
    """
    rows: Counter[str] = Counter()
    statics: set[str] = set()
    size = path.stat().st_size
    try:
        indexed = read_index(path)
    except (ValueError, RuntimeError, OSError) as error:
        raise OSError(errno.EIO, f"{path.name} could not be read back ({error})") from error
    for chunk in indexed:
        if chunk.end > size:
            raise OSError(errno.EIO, f"{path.name} ends before {chunk.entity}")
        if chunk.static:
            statics.add(chunk.entity)
        else:
            rows[chunk.entity] += chunk.rows
    short = [
        f"{name}: {rows[name]} of {count} rows" for name, count in account.rows.items() if rows[name] != count
    ]
    short += [f"{name}: missing" for name in sorted(account.statics - statics)]
    if short:
        raise OSError(errno.EIO, f"not everything arrived on the disk ({'; '.join(short[:3])})")
