"""Write an episode as one ``.rrd`` file that is either there, whole, or not there at all.

A recording is the one thing that outlives a session, so the file must not lie: not half written
after a full disk, not silently short of a camera, not written over yesterday's. Rerun works on threads
of its own and turns most errors into warnings. So it encodes in memory with its strict mode on; the
bytes go to a temporary name in the same folder, are flushed to the disk, read back and held against
the account of what was handed over (`layout.Account`), and only then get their name, in one step that
fails where the name exists.
"""

from __future__ import annotations

import datetime
import errno
import os
import re
import shutil
import uuid
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
from rerun.chunk import RrdReader
from rerun.error_utils import catch_and_log_exceptions

from workbench.recording.blueprint import episode_blueprint
from workbench.recording.episode import Episode, EpisodeInfo
from workbench.recording.layout import Account, flag, log_episode
from workbench.recording.rerun_seam import encode_recording, release_streams

_NO_LINKS = {errno.EPERM, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.EMLINK, errno.EACCES}


class RecordingError(OSError):
    """An episode could not be written; the message says what to do. No file was left behind."""


def write_rrd(episode: Episode, path: Path) -> Path:
    """Write `episode` to `path` and return the path that it got.

    Folders that are missing are made. A file that exists is never written over: the episode then gets
    the next free of ``name_2.rrd``, ``name_3.rrd`` ...

    Raises:
        RecordingError: the folder cannot be written to, the disk is full, or what arrived on the disk
            is not what was handed to rerun.
        ValueError: the columns of `episode` do not fit together.
    """
    path = Path(path)
    _check_lengths(episode)
    try:
        content, account = _encode(episode)
    finally:
        release_streams()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.parent / f".{uuid.uuid4().hex}.rrd.part"
        try:
            _write(temporary, content)
            _check_written(temporary, account)
            final = _publish(temporary, path)
        finally:
            if temporary.exists():
                temporary.unlink()
        _sync_folder(path.parent)
        return final
    except OSError as error:
        raise RecordingError(f"Cannot write {path}: {_reason(error, path)}") from error


def episode_filename(info: EpisodeInfo, when: datetime.datetime | None = None) -> str:
    """``PushCube-v1_seed0003_env03_2026-11-21T08-15-30.rrd``: task, seed, env, local time of writing.

    A seed below 0 says that it is not known, and the name then says ``noseed``. Only letters, digits and ``. _ -``; sorts by task, then seed, then env, then time. Two episodes of
    one second get the same name, which `write_rrd` keeps apart.
    """
    when = when or datetime.datetime.now()
    task = re.sub(r"[^A-Za-z0-9._-]+", "-", info.task).strip("-._")[:80] or "task"
    seed = f"seed{info.seed:04d}" if info.seed >= 0 else "noseed"
    return f"{task}_{seed}_env{info.env_index:02d}_{when:%Y-%m-%dT%H-%M-%S}.rrd"


def _encode(episode: Episode) -> tuple[bytes, Account]:
    def fill(recording: rr.RecordingStream) -> Account:
        account = log_episode(recording, episode)
        for name, values in properties(episode).items():
            recording.send_property(name, rr.AnyValues(**values))
        recording.send_recording_name(_title(episode))
        return account

    # Without strict mode a mesh that rerun refuses is a warning, and the file lacks it.
    with catch_and_log_exceptions(strict=True):
        encoded = encode_recording(_application_id(episode.info), episode_blueprint(episode), fill)
    return encoded


def _application_id(info: EpisodeInfo) -> str:
    """The viewer keeps one blueprint an application id; a slash in it makes rerun rename it."""
    return f"workbench {info.task}".replace("/", "-")


def _title(episode: Episode) -> str:
    outcome = (
        "success" if flag(episode, "success")[-1] else "fail" if flag(episode, "fail")[-1] else "no success"
    )
    info = episode.info
    seed = f"seed {info.seed}" if info.seed >= 0 else "no seed"
    return f"{info.task} {seed} env {info.env_index}: {outcome}, {len(episode.action)} steps"


