"""The user's configuration folder: private files, replaced whole, by one process at a time."""

from __future__ import annotations

import fcntl
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import platformdirs

from workbench.machine.files import create_file, written_beside

MOST_BYTES = 16 << 20


class NoUserFolder(OSError):
    """There is no such folder, or it cannot be relied on; the message is the end of a sentence."""


def user_folder() -> Path:
    """Where it is, such as ``~/.config/workbench``; it may be missing.

    Raises:
        NoUserFolder: this user has no home folder.
    """
    try:
        folder = platformdirs.user_config_path("workbench", appauthor=False)
    except RuntimeError as error:
        raise NoUserFolder(f"this user has no home folder ({error})") from error
    if not folder.is_absolute():
        # Below the current folder, which may be a downloaded one: earlier versions of platformdirs answer so.
        raise NoUserFolder(f"the configuration folder has no absolute path ({folder})")
    return folder


def cache_folder() -> Path:
    """Where files of ours lie that can be had again, such as ``~/.cache/workbench``; it may be missing."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "workbench"


def read_private(name: str) -> bytes | None:
    """The content of a file of the folder; None where there is none.

    Raises:
        NoUserFolder: the folder or the file belongs to another user, or others may write to it.
        OSError: it cannot be read.
    """
    path = user_folder() / name
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except FileNotFoundError:
        return None
    try:
        _check_private(path.parent, path.parent.stat())
        _check_private(path, status := os.fstat(descriptor))
        if not stat.S_ISREG(status.st_mode) or status.st_size > MOST_BYTES:
            raise NoUserFolder(f"{path} is no ordinary file of at most {MOST_BYTES >> 20} MB")
        # Not before: of a folder it raises, and leaves the descriptor open.
        with os.fdopen(descriptor, "rb", closefd=False) as file:
            return file.read(MOST_BYTES)
    finally:
        os.close(descriptor)


def write_private(name: str, content: bytes) -> None:
    """Let a file of the folder hold `content`, readable by this user alone; the folder is made if missing.

    Raises:
        OSError: it cannot be written; the file is as it was.
    """
    path = _made() / name
    with written_beside(path, content, 0o600) as temporary:
        os.replace(temporary, path)


def create_private(name: str, content: bytes) -> bool:
    """The same for a file that must not be there yet; False, and nothing done, if it is.

    Raises:
        OSError: it cannot be written.
    """
    return create_file(_made() / name, content, 0o600)


def set_aside(name: str) -> Path:
    """Rename a file of the folder that is broken; returns its new place.

    Raises:
        OSError: it cannot be done.
    """
    path = user_folder() / name
    broken = path.with_name(f"{name}.broken")
    os.replace(path, broken)
    return broken


@contextmanager
def locked(name: str) -> Iterator[None]:
    """Meanwhile no other process or thread is here with this name.

    Raises:
        OSError: the lock cannot be made.
    """
    descriptor = os.open(_made() / f"{name}.lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def _made() -> Path:
    folder = user_folder()
    folder.parent.mkdir(parents=True, exist_ok=True)
    folder.mkdir(mode=0o700, exist_ok=True)
    _check_private(folder, folder.stat())
    return folder


def _check_private(path: Path, status: os.stat_result) -> None:
    """What another user can write could say that anything is trusted."""
    if os.geteuid() != 0 and status.st_uid not in (os.geteuid(), 0):
        raise NoUserFolder(f"{path} belongs to another user")
    if status.st_mode & 0o022:
        raise NoUserFolder(f"others than this user may write to {path}: chmod go-w {path}")
