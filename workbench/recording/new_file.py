"""A file that is either there, whole, or not there, and that never takes the place of another."""

from __future__ import annotations

import contextlib
import errno
import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """A name beside `path` to write to; what was written has the name `path` after the block, unless it raised.

    Raises:
        FileExistsError: there is something at `path`; the message says what to do.
        OSError: the folder cannot be written to, or the disk is full; the message names the file.
    """
    path = Path(path)
    if path.exists():
        raise _taken(path)
    temporary = path.parent / f".{uuid.uuid4().hex}.part"
    try:
        _make_folder(path.parent)
        yield temporary
        with temporary.open("rb") as file:
            os.fsync(file.fileno())
        _name(temporary, path)
    except OSError as error:
        if isinstance(error, FileExistsError) or error.errno is None:
            raise
        raise OSError(error.errno, f"Cannot write {path}: {os.strerror(error.errno)}.") from error
    finally:
        # The other name is there by now, or it is to be told why it is not.
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def _make_folder(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except FileExistsError as error:  # which would be taken for one of the file's own name
        raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), os.fspath(path)) from error


def _taken(path: Path) -> FileExistsError:
    return FileExistsError(
        f"There is a file {path} already, and it is not written over: move it, or name another folder."
    )


def _name(temporary: Path, path: Path) -> None:
    try:
        # Unlike a rename this fails where the name was taken meanwhile.
        os.link(temporary, path)
    except FileExistsError:
        raise _taken(path) from None
    except OSError as error:
        if error.errno == errno.ENOSPC:
            raise
        # No hard links on this file system.
        if path.exists():
            raise _taken(path) from None
        temporary.rename(path)