def properties(episode: Episode) -> dict[str, dict[str, Any]]:
    """What the file says of the episode as a whole, property by property.

    ``success`` and ``fail`` are those of the last state, ``success_once`` and ``fail_once`` of any, as
    in ManiSkill's own metrics. ``source`` holds the text of the task's files, so that the episode can
    be made again where the files have changed since.
    """
    info = episode.info
    folder = os.path.dirname(info.source_file) if info.source_file else ""
    values: dict[str, dict[str, Any]] = {
        "episode": {
            "task": info.task,
            "seed": info.seed if info.seed >= 0 else None,
            "env_index": info.env_index,
            "length": len(episode.action),
            "return": float(np.sum(episode.reward, dtype=np.float64)),
            "success": bool(flag(episode, "success")[-1]),
            "success_once": bool(flag(episode, "success").any()),
            "fail": bool(flag(episode, "fail")[-1]),
            "fail_once": bool(flag(episode, "fail").any()),
            "control_mode": info.control_mode,
            "control_dt": info.control_dt,
            "backend": info.backend,
            "source_file": os.path.basename(info.source_file) if info.source_file else None,
            "source_hash": info.source_hash,
            "written_at": datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds"),
        }
    }
    if info.versions:
        values["versions"] = dict(info.versions)
    if info.source:
        values["source"] = {
            "files": [_relative(path, folder) for path in info.source],
            "texts": list(info.source.values()),
        }
    return values


def _relative(path: str, folder: str) -> str:
    """Where a source file lies as seen from the task's: the folders above it are nobody's business."""
    if not folder:
        return os.path.basename(path)
    try:
        return Path(os.path.relpath(path, folder)).as_posix()
    except ValueError:  # another drive, on Windows
        return os.path.basename(path)


def _check_lengths(episode: Episode) -> None:
    steps = len(episode.action)
    bodies = len(episode.geometry.body_names)
    found = {
        "poses": (episode.poses.shape, (steps + 1, bodies, 7)),
        "action": (episode.action.shape, (steps, len(episode.action_names))),
        "reward": (episode.reward.shape, (steps,)),
        "terminated": (episode.terminated.shape, (steps,)),
        "truncated": (episode.truncated.shape, (steps,)),
    }
    for name, values in episode.evaluate.items():
        found[f"evaluate['{name}']"] = (values.shape, (steps + 1, *values.shape[1:]))
    for camera in episode.cameras:
        found[f"poses of camera {camera.info.name}"] = (camera.pose.shape, (len(camera.frame), 7))
    for name, (shape, expected) in found.items():
        if shape != expected:
            raise ValueError(
                f"Episode of {steps} steps and {bodies} bodies: {name} is {shape}, not {expected}."
            )


def _check_written(path: Path, account: Account) -> None:
    """Raise OSError unless every row and every static entity of `account` can be read from `path`."""
    rows: Counter[str] = Counter()
    statics: set[str] = set()
    try:
        reader = RrdReader(path)
        reader.store()  # needs the footer, which is written last
        for chunk in reader.stream():
            if chunk.is_static:
                statics.add(chunk.entity_path)
            else:
                rows[chunk.entity_path] += chunk.num_rows
    except (ValueError, RuntimeError, OSError) as error:
        raise OSError(errno.EIO, f"the file could not be read back ({error})") from error
    short = [
        f"{name}: {rows[name]} of {count} rows" for name, count in account.rows.items() if rows[name] != count
    ]
    short += [f"{name}: missing" for name in sorted(account.statics - statics)]
    if short:
        raise OSError(errno.EIO, f"not everything arrived on the disk ({'; '.join(short[:3])})")


def _reason(error: OSError, path: Path) -> str:
    folder = next((parent for parent in path.parents if parent.is_dir()), None)
    if error.errno == errno.ENOSPC or (folder is not None and shutil.disk_usage(folder).free < 1 << 20):
        return f"the disk that holds {folder} is full. Make room there, or choose another folder."
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        return f"{path.parent} may not be written to. Choose another folder, or change its permissions."
    if error.errno in (errno.ENOTDIR, errno.EEXIST):
        return f"{path.parent} is not a folder. Choose another one."
    if error.errno == errno.ENAMETOOLONG:
        return "the name is too long. Choose a shorter one."
    return f"{error.strerror or error}."


def _publish(temporary: Path, path: Path) -> Path:
    """Give the finished file the first free name. Two processes that race get two names."""
    for candidate in _candidates(path):
        try:
            os.link(temporary, candidate)
        except FileExistsError:
            continue
        except OSError as error:
            if error.errno not in _NO_LINKS:
                raise
            # A filesystem without hard links (FAT, some network drives): claim the name, then replace it.
            try:
                candidate.touch(exist_ok=False)
            except FileExistsError:
                continue
            os.replace(temporary, candidate)
        return candidate
    raise AssertionError("unreachable: the candidates do not end")


def _candidates(path: Path) -> Iterator[Path]:
    yield path
    number = 2
    while True:
        yield path.with_name(f"{path.stem}_{number}{path.suffix}")
        number += 1


def _write(path: Path, content: bytes) -> None:
    with path.open("xb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def _sync_folder(path: Path) -> None:
    """Make a new name last: without this a power cut may take it, though not the file's content."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
