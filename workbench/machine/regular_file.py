"""Reads files that others may have replaced: only regular files, and only so much of them."""

from __future__ import annotations

import errno
import os
import stat
from typing import BinaryIO

MOST_SOURCE_BYTES = 16 << 20
"""Of one Python file; the largest of the standard library has a fiftieth of this."""
_PIECE = 1 << 20
_KINDS = (
    (stat.S_ISDIR, "folder"),
    (stat.S_ISFIFO, "named pipe"),
    (stat.S_ISCHR, "character device"),
    (stat.S_ISBLK, "block device"),
    (stat.S_ISSOCK, "socket"),
)


class NotARegularFile(OSError):
    """A path that leads to a device, a pipe, a socket or a folder. As text, a sentence that names the path."""

    def __str__(self) -> str:
        return f"{self.filename} {self.strerror}"


class FileTooLarge(OSError):
    """A file with more bytes than its kind may have. As text, as of `NotARegularFile`."""

    __str__ = NotARegularFile.__str__


def read_regular_file(path: str | os.PathLike[str], most_bytes: int) -> bytes:
    """The content of a file of at most `most_bytes`.

    Raises:
        NotARegularFile: ``path`` is, or links to, something else. It was not read from.
        FileTooLarge: there is more, also where the file says a smaller size or grows meanwhile.
        OSError: it cannot be opened or read.
    """
    with open_regular_file(path, most_bytes) as file:
        pieces, size = [], 0
        # In pieces: one read of `most_bytes` would allocate them all for a file of ten bytes.
        while piece := file.read(min(_PIECE, most_bytes + 1 - size)):
            pieces.append(piece)
            size += len(piece)
            if size > most_bytes:
                raise _too_large(path, None, most_bytes)
    return b"".join(pieces)


def open_regular_file(path: str | os.PathLike[str], most_bytes: int | None = None) -> BinaryIO:
    """Open a file for reading, never waiting for it; links to regular files are followed.

    Args:
        most_bytes: its size may be no more than this; None for any size. A file that grows afterwards, and one of
            ``/proc`` that has no size, can give more.

    Raises:
        NotARegularFile, FileTooLarge, OSError: as `read_regular_file`.
    """
    # Looked at before it is opened: opening some devices does something (a watchdog, a tape).
    _must_be_regular(path, os.stat(path).st_mode)
    # It may be another one by now, and the open of a pipe without a writer would wait for ever.
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
    has = "has more" if size is None else f"has {_in_words(size)}, more"
    return FileTooLarge(
        errno.EFBIG, f"{has} than the {_in_words(most_bytes)} that such a file may have", os.fspath(path)
    )


def _in_words(size: int) -> str:
    for unit, name in ((2**30, "GB"), (2**20, "MB"), (2**10, "KB")):
        if size >= unit:
            return f"{size / unit:.1f} {name}"
    return f"{size} bytes"
