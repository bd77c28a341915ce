"""Reads and writes files safely: writes are atomic, and only regular files are read."""

from __future__ import annotations

import contextlib
import errno
import os
import stat
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

MAX_COMPARED_BYTES = 64 << 20
"""Maximum size of a file that is compared before it is replaced."""
_NO_LINKS = {errno.EPERM, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.EMLINK, errno.EACCES}


@contextmanager
def written_beside(path: Path, content: bytes, mode: int = 0o666) -> Iterator[Path]:
    """Context that gives the path of a temporary file in the folder of `path`, with this content, synced to
    disk. The file is removed after the block.

    Raises:
        OSError: the file cannot be written.
    """
    temporary = path.with_name(f".{uuid.uuid4().hex}{path.suffix}.part")
    try:
        with open(temporary, "xb", opener=lambda name, how: os.open(name, how, mode)) as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        yield temporary
    finally:
        with contextlib.suppress(OSError):  # must not hide the error of the block
            temporary.unlink(missing_ok=True)


def give_name(temporary: Path, path: Path) -> None:
    """Give the file at `temporary` the name `path`, which must be free. Afterwards `temporary` may be gone.

    Raises:
        FileExistsError: `path` exists.
        OSError: the file cannot be linked or renamed.
    """
    try:
        os.link(temporary, path)  # unlike a rename it never replaces a file
    except FileExistsError:
        raise
    except OSError as error:
        if error.errno not in _NO_LINKS:
            raise
        # A filesystem without hard links (FAT, some network drives): claim the name, then replace it.
        path.touch(exist_ok=False)
        try:
            os.replace(temporary, path)
        except BaseException:
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)
            raise


def create_file(path: Path, content: bytes, mode: int = 0o666) -> bool:
    """Write a new file; returns False, and changes nothing, if `path` exists. Raises OSError."""
    with written_beside(path, content, mode) as temporary:
        try:
            give_name(temporary, path)
        except FileExistsError:
            return False
    return True


def real_path(path: Path) -> Path:
    """The absolute path with links resolved. Links that form a cycle stay unresolved; before Python 3.13,
    ``Path.resolve`` would raise RuntimeError for them."""
    return Path(os.path.realpath(path))


def replace_file(path: Path, content: bytes, expected: bytes | None = None) -> bool:
    """Write or replace a file in one step. Returns False, and changes nothing, if its content is no longer `expected`.

    If `path` is a link, the file that it points to is replaced. The file keeps its mode, and its owner if
    this user may set it.

    Raises:
        OSError: the file cannot be written; its content is unchanged.
    """
    path = real_path(path)
    with written_beside(path, content) as temporary:
        with contextlib.suppress(FileNotFoundError):  # a new file has no mode to keep
            status = path.stat()
            with contextlib.suppress(PermissionError):  # another user owns the file
                os.chown(temporary, status.st_uid, status.st_gid)
            with contextlib.suppress(PermissionError):  # a file system without modes
                os.chmod(temporary, stat.S_IMODE(status.st_mode))
        if expected is not None and read_regular_file(path, MAX_COMPARED_BYTES) != expected:
            return False
        os.replace(temporary, path)
    return True


@contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """Context that gives a temporary path in the folder of `path`. If the block does not raise, the temporary file is
    renamed to `path`.

    Raises:
        FileExistsError: `path` exists; the message says what to do.
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
        give_name(temporary, path)
    except FileExistsError:
        raise _taken(path) from None
    except OSError as error:
        if error.errno is None:
            raise
        raise OSError(error.errno, f"Cannot write {path}: {os.strerror(error.errno)}.") from error
    finally:
        # An error of this removal must not hide the error of the block.
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def _make_folder(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except FileExistsError as error:
        # Raise another type, since `new_file` concludes from a FileExistsError that the file to make exists.
        raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), os.fspath(path)) from error


def _taken(path: Path) -> FileExistsError:
    return FileExistsError(
        f"There is a file {path} already, and it is not overwritten: move it, or name another folder."
    )


# --- reading files that others may have replaced: regular files of limited size ---------------------


MAX_SOURCE_BYTES = 16 << 20
"""Maximum size of a Python file; 50 times the largest file of the standard library."""
_READ_BYTES = 1 << 20
_KINDS = (
    (stat.S_ISDIR, "folder"),
    (stat.S_ISFIFO, "named pipe"),
    (stat.S_ISCHR, "character device"),
    (stat.S_ISBLK, "block device"),
    (stat.S_ISSOCK, "socket"),
)


class NotARegularFile(OSError):
    """A path to a device, pipe, socket or folder. Its text is a sentence that names the path."""

    def __str__(self) -> str:
        return f"{self.filename} {self.strerror}"


class FileTooLarge(OSError):
    """A file with more bytes than allowed. Its text is a sentence that names the path."""

    __str__ = NotARegularFile.__str__


def read_regular_file(path: str | os.PathLike[str], most_bytes: int) -> bytes:
    """The content of a regular file of at most `most_bytes`.

    Raises:
        NotARegularFile: `path` is, or links to, something else; nothing was read.
        FileTooLarge: the file has more bytes, even if its stated size is smaller or it grows meanwhile.
        OSError: the file cannot be opened or read.
    """
    with open_regular_file(path, most_bytes) as file:
        pieces, size = [], 0
        # Read in pieces: a single read of `most_bytes` would allocate that many bytes even for a file of ten.
        while piece := file.read(min(_READ_BYTES, most_bytes + 1 - size)):
            pieces.append(piece)
            size += len(piece)
            if size > most_bytes:
                raise _too_large(path, None, most_bytes)
    return b"".join(pieces)


def open_regular_file(path: str | os.PathLike[str], most_bytes: int | None = None) -> BinaryIO:
    """Open a regular file for reading without blocking; links are followed.

    Args:
        most_bytes: maximum size when the file is opened; None for any. More bytes can be read if the file
            grows afterwards, or is in ``/proc``, where files state size 0.

    Raises:
        NotARegularFile, FileTooLarge, OSError: as `read_regular_file`.
    """
    # Check before opening, since opening some devices has an effect (a watchdog, a tape).
    _must_be_regular(path, os.stat(path).st_mode)
    # Check again, since the file may have been replaced. O_NONBLOCK: opening a pipe without a writer would block for ever.
    fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOCTTY)
    try:
        found = os.fstat(fd)
        _must_be_regular(path, found.st_mode)
        if most_bytes is not None and found.st_size > most_bytes:
            raise _too_large(path, found.st_size, most_bytes)
        return os.fdopen(fd, "rb")
    except BaseException:
        os.close(fd)
        raise


def _must_be_regular(path: str | os.PathLike[str], mode: int) -> None:
    if stat.S_ISREG(mode):
        return
    kind = next((name for is_kind, name in _KINDS if is_kind(mode)), "special file")
    raise NotARegularFile(errno.EINVAL, f"is a {kind}, not a regular file", os.fspath(path))


def _too_large(path: str | os.PathLike[str], size: int | None, most_bytes: int) -> FileTooLarge:
    has = "has more" if size is None else f"has {_size_text(size)}, more"
    return FileTooLarge(
        errno.EFBIG, f"{has} than the limit of {_size_text(most_bytes)} for such a file", os.fspath(path)
    )


def _size_text(size: int) -> str:
    for unit, name in ((2**30, "GB"), (2**20, "MB"), (2**10, "KB")):
        if size >= unit:
            return f"{size / unit:.1f} {name}"
    return f"{size} bytes"
