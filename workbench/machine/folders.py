"""The user's private folders, the folder of the page's files, and the current folder."""

from __future__ import annotations

import fcntl
import os
import stat
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import platformdirs

from workbench.machine.files import create_file, written_beside

MAX_FILE_BYTES = 16 << 20


class NoUserFolder(OSError):
    """The folder is missing or not private; the message is a clause without a full stop."""


def user_folder() -> Path:
    """Path of the configuration folder, such as ``~/.config/workbench``; it may not exist.

    Raises:
        NoUserFolder: this user has no home folder.
    """
    return _absolute(platformdirs.user_config_path)


def state_folder() -> Path:
    """Path of the folder for the state of the last runs, such as ``~/.local/state/workbench``; it may not exist.

    Raises:
        NoUserFolder: this user has no home folder.
    """
    return _absolute(platformdirs.user_state_path)


def _absolute(found: Callable[..., Path]) -> Path:
    try:
        folder = found("workbench", appauthor=False)
    except RuntimeError as error:
        raise NoUserFolder(f"this user has no home folder ({error})") from error
    if not folder.is_absolute():
        # Earlier versions of platformdirs return a path below the current folder, which may be a folder of
        # downloads.
        raise NoUserFolder(f"the user's folder has no absolute path ({folder})")
    return folder


def cache_folder() -> Path:
    """Folder for caches, such as ``~/.cache/workbench``; it may not exist."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "workbench"


def read_private(name: str, folder: Path | None = None) -> bytes | None:
    """Read a file of the user folder; None if it does not exist.

    Args:
        folder: folder of the file; None for `user_folder`.

    Raises:
        NoUserFolder: the folder or the file belongs to another user, others may write to it, or the file is
            not a regular file of at most `MAX_FILE_BYTES`.
        OSError: the file cannot be read.
    """
    path = (folder or user_folder()) / name
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except FileNotFoundError:
        return None
    try:
        _check_private(path.parent, path.parent.stat())
        _check_private(path, status := os.fstat(descriptor))
        if not stat.S_ISREG(status.st_mode) or status.st_size > MAX_FILE_BYTES:
            raise NoUserFolder(f"{path} is not a regular file of at most {MAX_FILE_BYTES >> 20} MB")
        # After the checks, since fdopen raises for a folder and leaves the descriptor open.
        with os.fdopen(descriptor, "rb", closefd=False) as file:
            return file.read(MAX_FILE_BYTES)
    finally:
        os.close(descriptor)


def write_private(name: str, content: bytes, folder: Path | None = None) -> None:
    """Write a file of the user folder, readable only by this user; makes the folder if it is missing.

    Args:
        folder: folder of the file; None for `user_folder`.

    Raises:
        OSError: the file cannot be written; it is unchanged.
    """
    path = _made(folder) / name
    with written_beside(path, content, 0o600) as temporary:
        os.replace(temporary, path)


def create_private(name: str, content: bytes) -> bool:
    """Write a new file of the user folder, readable only by this user; returns False, and changes nothing, if the file
    exists.

    Raises:
        OSError: the file cannot be written.
    """
    return create_file(_made() / name, content, 0o600)


def set_aside(name: str) -> Path:
    """Rename a broken file of the user folder; returns its new path.

    Raises:
        OSError: the file cannot be renamed.
    """
    path = user_folder() / name
    broken = path.with_name(f"{name}.broken")
    os.replace(path, broken)
    return broken


@contextmanager
def locked(name: str, folder: Path | None = None) -> Iterator[None]:
    """Context that holds a lock of this name against other processes and threads.

    Args:
        folder: folder of the lock file; None for `user_folder`.

    Raises:
        OSError: the lock file cannot be made.
    """
    descriptor = os.open(_made(folder) / f"{name}.lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def _made(folder: Path | None = None) -> Path:
    folder = folder or user_folder()
    folder.parent.mkdir(parents=True, exist_ok=True)
    folder.mkdir(mode=0o700, exist_ok=True)
    _check_private(folder, folder.stat())
    return folder


def _check_private(path: Path, status: os.stat_result) -> None:
    """Raise NoUserFolder if another user can write there: the trust store must be the user's own."""
    if os.geteuid() != 0 and status.st_uid not in (os.geteuid(), 0):
        raise NoUserFolder(f"{path} belongs to another user")
    if status.st_mode & 0o022:
        raise NoUserFolder(f"other users may write to {path}; to forbid it, type: chmod go-w {path}")


# --- the page's files -------------------------------------------------------------------------------


def web_assets_folder() -> Path:
    """Folder with the files for the browser: ``web_assets/`` of a checkout, ``workbench/_web_assets`` of a wheel.

    The wheel's copy has precedence: an installed package must not use a folder next to it in site-packages.

    Raises:
        FileNotFoundError: neither the wheel's copy nor the checkout's folder is there.
    """
    from importlib import resources  # imported late: takes 10 ms, and few commands need it

    package = Path(str(resources.files("workbench")))
    for folder in (package / "_web_assets", package.parent / "web_assets"):
        if (folder / "refused.html").is_file():
            return folder
    raise FileNotFoundError(
        f"The page's files are missing: neither {package / '_web_assets'} nor {package.parent / 'web_assets'} "
        "holds refused.html. Install workbench again (pip install --force-reinstall), or check out web_assets/."
    )


def example_tasks() -> tuple[Path, ...]:
    """The example tasks of the wheel or of a checkout; empty if there is neither."""
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "_tasks", package.parent / "tasks"):
        if (folder / "push_cube.py").is_file():
            return tuple(sorted(folder.glob("*.py")))
    return ()


# --- the current folder, which a task may change by os.chdir ----------------------------------------


_AT_FOLDER = os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC


class CurrentFolder:
    """The folder that is current at construction. It is held by a descriptor, so it may be renamed
    meanwhile."""

    def __init__(self) -> None:
        self._fd = os.open(".", _AT_FOLDER)
        weakref.finalize(self, os.close, self._fd)

    @contextmanager
    def again(self, *, stay: bool = False) -> Iterator[None]:
        """Context in which this is the current folder; afterwards the previous folder is current again.

        Args:
            stay: the folder that is current at the end of the block stays current, unless the block raises.
        """
        before = os.open(".", _AT_FOLDER)
        leave = True
        try:
            os.fchdir(self._fd)
            yield
            leave = not stay
        finally:
            if leave:
                os.fchdir(before)
            os.close(before)
