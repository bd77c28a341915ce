"""Uploads finished recordings with fsspec: to S3, Google Cloud Storage, another machine. The .json comes last."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from workbench.episodes.writing.finish_or_recover import EpisodeFiles, stem_begin
from workbench.episodes.writing.publish import RecordingError

_INSTALL = {
    "s3": "s3fs",
    "s3a": "s3fs",
    "gs": "gcsfs",
    "gcs": "gcsfs",
    "abfs": "adlfs",
    "az": "adlfs",
    "sftp": "paramiko",
}


def require_place(address: str) -> None:
    """Try to write to the address, before minutes are spent on recording.

    Raises:
        RecordingError: it cannot be written to; the message gives the reason.
    """
    system, path = _place(address)
    try:
        _make_place(system, path)
        system.pipe_file(f"{path}/.workbench", b"")
        system.rm_file(f"{path}/.workbench")
    except Exception as error:
        # Catches every error: each storage has its own types of errors.
        raise RecordingError(f"Cannot record to {address}: {type(error).__name__}: {error}") from error


def upload_episode(files: EpisodeFiles, address: str) -> None:
    """Upload the files of an episode, and delete them on this machine.

    Raises:
        RecordingError: the upload failed; without its .json, the episode does not exist at the address.
    """
    system, path = _place(address)
    try:
        _make_place(system, path)
        for file in (files.rrd, files.h5, files.json):
            system.put_file(str(file), f"{path}/{file.name}")
    except Exception as error:
        raise RecordingError(
            f"Cannot upload {files.json.name} to {address}: {type(error).__name__}: {error}"
        ) from error
    for file in (files.json, files.h5, files.rrd):
        file.unlink()


def upload_file(file: Path, address: str) -> None:
    """Upload a file, and keep it on this machine. Raises RecordingError."""
    system, path = _place(address)
    try:
        _make_place(system, path)
        system.put_file(str(file), f"{path}/{file.name}")
    except Exception as error:
        raise RecordingError(
            f"Cannot upload {file.name} to {address}: {type(error).__name__}: {error}"
        ) from error


def remove_uploaded(address: str, stem: str) -> None:
    """Delete the files of an episode from an address, the .json first. Raises RecordingError."""
    system, path = _place(address)
    try:
        for suffix in (".json", ".h5", ".rrd"):
            if system.exists(f"{path}/{stem}{suffix}"):
                system.rm_file(f"{path}/{stem}{suffix}")
    except Exception as error:
        raise RecordingError(
            f"Cannot delete {stem} from {address}: {type(error).__name__}: {error}"
        ) from error


def remove_uploaded_id(address: str, task: str, seed: int, id: str) -> None:
    """Delete the episode with this id, if it exists. Raises RecordingError."""
    system, path = _place(address)
    try:
        system.invalidate_cache()
        for found in system.glob(f"{path}/{stem_begin(task, seed)}*.json"):
            if json.loads(system.cat_file(found)).get("workbench", {}).get("id") == id:
                remove_uploaded(address, found.rpartition("/")[2].removesuffix(".json"))
    except RecordingError:
        raise
    except Exception as error:
        raise RecordingError(f"Cannot list {address}: {type(error).__name__}: {error}") from error


def _make_place(system: Any, path: str) -> None:
    # Does not create a bucket: permission to write into a bucket does not include creating one.
    if "/" in path and not system.exists(path):
        system.makedirs(path, exist_ok=True)


def _place(address: str) -> tuple[Any, str]:
    """The file system of an address, and the path in it. Raises RecordingError."""
    import fsspec

    try:
        system, path = fsspec.core.url_to_fs(address)
    except (ImportError, ValueError) as error:
        package = _INSTALL.get(address.partition("://")[0])
        advice = f" ({error}): give an address such as s3://bucket/folder, gs://bucket/folder or sftp://host/folder"
        if package and isinstance(error, ImportError):
            advice = f": pip install {package}"
        raise RecordingError(f"Cannot record to {address}{advice}") from error
    return system, path.rstrip("/")
