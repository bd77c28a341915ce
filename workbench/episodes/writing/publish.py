"""Publishes the files of a recording under their names: all of them complete, or none."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import tempfile
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path

from workbench.machine.files import give_name


class RecordingError(OSError):
    """An episode could not be written; the message gives advice. None of its files is published."""


def try_folder(folder: Path) -> None:
    """Check that recordings can be written to `folder`, which may be missing, before minutes are spent on recording.

    Raises:
        RecordingError: they cannot be written.
    """
    try:
        os.fspath(folder.absolute()).encode()
    except UnicodeEncodeError as error:
        why = "its name is not UTF-8, which rerun does not support. Choose another one"
        raise RecordingError(f"Cannot record to {folder}: {why}.") from error
    there = next(parent for parent in (folder, *folder.absolute().parents) if os.path.lexists(parent))
    try:
        with tempfile.TemporaryFile(dir=there):
            pass
    except OSError as error:
        raise RecordingError(f"Cannot record to {folder}: {reason(error, folder)}") from error


def sync_files(paths: Sequence[Path]) -> None:
    """Sync all of `paths` in parallel, since each takes a few milliseconds. Raises OSError."""
    errors: list[OSError] = []

    def sync(path: Path) -> None:
        try:
            _sync(path)
        except OSError as error:
            errors.append(error)

    threads = [threading.Thread(target=sync, args=(path,), name="episode-sync") for path in paths[1:]]
    for thread in threads:
        thread.start()
    sync(paths[0])
    for thread in threads:
        thread.join()
    if errors:
        raise errors[0]


def publish(temporaries: Sequence[Path], folder: Path, stem: str) -> list[Path]:
    """Give finished files (``<id>.rrd``, ``<id>.h5`` ...), in order, their final names: with the first stem
    of `candidates` that is free for all of them.

    The .json comes last: **a recording without a .json does not exist.** Racing processes get different
    names. If the filesystem supports hard links, the temporaries also stay under their old names.

    Raises:
        OSError: publishing failed; none of the files has its final name.
    """
    for candidate in candidates(stem):
        paths = [folder / f"{candidate}{temporary.suffix}" for temporary in temporaries]
        if any(os.path.lexists(path) for path in paths):
            continue
        done: list[Path] = []
        try:
            for temporary, path in zip(temporaries, paths):
                give_name(temporary, path)
                done.append(path)
            sync_folder(folder)
        except FileExistsError:
            _remove(done)
            continue
        except BaseException:
            _remove(done)
            raise
        return paths
    raise AssertionError("unreachable: the candidates do not end")


def candidates(stem: str) -> Iterator[str]:
    """``stem``, ``stem_2``, ``stem_3`` ..."""
    yield stem
    number = 2
    while True:
        yield f"{stem}_{number}"
        number += 1


def _remove(paths: Sequence[Path]) -> None:
    for path in reversed(paths):
        with contextlib.suppress(OSError):  # the first error is raised
            path.unlink(missing_ok=True)


def sync_folder(path: Path) -> None:
    """Sync a folder. Without this a power cut may lose a new name in it, though not the file's content."""
    _sync(path)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def reason(error: OSError, folder: Path) -> str:
    """Why `folder` could not be written to, and what to do."""
    there = next((parent for parent in (folder, *folder.parents) if parent.is_dir()), None)
    if error.errno in (errno.ENOSPC, errno.EDQUOT) or (
        there is not None and shutil.disk_usage(there).free < 1 << 20
    ):
        return f"the disk that holds {there or folder} is full. Make room there, or choose another folder."
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        return f"{folder} is not writable. Choose another folder, or change its permissions."
    if error.errno in (errno.ENOTDIR, errno.EEXIST):
        return f"{folder} is not a folder. Choose another one."
    if error.errno == errno.ENAMETOOLONG:
        return "the name is too long. Choose a shorter one."
    if error.errno == errno.EFBIG:
        return "the file is larger than the system allows. Record shorter episodes, or lift the limit (ulimit -f)."
    if error.errno == errno.ENOENT:
        return f"{folder} was removed during the recording. Record again: the folder is created again."
    return f"{error.strerror or error}."
